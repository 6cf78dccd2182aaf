"""Distances along the whole surface -> where every sample lies when the item lies flat.

A garment laid flat is a folded isometric image of its surface: between any two points the flat
distance is at most the distance along the cloth, across front and back alike. So every pair has an
upper bound; near pairs of one sheet keep their distance, robustly, since tubes have to crease
somewhere; and otherwise the points spread. No panels, seams or correspondences are needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.values import Bool, Float, Int, Progress, no_progress

SPREAD = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001)  # weight of distances that fall short, in turn


@dataclass(frozen=True, eq=False)
class Distances:
    """Bounds between landmark samples, and from them to every sample."""

    chosen: Int  # (k,) rows of the landmark samples
    bound_m: Float  # (k, k) along the surface, symmetric
    sheet_m: Float  # (k, k) without going round rims; inf where no such path
    rows_m: Float  # (k, n) from each landmark to every sample; inf where no path


def surface_distances(
    a: Int, b: Int, length_m: Float, rim: Bool, count: int, config: RotationConfig
) -> Distances:
    """Shortest paths between farthest-point landmarks of the largest connected piece.

    Parameters
    ----------
    a, b, length_m, rim : ndarray of shape (m,)
        Links between samples, and which of them go round a rim.
    count : int
        Number of samples.
    """
    graph = _graph(a, b, length_m, count)
    piece = connected_components(graph, directed=False)[1]
    inside = piece == np.bincount(piece).argmax()
    if inside.sum() < 0.5 * count:
        raise DisconnectedSurface(
            f"the surface falls into pieces, the largest has {inside.sum()} of {count} samples; "
            "take more views or raise rotation.link_m"
        )
    landmarks = min(config.landmarks, int(inside.sum()))
    chosen = [int(np.flatnonzero(inside)[0])]
    nearest = np.full(count, np.inf)
    rows = np.empty((landmarks, count))
    for k in range(landmarks):
        rows[k] = dijkstra(graph, indices=chosen[-1])
        nearest = np.minimum(nearest, rows[k])
        chosen.append(int(np.where(inside, nearest, -1.0).argmax()))
    picked = np.array(chosen[:-1])
    bound = rows[:, picked]
    sheet_graph = _graph(a[~rim], b[~rim], length_m[~rim], count)
    sheet = dijkstra(sheet_graph, indices=picked, limit=1.2 * config.local_m)[:, picked]
    return Distances(picked, (bound + bound.T) / 2, np.minimum(sheet, sheet.T), rows)


def _graph(a: Int, b: Int, length: Float, count: int) -> csr_matrix:
    rows, columns = np.r_[a, b], np.r_[b, a]
    return csr_matrix((np.r_[length, length], (rows, columns)), shape=(count, count))


def unfold(
    bound: Float, sheet: Float, config: RotationConfig, progress: Progress = no_progress
) -> Float:
    """Plane coordinates that keep the bounds, keep near distances, and spread otherwise.

    Returns
    -------
    ndarray of shape (k, 2)
        Metres; position, rotation and mirror image are arbitrary but repeatable.
    """
    plane = _classical_scaling(bound)
    near = (sheet < 1.05 * bound + 0.003) & (bound < config.local_m)
    rounds = [(spread, k) for spread in SPREAD for k in range(config.unfold_rounds)]
    for done, (spread, _) in enumerate(rounds):
        progress("unfold", done / len(rounds))
        plane = _majorise(plane, bound, near, spread)
    return plane


def _majorise(plane: Float, bound: Float, near: Bool, spread: float) -> Float:
    """Three steps of stress majorisation (de Leeuw 1977) under weights taken from the residuals."""
    k = len(plane)
    safe = np.where(bound > 0, bound, 1.0)
    short = np.maximum(bound - _pairwise(plane), 0.0)
    robust = np.maximum(spread, 1 / (1 + (short / (0.2 * safe)) ** 2))
    weight = np.where(short > 0, np.where(near, robust, spread), 1.0) * (bound > 0) / safe**1.5
    factor = cho_factor(np.diag(weight.sum(1)) - weight + 1 / k)  # 1/k: fixes the centroid
    pull = weight * bound
    for _ in range(3):
        ratio = pull / np.maximum(_pairwise(plane), 1e-9)
        plane = cho_solve(factor, ratio.sum(1)[:, None] * plane - ratio @ plane)
    return plane


def _pairwise(plane: Float) -> Float:
    x, y = plane.T
    return np.sqrt((x[:, None] - x) ** 2 + (y[:, None] - y) ** 2)


def _classical_scaling(bound: Float) -> Float:
    """Torgerson 1952; signs fixed by the largest coordinate, or results flip between machines."""
    squared = bound**2
    gram = -0.5 * (
        squared - squared.mean(0) - squared.mean(1)[:, None] + squared.mean()
    )
    values, axes = np.linalg.eigh(gram)
    axes = axes[:, -2:]
    axes = axes * np.sign(axes[np.abs(axes).argmax(0), [0, 1]])
    plane: Float = axes * np.sqrt(np.maximum(values[-2:], 0.0))
    return plane
