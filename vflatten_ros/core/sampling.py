"""Evenly spread samples of a surface, and which of them are neighbours on it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.values import Float, Int

APART = 0.6  # nearest samples, in spacings


def thinned(points: Float, group: Int, spacing_m: float) -> Int:
    """Rows of points spread evenly over every group.

    Parameters
    ----------
    points : ndarray of shape (n, 3)
    group : ndarray of shape (n,)
        Points of different groups do not thin one another.
    spacing_m : float
        Distance of neighbouring samples, about.

    Returns
    -------
    ndarray of shape (k,), ascending
    """
    cell = np.floor(points / spacing_m)
    off = np.linalg.norm(points - (cell + 0.5) * spacing_m, axis=1)
    key = np.column_stack([cell.astype(np.int64), group])
    order = np.lexsort((off, *key.T))
    ordered = key[order]
    first = np.r_[True, (ordered[1:] != ordered[:-1]).any(axis=1)] if len(order) else order > 0
    kept = np.sort(order[first])
    pairs = cKDTree(_split(points[kept], group[kept])).query_pairs(
        APART * spacing_m, output_type="ndarray"
    )
    dropped = np.zeros(len(kept), dtype=bool)
    for i, j in pairs[np.lexsort(pairs.T[::-1])]:
        if not dropped[i]:
            dropped[j] = True
    return kept[~dropped]


def neighbours(points: Float, normals: Float, group: Int, reach_m: float) -> tuple[Int, Int]:
    """Pairs of samples of one group that are near along the surface, not only in space.

    Parameters
    ----------
    points, normals : ndarray of shape (n, 3)
    group : ndarray of shape (n,)
    reach_m : float
        Longest chord.

    Returns
    -------
    i, j : ndarray of shape (m,), i < j, sorted
    """
    pairs = cKDTree(_split(points, group)).query_pairs(reach_m, output_type="ndarray")
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    i, j = pairs.T
    chord = points[j] - points[i]
    middle = normals[i] + normals[j]
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-9)
    alike = np.einsum("ij,ij->i", normals[i], normals[j]) > 0.3
    off = np.abs(np.einsum("ij,ij->i", chord, middle))
    on_surface = alike & (off < 0.5 * np.linalg.norm(chord, axis=1) + 0.001)
    return i[on_surface], j[on_surface]


def same_surface(
    points_a: Float,
    normals_a: Float,
    points_b: Float,
    normals_b: Float,
    reach_m: float,
    step_m: float,
) -> tuple[Int, Int]:
    """Pairs of samples of two views that show the same cloth: near, alike in direction, no step.

    Returns
    -------
    i, j : ndarray of shape (m,)
        Rows of the first and of the second view; up to three partners for every row of the second.
    """
    partners = min(3, len(points_a))
    distance, near = cKDTree(points_a).query(points_b, k=partners, distance_upper_bound=reach_m)
    j = np.repeat(np.arange(len(points_b)), partners)
    found = np.isfinite(distance.reshape(-1))
    i, j = near.reshape(-1)[found], j[found]
    middle = normals_a[i] + normals_b[j]
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-9)
    alike = np.einsum("ij,ij->i", normals_a[i], normals_b[j]) > 0.8
    off = np.abs(np.einsum("ij,ij->i", points_b[j] - points_a[i], middle))
    same = alike & (off < step_m)
    return i[same], j[same]


def _split(points: Float, group: Int) -> Float:
    """Points of different groups, moved far apart in a fourth dimension."""
    return np.column_stack([points, 1e3 * group])
