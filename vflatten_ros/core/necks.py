"""Narrow places of the linked surface that a long way round leads past: they may be false.

Where the edge of one layer lies flush with another for some centimetres, no step tells them
apart: the layers are zipped together. Such a zip is a neck: round it the surface falls in two,
and the way from one side to the other without it is long. So are some true strips of cloth
between folds; only the shape that comes out tells which, so that cutting necks is a hypothesis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import (
    breadth_first_order,
    connected_components,
    dijkstra,
    maximum_flow,
)

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.values import Bool, Float, Int

Int32 = NDArray[np.int32]

FIRM_LINKS = 6  # links of a sample where a neck is looked for
CHUNK = 128  # centres at a time: bounds the memory
SIDE = 12  # samples that make a side of a neck
CLOSED_M = 10.0  # length of a link that must not be used
KINK = 0.25  # cosine between chord and normal at which a valley is taken for a contact
UNLIMITED = 1_000_000  # flow into and out of the two sides of a neck


def cut_necks(
    xyz: Float, normal: Float, a: Int, b: Int, length_m: Float, rim: Bool, config: RotationConfig
) -> Bool:
    """Which links remain if every neck is cut that has a long way round.

    Parameters
    ----------
    xyz, normal : ndarray of shape (n, 3)
        Samples and their outward normals.
    a, b, length_m, rim : ndarray of shape (m,)
        Links.

    Returns
    -------
    ndarray of shape (m,)
    """
    n = len(xyz)
    sheet = _graph(a[~rim], b[~rim], length_m[~rim], n)
    whole = _graph(a, b, length_m, n)
    capacity = _graph(a[~rim], b[~rim], _holds(xyz, normal, a, b, config)[~rim], n)
    start = np.repeat(np.arange(n), np.diff(whole.indptr))
    keep = np.ones(len(a), dtype=bool)
    settled = np.zeros(n, dtype=bool)
    centres = _centres(xyz, normal, np.diff(sheet.indptr), 0.4 * config.neck_m)
    for first in range(0, len(centres), CHUNK):
        some = centres[first : first + CHUNK]
        for centre, away in zip(
            some, dijkstra(sheet, indices=some, limit=1.8 * config.neck_m), strict=True
        ):
            sides = _sides(sheet, away, config.neck_m)
            if settled[centre] or len(sides) < 2:
                continue
            sides = _apart(whole, start, away < config.neck_m, sides, config)
            if not sides:
                continue
            part = _parted(capacity, np.flatnonzero(np.isfinite(away)), *sides)
            crossing = keep & ~rim & (part[a] * part[b] == 2)
            keep &= ~crossing
            closed = np.unique(np.r_[a[crossing], b[crossing]])
            between = np.isin(start, closed) & np.isin(whole.indices, closed)
            between &= part[start] * part[whole.indices] == 2
            whole.data[between] = CLOSED_M
            settled[centres[np.linalg.norm(xyz[centres] - xyz[centre], axis=1) < 0.012]] = True
    return keep


def _graph(a: Int, b: Int, values: Float | Int32, n: int) -> csr_matrix:
    return csr_matrix((np.r_[values, values], (np.r_[a, b], np.r_[b, a])), shape=(n, n))


def _holds(xyz: Float, normal: Float, a: Int, b: Int, config: RotationConfig) -> Int32:
    """How firmly each link holds, 1 to 20: hardly across a valley or a step."""
    chord = xyz[b] - xyz[a]
    apart = np.maximum(np.linalg.norm(chord, axis=1), 1e-6)
    valley = np.maximum(0.0, -((normal[b] - normal[a]) * chord).sum(1) / apart)
    mean = normal[a] + normal[b]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    step = np.abs((chord * mean).sum(1))
    firm = np.exp(-valley / KINK - step / (0.7 * config.step_m))
    held: Int32 = np.maximum(1, np.rint(20 * firm)).astype(np.int32)
    return held


def _centres(xyz: Float, normal: Float, degree: Int, apart_m: float) -> Int:
    """One well linked sample of each cube and direction."""
    lead = np.abs(normal).argmax(1)
    ahead = normal[np.arange(len(normal)), lead] > 0
    key = np.c_[np.floor(xyz / apart_m).astype(np.int64), 2 * lead + ahead]
    first = np.unique(key, axis=0, return_index=True)[1]
    chosen: Int = first[degree[first] >= FIRM_LINKS]
    return chosen


def _sides(sheet: csr_matrix, away: Float, neck_m: float) -> list[Int]:
    """Pieces into which the surface round a centre falls without the disc within neck_m."""
    ring = np.flatnonzero((away > neck_m) & np.isfinite(away))
    if len(ring) < 2 * SIDE:
        return []
    label = connected_components(sheet[ring][:, ring], directed=False)[1]
    pieces = [ring[label == k] for k in np.flatnonzero(np.bincount(label) > SIDE)]
    reaching = [p for p in pieces if away[p].max() > 1.8 * neck_m - 0.008]
    return sorted(reaching, key=len, reverse=True)


def _apart(
    whole: csr_matrix, start: Int, disc: Bool, sides: list[Int], config: RotationConfig
) -> list[Int]:
    """The largest piece, and the one that is farthest from it by another way; none if near."""
    closed = whole.copy()
    closed.data[disc[start] | disc[whole.indices]] = CLOSED_M
    row = dijkstra(closed, indices=sides[0][0], limit=CLOSED_M / 2)
    detour = np.array([row[side].min() for side in sides[1:]])
    detour[~np.isfinite(detour)] = 0.0  # no other way: a cut would part the item
    far = int(detour.argmax())
    return [sides[0], sides[1 + far]] if detour[far] > config.detour_m else []


def _parted(capacity: csr_matrix, ball: Int, one: Int, other: Int) -> Int:
    """Weakest cut between two pieces: 1 or 2 by the sample's side of it, 0 outside the ball."""
    n, m = capacity.shape[0], len(ball)
    place = np.zeros(n, dtype=np.int64)
    place[ball] = np.arange(m)
    inner = capacity[ball][:, ball].tocoo()
    row = np.r_[inner.row, np.full(len(one), m), place[other]]
    column = np.r_[inner.col, place[one], np.full(len(other), m + 1)]
    size = np.r_[inner.data, np.full(len(one) + len(other), UNLIMITED)].astype(np.int32)
    network = csr_matrix((size, (row, column)), shape=(m + 2, m + 2))
    left = (network - maximum_flow(network, m, m + 1).flow).tocsr()
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    reached = np.zeros(m + 2, dtype=bool)
    reached[breadth_first_order(left, m, return_predecessors=False)] = True
    part = np.zeros(n, dtype=np.int64)
    part[ball] = np.where(reached[:m], 1, 2)
    return part
