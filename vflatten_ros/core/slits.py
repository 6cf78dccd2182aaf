"""Where cloth lies side by side and does not hang together: between two legs, for one.

Laid flat, the legs of shorts may touch, and from their density alone they look like a skirt. But
the way along the cloth from one leg to the other goes round the end of the slit.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from vflatten_ros.core.distances import pieces
from vflatten_ros.core.sheets import Links
from vflatten_ros.core.values import Bool, Float, Int

BESIDE_M = 0.008  # between the two sides of a slit, most of which is closed
WIDE_M = 0.016  # where it opens
WAY = 6  # links from one side to the other, round a hole in what was seen
LONG_M = 0.06  # shortest slit
STEP_M = 0.004  # along a slit, for each of the points that tell of it
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
    linked = _linked(links.part(~links.rim), len(uv))
    i, j = _torn(uv, side, ends, BESIDE_M, linked)
    middle = (uv[i] + uv[j]) / 2
    label = _stretches(middle)
    long = np.bincount(label) * STEP_M > LONG_M  # fewer points than that cannot be
    found = []
    for k in np.flatnonzero(long):
        own = label == k
        line = middle[own]
        if np.ptp(line, axis=0).max() < LONG_M:
            continue
        centre = line.mean(axis=0)
        thickness, across = (x[-1] for x in np.linalg.svd(line - centre, full_matrices=False)[1:])
        if thickness > THIN_M * np.sqrt(len(line)):
            continue
        if _crossed(uv, side, i[own], j[own], linked).mean() < CROSSED:
            found.append(_widened(line, centre, across, uv, side, ends, linked))
    return found


def _widened(
    line: Float, centre: Float, across: Float, uv: Float, side: Float, ends: Int, linked: csr_matrix
) -> Float:
    """A slit with what it goes on to where its sides are farther apart."""
    straight = ends[np.abs((uv[ends] - centre) @ across) < WIDE_M]
    i, j = _torn(uv, side, straight, WIDE_M, linked)
    middle = (uv[i] + uv[j]) / 2
    middle = middle[np.abs((middle - centre) @ across) < AWAY_M / 2]
    stretch = _stretches(middle)
    wide: Float = middle[np.isin(stretch, stretch[cKDTree(middle).query(line)[1]])]
    return wide


def _torn(uv: Float, side: Float, ends: Int, most_m: float, linked: csr_matrix) -> tuple[Int, Int]:
    """Pairs of some samples of one side that lie side by side and do not hang together."""
    if not len(ends):
        return ends, ends
    i, j = ends[cKDTree(uv[ends]).query_pairs(most_m, output_type="ndarray")].T
    alike = side[i] == side[j]
    i, j = i[alike], j[alike]
    for way in (2, WAY):  # most of them are neighbours
        far = ~_joined_within(way, i, j, linked)
        i, j = i[far], j[far]
    return i, j


def _stretches(points: Float) -> Int:
    """Number of the stretch that each of (m, 2) points belongs to."""
    i, j = cKDTree(points).query_pairs(BESIDE_M, output_type="ndarray").T
    return pieces(i, j, np.ones(len(points), dtype=bool))


def _linked(links: Links, count: int) -> csr_matrix:
    both = (np.r_[links.a, links.b], np.r_[links.b, links.a])
    ones = np.ones(2 * len(links.a), dtype=np.float32)
    return csr_matrix((ones, both), shape=(count, count))


def _joined_within(way: int, i: Int, j: Int, linked: csr_matrix) -> Bool:
    """Whether (m,) pairs of samples hang together by a few links."""
    if not len(i):
        return np.zeros(0, dtype=bool)
    start, which = np.unique(i, return_inverse=True)
    reached = linked[start]
    for _ in range(way - 1):
        reached = reached @ linked
        reached.data[:] = 1.0
    joined: Bool = np.asarray(reached[which, j]).ravel() > 0
    return joined


def _crossed(uv: Float, side: Float, i: Int, j: Int, linked: csr_matrix) -> Bool:
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
        crossed[mine[both]] = _joined_within(WAY, *ends, linked)
    return crossed
