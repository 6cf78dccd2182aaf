"""The paper's own scheme: linear moving least squares and zero-length springs (section 2.1)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.surface import Surface, depth_at
from vflatten_ros.core.values import Bool, Float, Progress
from vflatten_ros.core.weighted_planes import linear_fit, view_frame

RATE = 0.4  # of the spring force that a node moves in one step; 0.5 is the limit of stability
STEPS = 4000
TOLERANCE = 5e-5  # relative change of length over 20 steps


def relax_springs(surface: Surface, path: Float, progress: Progress) -> tuple[Float, Bool, Bool]:
    """Zero-length springs with tangential forces (eq. 6), all lines at once.

    Parameters
    ----------
    path : ndarray of shape (m, M, 2)
        First guess, grid places.

    Returns
    -------
    nodes (m, M, 3), held (m, M) nodes without enough points around them, converged (m,)
    """
    frame = view_frame(surface.toward)
    depth, _, _ = depth_at(surface, path.reshape(-1, 2))
    start = surface.rays.to_points(path, depth.reshape(path.shape[:2])) @ frame.T
    points = surface.raw @ frame.T
    tree = cKDTree(points[:, :2])
    radius = surface.config.radius_m
    most = int(3.3 * (radius / surface.spacing_m) ** 2) + 12
    nodes, normal, held = _onto(points, tree, start, np.ones_like(start), radius, most)
    alive = ~held.any(axis=1)
    converged = np.zeros(len(path), bool)
    before = np.full(len(path), np.inf)
    for step in range(STEPS):
        live = np.flatnonzero(alive & ~converged)
        if not len(live):
            break
        p, n = nodes[live], normal[live]
        force = p[:, :-2] - 2 * p[:, 1:-1] + p[:, 2:]
        force -= np.einsum("mni,mni->mn", force, n[:, 1:-1])[..., None] * n[:, 1:-1]
        p[:, 1:-1] += RATE * force
        moved, turned, off = _onto(points, tree, p[:, 1:-1], n[:, 1:-1], radius, most)
        nodes[live, 1:-1] = np.where(off[..., None], nodes[live, 1:-1], moved)
        normal[live, 1:-1] = turned
        held[live, 1:-1] |= off
        if step % 20 == 19:
            progress("geodesics", 0.3 + 0.6 * step / STEPS)
            length = np.linalg.norm(np.diff(nodes[live], axis=1), axis=2).sum(axis=1)
            converged[live] = np.abs(length - before[live]) < TOLERANCE * length
            before[live] = length
    return nodes @ frame, held, converged


def _onto(
    points: Float, tree: cKDTree, p: Float, normal: Float, radius_m: float, most: int
) -> tuple[Float, Float, Bool]:
    """(m, n, 3) nodes put onto z(x, y), their normals, and which have too few points around."""
    z, turned, supported = linear_fit(points, tree, p.reshape(-1, 3)[:, :2], radius_m, most)
    shape = p.shape[:2]
    ok = supported.reshape(shape)
    out = p.copy()
    out[..., 2] = np.where(ok, z.reshape(shape), p[..., 2])
    return out, np.where(ok[..., None], turned.reshape(*shape, 3), normal), ~ok
