"""A view's pieces of cloth laid flat, all their points at once.

On cloth, which hardly stretches, directions can be carried from place to place without turning:
the frames of neighbouring places differ by a known angle. Two sparse least-squares problems follow,
with one matrix: turn every frame so that neighbours agree, then place the points so that each
differs from its neighbours by the step between them on the surface. A few rounds of fitting the
turns to the places again and placing the points with them (as-rigid-as-possible) spread what
noise is left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, identity
from scipy.sparse.linalg import SuperLU, splu

from vflatten_ros.core.surface import Surface
from vflatten_ros.core.values import Bool, Float, Int

ROUNDS = 2


@dataclass(frozen=True, eq=False)
class FlatPatch:
    """The grid places of a surface in the plane; each piece has a position of its own."""

    uv: Float  # (rows, cols, 2) metres, nan where there is no surface
    piece: NDArray[np.int32]  # (rows, cols) number of the piece, -1: none
    strain: Float  # (rows, cols) rms misfit of the steps to the neighbours, relative


def flatten_patch(surface: Surface) -> FlatPatch:
    """Lay every connected piece of a view's surface flat, by the measured places alone.

    Places on both sides of a slit or a hole hang together around it.
    """
    layers = surface.layers
    used = layers.seen
    number = np.full(used.shape, -1)
    number[used] = np.arange(used.sum())
    a, b = _edges(number, used, layers.right, layers.down)
    rows, cols = np.nonzero(used)
    frames, points = _frames(surface, rows, cols)
    step_a, step_b = _steps(points, frames, a, b)
    certain = 1.0 / (1e-12 + surface.sigma_grid_m[rows, cols] ** 2)
    weight = np.sqrt(certain[a] * certain[b])
    weight /= weight.mean()
    factor, incidence = _factor(len(rows), a, b, weight)
    turn = factor.solve(incidence.T @ (weight * np.angle(step_a * step_b.conj())))
    place = _place(factor, incidence, weight, turn, a, b, step_a, step_b)
    for _ in range(ROUNDS):
        turn = _turns(place, a, b, step_a, step_b, weight, turn)
        place = _place(factor, incidence, weight, turn, a, b, step_a, step_b)
    return _on_grid(used, layers.label, rows, cols, place, a, b, step_a)


def _edges(number: Int, used: Bool, right: Bool, down: Bool) -> tuple[Int, Int]:
    """Pairs of joined neighbours."""
    right = right[:, :-1] & used[:, :-1] & used[:, 1:]
    down = down[:-1] & used[:-1] & used[1:]
    a = np.concatenate([number[:, :-1][right], number[:-1][down]])
    b = np.concatenate([number[:, 1:][right], number[1:][down]])
    return a, b


def _frames(surface: Surface, rows: Int, cols: Int) -> tuple[Float, Float]:
    """(k, 3, 3) rows: two tangents and the normal; (k, 3) points."""
    rc = np.stack([rows, cols], axis=1).astype(float)
    fit = surface.fits[rows, cols]
    by_row, by_col = surface.rays.tangents(rc, fit[:, 0], fit[:, 1:3])
    normal = np.cross(by_row, by_col)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = by_col / np.linalg.norm(by_col, axis=1, keepdims=True)
    frames = np.stack([first, np.cross(normal, first), normal], axis=1)
    return frames, surface.rays.to_points(rc, fit[:, 0])


def _steps(points: Float, frames: Float, a: Int, b: Int) -> tuple[Float, Float]:
    """The step along each edge as a complex number in the frames of both ends."""
    chord = points[b] - points[a]
    length = np.linalg.norm(chord, axis=1)
    cosine = np.einsum("ki,ki->k", frames[a, 2], frames[b, 2])
    # the surface turns by this angle along the edge: its arc is longer than the chord
    half = 0.5 * np.arccos(np.clip(cosine, 0.0, 1.0))
    length *= 1 + half**2 / 6
    steps = []
    for end in (a, b):
        x, y = (np.einsum("ki,ki->k", frames[end, i], chord) for i in (0, 1))
        flat = x + 1j * y
        steps.append(flat * (length / np.maximum(np.abs(flat), 1e-15)))
    return steps[0], steps[1]


def _factor(count: int, a: Int, b: Int, weight: Float) -> tuple[SuperLU, csc_matrix]:
    """Factor of the weighted graph Laplacian, and the edges' differences b minus a."""
    edges = np.arange(len(a))
    ones = np.ones(len(a))
    incidence = coo_matrix(
        (np.concatenate([-ones, ones]), (np.concatenate([edges, edges]), np.concatenate([a, b]))),
        shape=(len(a), count),
    ).tocsr()
    laplacian = incidence.T @ incidence.multiply(weight[:, None]) + 1e-9 * identity(count)
    options = {"SymmetricMode": True}
    factor = splu(
        laplacian.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
    )
    return factor, incidence


def _place(
    factor: SuperLU, incidence: csc_matrix, weight: Float, turn: Float, a: Int, b: Int,
    step_a: Float, step_b: Float,
) -> Float:  # fmt: skip
    """(k,) complex places whose differences are the turned steps, by least squares."""
    spin = np.exp(1j * turn)
    step = 0.5 * (spin[a] * step_a + spin[b] * step_b) * weight
    right = incidence.T @ np.stack([step.real, step.imag], axis=1)
    solved = factor.solve(np.ascontiguousarray(right))
    return np.asarray(solved[:, 0] + 1j * solved[:, 1])


def _turns(
    place: Float, a: Int, b: Int, step_a: Float, step_b: Float, weight: Float, turn: Float
) -> Float:
    """The turn of every frame that fits its steps to the places best."""
    step = (place[b] - place[a]) * weight
    count = len(turn)
    pull = np.zeros(count, complex)
    for end, own in ((a, step_a), (b, step_b)):
        product = step * own.conj()
        pull += np.bincount(end, product.real, count) + 1j * np.bincount(end, product.imag, count)
    return np.where(np.abs(pull) > 0, np.angle(pull), turn)


def _on_grid(
    used: Bool, label: NDArray[np.int32], rows: Int, cols: Int, place: Float, a: Int, b: Int,
    step: Float,
) -> FlatPatch:  # fmt: skip
    uv = np.full((*used.shape, 2), np.nan)
    uv[rows, cols] = np.stack([place.real, place.imag], axis=1)
    error = (np.abs(place[b] - place[a]) / np.maximum(np.abs(step), 1e-12) - 1) ** 2
    count = len(rows)
    total = np.bincount(a, error, count) + np.bincount(b, error, count)
    edges = np.maximum(np.bincount(a, minlength=count) + np.bincount(b, minlength=count), 1)
    strain = np.zeros(used.shape)
    strain[rows, cols] = np.sqrt(total / edges)
    return FlatPatch(uv, np.where(used, label, -1).astype(np.int32), strain)
