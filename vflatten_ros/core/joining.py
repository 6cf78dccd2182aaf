"""Pieces of the surface that hang together through doubtful places only, put in their place.

Each piece is laid flat by itself. Paths through what is in doubt tie one piece to another, rightly
or not; the right ones agree on one rigid motion of the one piece against the other, as far apart
as they may be, and the wrong ones do not (Fischler & Bolles 1981).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from vflatten_ros.core.distances import pieces
from vflatten_ros.core.sheets import Links
from vflatten_ros.core.values import Bool, Float, Int

PATH_M = 0.008  # samples this near to a path through doubtful ones are trusted with it
FAR_M = 0.06  # longest path through doubtful samples
AGREE_M = 0.012  # ties that are met within this agree
APART_M = 0.03  # two ties nearer than this do not tell a direction
CELL_M = 0.010  # ties in the same cell count once
MOST_TIES = 150


@dataclass(frozen=True, eq=False)
class Ties:
    """Paths from one piece to another."""

    one: Int  # (t,) samples where they start
    other: Int  # (t,) samples where they end
    before: Int  # (n,) sample before each on its path, negative at the start
    length_m: Float  # (t,)

    def along(self, which: Int) -> Int:
        """Samples on some of the paths."""
        at = np.unique(self.other[which])
        found = [at]
        while len(at):
            at = np.unique(self.before[at])
            at = at[at >= 0]
            found.append(at)
        samples: Int = np.unique(np.concatenate(found))
        return samples


def largest_pieces(links: Links, passable: Bool, least: int) -> list[Bool]:
    """Masks (n,) of the pieces with more samples than `least`, largest first."""
    piece = pieces(links.a, links.b, passable)
    size = np.bincount(piece[passable], minlength=1)
    order = np.argsort(-size, kind="stable")
    return [passable & (piece == k) for k in order if size[k] > least]


def find_ties(links: Links, one: Bool, other: Bool) -> Ties:
    """Shortest paths from `one` piece to every sample of the `other` that none shorter leads to."""
    n = len(one)
    start, end = np.r_[links.a, links.b], np.r_[links.b, links.a]
    usable = ~one[end] & ~other[start]
    length = np.r_[links.length_m, links.length_m][usable]
    graph = csr_matrix((length, (start[usable], end[usable])), shape=(n, n))
    away, before, source = dijkstra(
        graph,
        indices=np.flatnonzero(one),
        min_only=True,
        return_predecessors=True,
        limit=FAR_M,
    )
    reached = np.flatnonzero(other & np.isfinite(away))
    reached = reached[np.argsort(away[reached], kind="stable")]
    return Ties(source[reached].astype(np.int64), reached, before.astype(np.int64), away[reached])


def agreeing(one: Float, other: Float, length_m: Float) -> Bool:
    """Which ties one rigid motion of the other piece meets: those in the most places.

    Parameters
    ----------
    one, other : ndarray of shape (t, 2)
        Ends of the ties in the plane of either piece.
    length_m : ndarray of shape (t,)
        How far apart the ends may be.

    Returns
    -------
    ndarray of shape (t,)
        None if no two of them agree that are apart.
    """
    none = np.zeros(len(one), dtype=bool)
    picked = _spread(other)
    first, second = np.triu_indices(len(picked), 1)
    first, second = picked[first], picked[second]
    p, q = one @ np.array([1, 1j]), other @ np.array([1, 1j])
    along, against = p[second] - p[first], q[second] - q[first]
    alike = (np.abs(against) > APART_M) & (np.abs(np.abs(along) - np.abs(against)) < AGREE_M)
    first, along, against = first[alike], along[alike], against[alike]
    if not len(first):
        return none
    cell = np.unique(np.floor(other / CELL_M).astype(np.int64), axis=0, return_inverse=True)[1]
    best, met_best = 0.0, none
    for mirrored in (False, True):
        there = q.conj() if mirrored else q
        turn = along / (against.conj() if mirrored else against)
        turn /= np.abs(turn)
        for k in range(len(first)):
            moved = p[first[k]] + turn[k] * (there - there[first[k]])
            met = np.abs(moved - p) < AGREE_M + length_m
            places = len(np.unique(cell[met])) - float(length_m[met].sum()) / max(met.sum(), 1)
            if places > best:
                best, met_best = places, met
    return met_best


def _spread(points: Float) -> Int:
    """Rows of some points, one a cell at the most, evenly chosen if there are many."""
    cells = np.floor(points / CELL_M).astype(np.int64)
    rows: Int = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    if len(rows) > MOST_TIES:
        rows = rows[np.linspace(0, len(rows) - 1, MOST_TIES).astype(int)]
    return rows


def near_paths(xyz: Float, on_paths: Int) -> Bool:
    """Samples (n,) on or beside paths."""
    near = cKDTree(xyz[on_paths]).query(xyz, distance_upper_bound=PATH_M)[0]
    found: Bool = np.isfinite(near)
    return found
