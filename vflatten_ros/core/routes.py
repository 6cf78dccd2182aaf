"""First guesses of lines that stay on the observed surface: shortest routes on a coarse grid."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from vflatten_ros.core.breaks import Layers, joined_places
from vflatten_ros.core.geometry import Float
from vflatten_ros.core.values import Int

MOST_PLACES = 4000
STEPS = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))
OFF_SURFACE = 3.0  # a gap costs this many times its length: routes keep to the surface


def find_routes(
    layers: Layers, points: Float, starts: Float, ends: Float, nodes: int, bridge: bool
) -> tuple[Float, Float]:
    """Shortest routes over the grid.

    Parameters
    ----------
    layers : Layers
    points : ndarray of shape (rows, cols, 3)
        Surface at the grid places, any value where not valid.
    starts, ends : ndarray of shape (m, 2)
        Grid places.
    nodes : int
        Nodes of each route.
    bridge : bool
        Whether routes may cross jumps and missing data, at a price.

    Returns
    -------
    routes : ndarray of shape (m, nodes, 2)
        Grid places, evenly spread; the straight line where nothing joins the ends.
    length : ndarray of shape (m,)
        Inf where nothing joins the ends.
    """
    rows, cols = _coarse_places(layers, bridge)
    place = np.stack([rows, cols], axis=1)
    stride = max(1, int(np.diff(np.unique(rows)).min())) if len(np.unique(rows)) > 1 else 1
    at = _filled(layers, points) if bridge else points
    graph = _graph(layers, at, place, stride, bridge)
    tree = cKDTree(place)
    first, last = tree.query(starts)[1], tree.query(ends)[1]
    sources, which = np.unique(first, return_inverse=True)
    cost, before = dijkstra(graph, directed=False, indices=sources, return_predecessors=True)
    length = cost[which, last]
    routes = np.empty((len(starts), nodes, 2))
    for k in range(len(starts)):
        middle = _walk(before[which[k]], int(last[k])) if np.isfinite(length[k]) else []
        corners = np.concatenate(
            [starts[k : k + 1], place[middle[1:-1]].reshape(-1, 2), ends[k : k + 1]]
        )
        routes[k] = _even(corners, nodes)
    return routes, length


def _coarse_places(layers: Layers, bridge: bool) -> tuple[Int, Int]:
    """Places on a coarser grid, few enough for fast routes."""
    wanted = layers.valid
    if bridge:
        r, c = np.nonzero(layers.valid)
        wanted = np.zeros_like(layers.valid)
        wanted[r.min() : r.max() + 1, c.min() : c.max() + 1] = True
    stride = max(1, int(np.ceil(np.sqrt(wanted.sum() / MOST_PLACES))))
    coarse = np.zeros_like(wanted)
    coarse[stride // 2 :: stride, stride // 2 :: stride] = True
    rows, cols = np.nonzero(wanted & coarse)
    return rows, cols


def _graph(layers: Layers, points: Float, place: Int, stride: int, bridge: bool) -> coo_matrix:
    number = np.full(layers.valid.shape, -1)
    number[place[:, 0], place[:, 1]] = np.arange(len(place))
    a, b, weight = [], [], []
    samples = np.linspace(0, 1, 4 * stride + 1)
    for step in STEPS:
        to = place + np.array(step) * stride
        inside = ((to >= 0) & (to < layers.valid.shape)).all(axis=1)
        head, tail = place[inside], to[inside]
        known = number[tail[:, 0], tail[:, 1]] >= 0
        head, tail = head[known], tail[known]
        line = head[:, None] + samples[None, :, None] * (tail - head)[:, None]
        open_way = joined_places(layers, line + 1e-6)[1].all(axis=1)
        length = np.linalg.norm(
            points[head[:, 0], head[:, 1]] - points[tail[:, 0], tail[:, 1]], axis=1
        )
        keep = np.ones(len(head), bool) if bridge else open_way
        a.append(number[head[:, 0], head[:, 1]][keep])
        b.append(number[tail[:, 0], tail[:, 1]][keep])
        weight.append((np.where(open_way, 1.0, OFF_SURFACE) * length)[keep] + 1e-9)
    size = len(place)
    return coo_matrix(
        (np.concatenate(weight), (np.concatenate(a), np.concatenate(b))), shape=(size, size)
    ).tocsr()


def _filled(layers: Layers, points: Float) -> Float:
    """Points with those of the nearest valid place where there is none."""
    _, nearest = distance_transform_edt(~layers.valid, return_indices=True)
    return np.asarray(points[nearest[0], nearest[1]])


def _walk(before: Int, last: int) -> list[int]:
    way = [last]
    while before[way[-1]] >= 0:
        way.append(int(before[way[-1]]))
    return way[::-1]


def _even(corners: Float, nodes: int) -> Float:
    """(nodes, 2) places evenly spread along a polyline."""
    done = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    t = np.linspace(0.0, done[-1], nodes)
    return np.stack([np.interp(t, done, corners[:, i]) for i in (0, 1)], axis=1)
