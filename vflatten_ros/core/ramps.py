"""Where the step from one layer of cloth to another may have been smoothed into a ramp.

The edge of a layer that lies flush with another is a step of one thickness of cloth, hardly more
than the noise. Fits smooth it into a ramp, and a ramp looks like cloth that goes on. Two things
give it away: its samples are tilted against the cloth on both sides of them, which a fold's are
not, and the measured points around them are nearer to a step than to any smooth surface.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.geometry import tangents
from vflatten_ros.core.parallel import mapped
from vflatten_ros.core.values import Bool, Float, Int, Progress, no_progress

RING_M = (0.007, 0.014)  # cloth on both sides of a sample: beyond what one fit averages
RING_HEIGHT_M = 0.006
STEP_REACH_M = 0.009  # points to which a step is fitted
STEP_HEIGHT_M = 0.006
STEP_POINTS = 64
STEP_SOFT = 0.15  # width of the step, in reaches
DIRECTIONS = 6  # of the step
NOISE_SIGMAS = 1.0  # of its height that noise alone makes of the best of all directions
PAIRS = 100_000  # pairs at a time: bounds the memory
CHUNK = 1024  # samples at a time, so that they stay in the cache


def ramps(
    xyz: Float,
    normal: Float,
    points: Float,
    normals: Float,
    config: RotationConfig,
    progress: Progress = no_progress,
) -> Float:
    """How much each sample looks like a ramp between two layers.

    Parameters
    ----------
    xyz, normal : ndarray of shape (n, 3)
        Samples and their outward normals.
    points, normals : ndarray of shape (m, 3)
        Registered points of all views and their outward normals, same frame.
    config : RotationConfig
    progress : Progress

    Returns
    -------
    ndarray of shape (n,)
        Height of the step (m) times tilt (rad), in units of rotation.ramp: paths should not pass
        through samples of more than 1.
    """
    progress("ramps", 0.0)
    tilt = _tilt(xyz, normal, progress)
    steep = np.flatnonzero(tilt * STEP_HEIGHT_M > config.ramp)
    tree = cKDTree(points[::2], balanced_tree=False, compact_nodes=False)
    step = np.zeros(len(xyz))
    chunks = [steep[start : start + CHUNK] for start in range(0, len(steep), CHUNK)]

    def fitted(some: Int) -> Float:
        return _step(xyz[some], normal[some], points[::2], normals[::2], tree)

    for done, (some, heights) in enumerate(zip(chunks, mapped(fitted, chunks), strict=True)):
        progress("ramps", 0.4 + 0.6 * done / len(chunks))
        step[some] = heights
    found: Float = step * tilt / config.ramp
    return found


def _tilt(xyz: Float, normal: Float, progress: Progress) -> Float:
    """Angle of each normal to the mean of those on both sides of it, 0 where a side is missing."""
    pairs = cKDTree(xyz).query_pairs(RING_M[1], output_type="ndarray").astype(np.int32)
    parts = []
    for k in range(0, len(pairs), PAIRS):
        progress("ramps", 0.2 * k / len(pairs))
        parts.append(_ring(pairs[k : k + PAIRS], xyz, normal))
    i, j = np.concatenate(parts).T if parts else pairs.T
    chord = xyz[j]
    chord -= xyz[i]
    length = np.linalg.norm(chord, axis=1)
    count = len(xyz)
    mean = _unit(_summed(i, normal[j], count) + _summed(j, normal[i], count))
    for done in range(2):  # the direction of the tilt depends on the mean, and it on the direction
        progress("ramps", 0.2 + 0.1 * done)
        down = _unit(normal - (normal * mean).sum(1, keepdims=True) * mean)
        total, many = np.zeros((2, count, 3)), np.zeros((2, count))
        for of, to, sign in ((i, j, 1.0), (j, i, -1.0)):
            along = sign * np.einsum("ni,ni->n", chord, down[of]) / length
            level = np.abs(np.einsum("ni,ni->n", chord, mean[of])) < RING_HEIGHT_M
            for k, side in enumerate((level & (along > 0.5), level & (along < -0.5))):
                total[k] += _summed(of[side], normal[to[side]], count)
                many[k] += np.bincount(of[side], minlength=count)
        both = (many > 1).all(0)  # fewer tell nothing
        ahead, behind = total / np.maximum(many, 1)[..., None]
        mean = np.where(both[:, None], _unit(np.where(both[:, None], ahead + behind, 1.0)), mean)
    cosine = (normal * mean).sum(1).clip(-1.0, 1.0)
    return np.where(both, np.arccos(cosine), 0.0)


def _ring(pairs: NDArray[np.int32], xyz: Float, normal: Float) -> NDArray[np.int32]:
    """The pairs (p, 2) of samples that are far enough apart and face the same way."""
    i, j = pairs.T
    length = np.linalg.norm(xyz[j] - xyz[i], axis=1)
    alike = np.einsum("ni,ni->n", normal[i], normal[j])
    kept: NDArray[np.int32] = pairs[(length > RING_M[0]) & (alike > 0.3)]
    return kept


def _summed(of: Int, vectors: Float, count: int) -> Float:
    return np.stack([np.bincount(of, column, minlength=count) for column in vectors.T], axis=1)


def _unit(vectors: Float) -> Float:
    unit: Float = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
    return unit


def _step(at: Float, normal: Float, points: Float, normals: Float, tree: cKDTree) -> Float:
    """Height of the step that, added to a quadric, fits the points around best."""
    distance, near = tree.query(at, k=STEP_POINTS, distance_upper_bound=STEP_REACH_M)
    found: Bool = np.isfinite(distance)
    near = np.where(found, near, 0)
    theirs = normals[near]
    alike = found & (np.matmul(theirs, normal[..., None])[..., 0] > 0.4)
    up = _unit((theirs * alike[..., None]).sum(1))
    e1, e2 = tangents(up)
    local = np.matmul(points[near] - at[:, None], np.stack([e1, e2, up], axis=-1))
    x, y, height = local[..., 0] / STEP_REACH_M, local[..., 1] / STEP_REACH_M, local[..., 2]
    weight = (alike & (np.abs(height) < STEP_HEIGHT_M)).astype(float)
    quadric = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)  # (n, 6, k)
    weighted = quadric * weight[:, None]
    inverse = np.linalg.inv(weighted @ quadric.transpose(0, 2, 1) + 1e-4 * np.eye(6))
    rest = height - ((inverse @ (weighted @ height[..., None])).transpose(0, 2, 1) @ quadric)[:, 0]
    turn = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    steps = np.tanh((x[..., None] * np.cos(turn) + y[..., None] * np.sin(turn)) / STEP_SOFT)
    # what of each step no quadric can follow (Frisch & Waugh 1933)
    steps -= quadric.transpose(0, 2, 1) @ (inverse @ (weighted @ steps))
    steps *= weight[..., None]
    match = np.einsum("nkd,nk->nd", steps, rest)
    size = (steps**2).sum(1) + 1e-6
    best = (match**2 / size).argmax(1)
    rows = np.arange(len(at))
    match, size = match[rows, best], size[rows, best]
    left = (weight * rest**2).sum(1) - match**2 / size
    sigma = np.sqrt(np.maximum(left, 0.0) / np.maximum(weight.sum(1) - 8.0, 1.0) / size)
    certain = np.maximum((match / size) ** 2 - (NOISE_SIGMAS * sigma) ** 2, 0.0)
    height_m: Float = 2 * np.sqrt(certain)
    return height_m
