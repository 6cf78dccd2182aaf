"""Where cloth lies side by side and does not hang together: between two legs, for one.

Laid flat, the legs of shorts may touch, and from their density alone they look like a skirt. But
the way along the cloth from one leg to the other goes round the end of the slit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.distances import pieces
from vflatten_ros.core.sheets import Links
from vflatten_ros.core.values import Bool, Float, Int

BESIDE = 2.0  # between the two sides of a slit, most of which is closed, in spacings of the samples
WIDE = 4.0  # the same where it opens
WAY_M = 0.053  # over links from one side to the other, round a hole in what was seen
LONG_M = 0.06  # shortest slit
SEED_M, SEED_THIN = 0.05, 0.3  # least of it that is closed and in one, and how straight that is
AWAY = 3.0  # from the middle of a slit, where another layer may go on across it, in spacings
THIN = 0.625  # deviation across a slit, in spacings: straight, as what noise tears is not
CROSSED = 0.5  # share of a slit that another layer crosses, for the item to have none there


def slits(uv: Float, side: Float, edge: Int, links: Links, config: RotationConfig) -> list[Float]:
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
    config : RotationConfig
        How far apart samples are, and how far links reach.

    Returns
    -------
    list of ndarray of shape (m, 2)
        Of each, midway between samples of the same side that lie side by side, at edges of sheets,
        without a way from one to the other of a few links.
    """
    ends, laid = _laid(uv, side, edge, links, config)
    i, j = _torn(laid, ends, BESIDE * laid.spacing_m)
    middle = (uv[i] + uv[j]) / 2
    label = stretches(middle, BESIDE * laid.spacing_m)
    long = np.bincount(label) * laid.spacing_m > SEED_M  # fewer points than that cannot be
    found = []
    for k in np.flatnonzero(long):
        own = label == k
        line = middle[own]
        if np.ptp(line, axis=0).max() < SEED_M:
            continue
        centre, across, thickness = _straight(line)
        thin = THIN if np.ptp(line, axis=0).max() >= LONG_M else SEED_THIN
        if thickness > thin * laid.spacing_m:
            continue
        if _crossed(laid, i[own], j[own]).mean() >= CROSSED:
            continue
        wide = _widened(laid, line, centre, across, ends)
        if np.ptp(wide, axis=0).max() >= LONG_M:
            found.append(wide)
    return found


def torn(
    uv: Float, side: Float, edge: Int, links: Links, config: RotationConfig
) -> tuple[Int, Int]:
    """Pairs (m,) of samples of one side that lie side by side and do not hang together.

    Parameters
    ----------
    uv, side, edge, links, config
        As for slits.
    """
    ends, laid = _laid(uv, side, edge, links, config)
    return _torn(laid, ends, BESIDE * laid.spacing_m)


def stretches(points: Float, reach_m: float) -> Int:
    """Which points hang together over steps of at most some length.

    There may be millions of pairs so near, and most are not looked at: all points in a square of
    that diagonal are near each other, its outermost ones join it to the next squares, and all pairs
    are looked at only of what is then not in the largest stretch.

    Parameters
    ----------
    points : ndarray of shape (m, 2)
    reach_m : float

    Returns
    -------
    ndarray of shape (m,)
        Number of the stretch that each belongs to.
    """
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    everywhere = np.ones(len(points), dtype=bool)
    square = np.floor(points / (0.7 * reach_m)).astype(np.int64)
    square -= square.min(axis=0)
    number = square[:, 0] * (square[:, 1].max() + 1) + square[:, 1]
    ordered = [np.lexsort((along, number)) for along in points.T]
    by_u = ordered[0]
    alike = number[by_u[1:]] == number[by_u[:-1]]
    first, last = np.r_[True, ~alike], np.r_[~alike, True]
    outermost = np.unique(np.concatenate([order[first | last] for order in ordered]))
    i, j = cKDTree(points[outermost]).query_pairs(reach_m, output_type="ndarray").T
    one = np.r_[by_u[:-1][alike], outermost[i]]
    other = np.r_[by_u[1:][alike], outermost[j]]
    joined = pieces(one, other, everywhere)
    rest = np.flatnonzero(joined != np.bincount(joined).argmax())
    pairs = cKDTree(points[rest]).sparse_distance_matrix(
        cKDTree(points), reach_m, output_type="coo_matrix"
    )
    return pieces(np.r_[one, rest[pairs.row]], np.r_[other, pairs.col], everywhere)


def _straight(line: Float) -> tuple[Float, Float, float]:
    """Middle of (m, 2) points along a line, the unit vector across, their deviation from it.

    Strays beside a slit hang on it here and there: the deviation is that of most points.
    """
    core = line
    for _ in range(2):
        centre = core.mean(axis=0)
        across = np.linalg.svd(core - centre, full_matrices=False)[2][-1]
        off = (line - centre) @ across
        off -= np.median(off)
        deviation = min(1.4826 * float(np.median(np.abs(off))), float(off.std()))
        core = line[np.abs(off) <= 3.0 * deviation]
    return centre, across, deviation


@dataclass(frozen=True, eq=False)
class _Laid:
    """Samples as they lie flat."""

    uv: Float  # (n, 2)
    side: Float  # (n,)
    linked: csr_matrix  # (n, n) along the sheet
    config: RotationConfig

    @property
    def spacing_m(self) -> float:
        return self.config.spacing_m

    @property
    def way(self) -> int:
        """Links that a way round a hole has at most."""
        return max(2, round(WAY_M / self.config.link_m))


def _laid(
    uv: Float, side: Float, edge: Int, links: Links, config: RotationConfig
) -> tuple[Int, _Laid]:
    ends = np.flatnonzero((edge > 0) & (side != 0))
    return ends, _Laid(uv, side, _linked(links.part(~links.rim), len(uv)), config)


def _widened(laid: _Laid, line: Float, centre: Float, across: Float, ends: Int) -> Float:
    """A slit with what it goes on to where its sides are farther apart."""
    uv, wide_m = laid.uv, WIDE * laid.spacing_m
    straight = ends[np.abs((uv[ends] - centre) @ across) < wide_m]
    i, j = _torn(laid, straight, wide_m)
    middle = (uv[i] + uv[j]) / 2
    middle = middle[np.abs((middle - centre) @ across) < AWAY / 2 * laid.spacing_m]
    stretch = stretches(middle, BESIDE * laid.spacing_m)
    wide: Float = middle[np.isin(stretch, stretch[cKDTree(middle).query(line)[1]])]
    return wide


def _torn(laid: _Laid, ends: Int, most_m: float) -> tuple[Int, Int]:
    """Pairs of some samples of one side that lie side by side and do not hang together."""
    if not len(ends):
        return ends, ends
    i, j = ends[cKDTree(laid.uv[ends]).query_pairs(most_m, output_type="ndarray")].T
    alike = laid.side[i] == laid.side[j]
    i, j = i[alike], j[alike]
    for way in (2, laid.way):  # most of them are neighbours
        far = ~_joined_within(way, i, j, laid.linked)
        i, j = i[far], j[far]
    return i, j


def _linked(links: Links, count: int) -> csr_matrix:
    both = (np.r_[links.a, links.b], np.r_[links.b, links.a])
    ones = np.ones(2 * len(links.a), dtype=np.float32)
    return csr_matrix((ones, both), shape=(count, count))


def _joined_within(way: int, i: Int, j: Int, linked: csr_matrix) -> Bool:
    """Whether (m,) pairs of samples hang together by a few links."""
    if not len(i):
        return np.zeros(0, dtype=bool)
    # ways from both ends meet half way: far fewer are looked at
    from_i, from_j = _ways_from(i, way - way // 2, linked), _ways_from(j, way // 2, linked)
    joined: Bool = np.asarray(from_i.multiply(from_j).sum(axis=1)).ravel() > 0
    return joined


def _ways_from(sample: Int, way: int, linked: csr_matrix) -> csr_matrix:
    """(m, n) what some samples reach over as many links."""
    start, which = np.unique(sample, return_inverse=True)
    reached = linked[start]
    for _ in range(way - 1):
        reached = reached @ linked
        reached.data[:] = 1.0
    return reached[which]


def _crossed(laid: _Laid, i: Int, j: Int) -> Bool:
    """Whether cloth of the other side runs across between (m,) pairs."""
    uv, side, away_m = laid.uv, laid.side, AWAY * laid.spacing_m
    middle, over = (uv[i] + uv[j]) / 2, uv[j] - uv[i]
    over *= away_m / np.maximum(np.linalg.norm(over, axis=1, keepdims=True), 1e-9)
    crossed = np.zeros(len(i), dtype=bool)
    for up in (-1.0, 1.0):
        mine, theirs = np.flatnonzero(side[i] == up), np.flatnonzero(side == -up)
        if not len(theirs):
            continue
        tree = cKDTree(uv[theirs])
        one, other = (
            tree.query(middle[mine] + way * over[mine], distance_upper_bound=away_m / 3)[1]
            for way in (-1, 1)
        )
        both = (one < len(theirs)) & (other < len(theirs))
        ends = theirs[one[both]], theirs[other[both]]
        crossed[mine[both]] = _joined_within(laid.way, *ends, laid.linked)
    return crossed
