"""Shortest lines along the surface of one view (paper, section 2.1), all lines at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.spatial import cKDTree

from vflatten_ros.core.arrays import as_points
from vflatten_ros.core.config import GeodesicConfig
from vflatten_ros.core.errors import InvalidInput
from vflatten_ros.core.surface import Surface, depth_at
from vflatten_ros.core.values import Bool, Float, Progress, no_progress

OK, JUMP, MISSING, BENT, NOT_CONVERGED = 0, 1, 2, 3, 4


@dataclass(frozen=True, eq=False)
class Geodesics:
    """Lines along the surface and their lengths."""

    nodes: Float  # (m, M, 3)
    length_m: Float  # (m,)
    sigma_m: Float  # (m,) one standard deviation
    flagged: Bool  # (m,) True: not simply the distance on the flat cloth, see reason
    reason: NDArray[np.uint8]  # (m,) OK, JUMP, MISSING, BENT or NOT_CONVERGED


def geodesic_lines(
    surface: Surface,
    starts: Float,
    ends: Float,
    config: GeodesicConfig,
    progress: Progress = no_progress,
) -> Geodesics:
    """Shortest lines on the surface between pairs of points.

    Parameters
    ----------
    surface : Surface
    starts, ends : ndarray of shape (m, 3)
        Ends of the lines, in the surface's frame; moved onto the surface along the rays.
    config : GeodesicConfig

    Returns
    -------
    Geodesics

    Raises
    ------
    InvalidInput
        Wrong shapes or values that are not finite.
    """
    starts, ends = as_points(starts, "starts"), as_points(ends, "ends")
    if len(starts) != len(ends):
        raise InvalidInput(f"starts and ends differ in number: {len(starts)} and {len(ends)}")
    a, b = _on_grid(surface, starts), _on_grid(surface, ends)
    t = np.linspace(0, 1, config.nodes)[None, :, None]
    path = a[:, None] + t * (b - a)[:, None]
    path, converged = _relax(surface, path, progress)
    nodes, length, supported = _measure(surface, path)
    reason = np.where(~supported, MISSING, np.where(converged, OK, NOT_CONVERGED)).astype(np.uint8)
    near = cKDTree(surface.raw)
    sigma_end = surface.sigma_m[near.query(starts)[1]] ** 2 + surface.sigma_m[near.query(ends)[1]] ** 2
    sigma = np.sqrt(sigma_end + (0.001 * length) ** 2 + np.where(reason > 0, 0.05 * length, 0) ** 2)
    return Geodesics(nodes, length, sigma, reason > 0, reason)


def _on_grid(surface: Surface, points: Float) -> Float:
    return surface.rays.to_grid(points)[0]


def _points(surface: Surface, rc: Float) -> tuple[Float, Float, Bool]:
    """(m, M, 3) points, (m, M, 3, 2) tangents and (m, M) support at (m, M, 2) grid places."""
    flat = rc.reshape(-1, 2)
    depth, slope, supported = depth_at(surface, flat)
    points = surface.rays.to_points(flat, depth)
    tangents = np.stack(surface.rays.tangents(flat, depth, slope), axis=-1)
    m, n = rc.shape[:2]
    return points.reshape(m, n, 3), tangents.reshape(m, n, 3, 2), supported.reshape(m, n)


def _relax(surface: Surface, path: Float, progress: Progress) -> tuple[Float, Bool]:
    """Gauss-Newton on the energy of zero-length springs, one banded system for all lines."""
    m, n = path.shape[:2]
    converged = np.zeros(m, bool)
    for step in range(25):
        progress("geodesics", step / 25)
        live = np.flatnonzero(~converged)
        if not len(live):
            break
        points, tangents, _ = _points(surface, path[live])
        change = _newton_step(points, tangents)
        size = np.abs(change).max(axis=(1, 2))
        path[live, 1:-1] += change * np.minimum(1.0, 8.0 / np.maximum(size, 1e-12))[:, None, None]
        np.clip(path, 0, np.array(surface.layers.valid.shape) - 1.0, out=path)
        converged[live] = size < 0.02
    return path, converged


def _newton_step(points: Float, tangents: Float) -> Float:
    """(m, M - 2, 2) step of the inner nodes."""
    m, n = points.shape[:2]
    pull = points[:, :-2] - 2 * points[:, 1:-1] + points[:, 2:]
    inner = tangents[:, 1:-1]
    right = np.einsum("mnki,mnk->mni", inner, pull)
    diagonal = 2 * np.einsum("mnki,mnkj->mnij", inner, inner)
    coupling = -np.einsum("mnki,mnkj->mnij", inner[:, :-1], inner[:, 1:])
    band = np.zeros((4, m, n - 2, 2))  # upper form of solveh_banded: band[3 + i - j, j]
    band[3] = np.stack([diagonal[..., 0, 0], diagonal[..., 1, 1]], axis=-1) * (1 + 1e-6)
    band[2, :, :, 1] = diagonal[..., 0, 1]
    band[2, :, 1:, 0] = coupling[..., 1, 0]
    band[1, :, 1:, 0] = coupling[..., 0, 0]
    band[1, :, 1:, 1] = coupling[..., 1, 1]
    band[0, :, 1:, 1] = coupling[..., 0, 1]
    solved: Float = solveh_banded(band.reshape(4, -1), right.reshape(-1), check_finite=False)
    return solved.reshape(m, n - 2, 2)


def _measure(surface: Surface, path: Float, fine: int = 4) -> tuple[Float, Float, Bool]:
    """Nodes, lengths and whether all of each line is observed; chords refined and extrapolated."""
    m, n = path.shape[:2]
    t = np.linspace(0, n - 1, (n - 1) * fine + 1)
    i = np.minimum(t.astype(int), n - 2)
    f = (t - i)[None, :, None]
    dense = path[:, i] * (1 - f) + path[:, i + 1] * f
    points, _, supported = _points(surface, dense)
    chord = np.linalg.norm(np.diff(points, axis=1), axis=2).sum(axis=1)
    coarse = np.linalg.norm(np.diff(points[:, ::2], axis=1), axis=2).sum(axis=1)
    return points[:, ::fine], (4 * chord - coarse) / 3, supported.all(axis=1)
