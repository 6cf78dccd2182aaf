"""Where cloth lies side by side and does not hang together: between two legs, for one.

Laid flat, the legs of shorts may touch, and from their density alone they look like a skirt. But
the way along the cloth from one leg to the other goes round the end of the slit.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from vflatten_ros.core.sheets import Links
from vflatten_ros.core.values import Bool, Float, Int

BESIDE_M = 0.008  # between the two sides of a slit, most of which is closed
WIDE_M = 0.016  # where it opens
WAY = 6  # links from one side to the other, round a hole in what was seen
LONG_M = 0.06  # shortest slit
AWAY_M = 0.012  # from the middle of a slit, where another layer may go on across it
THIN_M = 0.0025  # standard deviation across a slit: straight, as what is torn by noise is not
CROSSED = 0.5  # share of a slit that another layer crosses, for the item to have none there


def slits(uv: Float, side: Float, edge: Int, links: Links) -> list[Float]:
    """Points along slits, and along edges that look like one: the sides of a rim, for one.

    Parameters
    ----------
    uv : ndarray of shape (n, 2)
        Places of the samples.
    side : ndarray of shape (n,)
        1 outside up, -1 outside down, 0 unclear.
    edge : ndarray of shape (n,)
        Above 0 where what was seen of a sheet ends.
    links : Links
        Between the samples.

    Returns
    -------
    list of ndarray of shape (m, 2)
        Of each, midway between samples of the same side that lie side by side, at edges of sheets,
        without a way from one to the other of a few links.
    """
    ends = np.flatnonzero((edge > 0) & (side != 0))
    if not len(ends):
        return []
    i, j = ends[cKDTree(uv[ends]).query_pairs(WIDE_M, output_type="ndarray")].T
    alike = side[i] == side[j]
    i, j = i[alike], j[alike]
    sheet = links.part(~links.rim)
    for way in (2, WAY):  # most of them are neighbours
        far = ~_joined_within(way, i, j, sheet, len(uv))
        i, j = i[far], j[far]
    if not len(i):
        return []
    middle = (uv[i] + uv[j]) / 2
    narrow = np.flatnonzero(np.linalg.norm(uv[i] - uv[j], axis=1) < BESIDE_M)
    crossed = _crossed(uv, side, i[narrow], j[narrow], sheet)
    label = _stretches(middle[narrow])
    found = []
    for k in range(label.max(initial=-1) + 1):
        line = middle[narrow[label == k]]
        if np.ptp(line, axis=0).max() < LONG_M:
            continue
        centre = line.mean(axis=0)
        thickness, across = (x[-1] for x in np.linalg.svd(line - centre, full_matrices=False)[1:])
        if thickness < THIN_M * np.sqrt(len(line)) and crossed[label == k].mean() < CROSSED:
            # where it opens, its sides are farther apart
            straight = middle[np.abs((middle - centre) @ across) < AWAY_M / 2]
            stretch = _stretches(straight)
            own = stretch[cKDTree(straight).query(line)[1]]
            found.append(straight[np.isin(stretch, own)])
    return found


def _stretches(points: Float) -> Int:
    """Number of the stretch that each of (m, 2) points belongs to."""
    i, j = cKDTree(points).query_pairs(BESIDE_M, output_type="ndarray").T
    ones = np.ones(len(i), dtype=bool)
    graph = csr_matrix((ones, (i, j)), shape=(len(points), len(points)))
    label: Int = connected_components(graph, directed=False)[1]
    return label


def _joined_within(way: int, i: Int, j: Int, links: Links, count: int) -> Bool:
    """Whether (m,) pairs of samples hang together by a few links."""
    if not len(i):
        return np.zeros(0, dtype=bool)
    start, which = np.unique(i, return_inverse=True)
    both = (np.r_[links.a, links.b], np.r_[links.b, links.a])
    linked = csr_matrix((np.ones(2 * len(links.a), dtype=np.float32), both), shape=(count, count))
    reached = linked[start]
    for _ in range(way - 1):
        reached = reached @ linked
        reached.data[:] = 1.0
    joined: Bool = np.asarray(reached[which, j]).ravel() > 0
    return joined


def _crossed(uv: Float, side: Float, i: Int, j: Int, sheet: Links) -> Bool:
    """Whether cloth of the other side runs across between (m,) pairs."""
    middle, over = (uv[i] + uv[j]) / 2, uv[j] - uv[i]
    over *= AWAY_M / np.maximum(np.linalg.norm(over, axis=1, keepdims=True), 1e-9)
    crossed = np.zeros(len(i), dtype=bool)
    for up in (-1.0, 1.0):
        mine, theirs = np.flatnonzero(side[i] == up), np.flatnonzero(side == -up)
        if not len(theirs):
            continue
        tree = cKDTree(uv[theirs])
        one, other = (
            tree.query(middle[mine] + way * over[mine], distance_upper_bound=AWAY_M / 3)[1]
            for way in (-1, 1)
        )
        both = (one < len(theirs)) & (other < len(theirs))
        ends = theirs[one[both]], theirs[other[both]]
        crossed[mine[both]] = _joined_within(WAY, *ends, sheet, len(uv))
    return crossed
