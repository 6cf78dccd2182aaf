"""Which two views serve the paper's method best, before either is flattened.

A view shows smooth patches of cloth; two views join the patches that they have in common. What
hangs together in this way is the piece that would be flattened. The best pair shows about one side
of the item, half of all cloth that any view shows, in one piece, and the piece ends where the item
ends, not where other cloth hides it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from vflatten_ros.core.config import Config
from vflatten_ros.core.correspondences import PlacedView
from vflatten_ros.core.patches import find_patches
from vflatten_ros.core.turntable import angle_between
from vflatten_ros.core.values import Float, Int

POINTS = 400  # of a view that are compared, evenly chosen
SAME_M = 0.006  # points of two views nearer than this, along the cloth, show the same
STEP_M = 0.002  # and nearer than this across it
ALIKE = 0.7  # and whose normals have at least this cosine
TOUCHING = 3  # compared points that two patches must have in common to be joined
LOOSE_COUNTS = 0.5  # other pieces that the two views join: they are placed less surely
OPEN_COUNTS = 0.5  # power: ends also fall together with folds, which do no harm
WIDEST_AREA = 4.0  # a pixel stands for at most so many times the area that it would have face on


@dataclass(frozen=True, eq=False)
class _Shown:
    """Evenly chosen points of one view's surface."""

    points: Float  # (n, 3) common frame
    normals: Float  # (n, 3)
    patch: Int  # (n,) -1: none
    area_m2: Float  # (n,) of cloth that the point stands for
    all: PlacedView
    all_patch: Int  # of every point of the view's surface
    end: Float  # (patches,) pixels at the ends of each patch
    hidden: Float  # (patches,) those of them beyond which nearer cloth hides it


@dataclass(frozen=True)
class PairValue:
    """How well two views would do."""

    view_a: int  # view_id
    view_b: int
    common_m2: float  # cloth that both show in the piece
    own_m2: tuple[float, float]  # that only the one, only the other shows in it
    half_m2: float  # half of all cloth that the views show: one side
    open: float  # 0-1, share of the piece's ends where the item may end
    value: float  # higher is better


def pair_values(placed: Sequence[PlacedView], config: Config) -> list[PairValue]:
    """All pairs of views, the best first.

    Parameters
    ----------
    placed : sequence of PlacedView
        Of one registration.
    config : Config
    """
    shown = [_shown(view, config) for view in placed]
    angle = [view.view.angle_rad for view in placed]
    n = len(shown)
    covered = [np.ones(len(s.points)) for s in shown]
    partner: dict[tuple[int, int], Int] = {}
    for i in range(n):
        for j in range(n):
            if i != j and angle_between(angle[i], angle[j]) < np.radians(config.views.apart_deg):
                partner[i, j] = _partners(shown[i], placed[j])
                covered[i] += partner[i, j] >= 0
    whole = sum(float((s.area_m2 / c).sum()) for s, c in zip(shown, covered, strict=True))
    found = []
    for i, j in partner:
        if i < j:
            ids = placed[i].view.view_id, placed[j].view.view_id
            found.append(_value(ids, shown[i], shown[j], partner[i, j], partner[j, i], whole))
    return sorted(found, key=lambda pair: (-pair.value, pair.view_a, pair.view_b))


def _shown(placed: PlacedView, config: Config) -> _Shown:
    view = placed.view
    depth = view.points_rig[:, 2] if view.shape[0] > 1 else None
    if depth is None:  # an unorganised cloud: patches are not known, all is one
        patch = np.zeros(len(view.points_rig), dtype=np.int64)
        end = hidden = np.ones(1)
    else:
        found = find_patches(view.pixel.astype(np.int64), depth, config.patches)
        patch = found.patch
        at, beyond = found.ends.T
        count = int(patch.max(initial=-1)) + 1
        before = (beyond >= 0) & (depth[beyond] < depth[at] + config.patches.step_m)
        on = patch[at] >= 0
        end = np.bincount(patch[at[on]], minlength=count).astype(float)
        hidden = np.bincount(patch[at[on & before]], minlength=count).astype(float)
    step = max(1, len(placed.points) // POINTS)
    rows = np.arange(0, len(placed.points), step)
    away = np.linalg.norm(view.points_rig[placed.row[rows]], axis=1)
    per_pixel = (
        _pixel_m(view.pixel.astype(np.int64), view.points_rig) ** 2 * (away / np.median(away)) ** 2
    )
    area = step * per_pixel / np.maximum(placed.facing[rows], 1 / WIDEST_AREA)
    points = placed.points[rows]
    patch = patch[placed.row]
    return _Shown(points, placed.normals[rows], patch[rows], area, placed, patch, end, hidden)


def _pixel_m(pixel: Int, points: Float) -> float:
    """Size of a pixel at the item: what height it shows by the rows that it fills."""
    rows = np.ptp(pixel[:, 0])
    if rows < 2:
        return float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))
    top, bottom = pixel[:, 0] == pixel[:, 0].min(), pixel[:, 0] == pixel[:, 0].max()
    across = points[top].mean(axis=0) - points[bottom].mean(axis=0)
    return float(np.linalg.norm(across[:2]) / rows)


def _partners(a: _Shown, b: PlacedView) -> Int:
    """(n,) point of b's surface that shows the same cloth as each of a's points, -1: none."""
    distance, near = b.tree.query(a.points, distance_upper_bound=SAME_M)
    found = np.flatnonzero(np.isfinite(distance))
    j = near[found]
    apart = b.points[j] - a.points[found]
    middle = a.normals[found] + b.normals[j]
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-9)
    same = (a.normals[found] * b.normals[j]).sum(1) > ALIKE
    same &= np.abs((apart * middle).sum(1)) < STEP_M
    partner = np.full(len(a.points), -1, dtype=np.int64)
    partner[found[same]] = j[same]
    return partner


def _value(
    ids: tuple[int, int], a: _Shown, b: _Shown, in_b: Int, in_a: Int, whole_m2: float
) -> PairValue:
    """The largest piece that joins patches of both views."""
    count = len(a.end), len(b.end)
    both = np.flatnonzero(in_b >= 0)
    p, q = a.patch[both], b.all_patch[in_b[both]]
    on = (p >= 0) & (q >= 0)
    table = np.zeros(count)
    np.add.at(table, (p[on], q[on]), 1.0)
    i, j = np.nonzero(table >= TOUCHING)
    graph = coo_matrix((np.ones(len(i)), (i, count[0] + j)), shape=(sum(count),) * 2)
    piece = connected_components(graph, directed=False)[1]
    piece_a, piece_b = (
        np.append(own, -1)[s.patch]  # none for points in no patch, if there is any
        for s, own in ((a, piece[: count[0]]), (b, piece[count[0] :]))
    )
    also = (in_a >= 0) & (a.all_patch[in_a] >= 0)
    half = max(0.5 * whole_m2, 1e-9)
    sizes, free = [], []
    common = own_a = own_b = 0.0
    for number in np.intersect1d(piece[: count[0]], piece[count[0] :]):
        of_a, of_b, mine = piece_a == number, piece_b == number, piece == number
        shared = float(b.area_m2[of_b & also].sum())
        only = max(float(a.area_m2[of_a].sum()) - shared, 0.0), float(b.area_m2[of_b & ~also].sum())
        end = float(np.r_[a.end, b.end][mine].sum())
        hidden = float(np.r_[a.hidden, b.hidden][mine].sum())
        sizes.append(shared + sum(only))
        free.append(1.0 - hidden / max(end, 1.0))
        common, own_a, own_b = common + shared, own_a + only[0], own_b + only[1]
    if not sizes:
        return PairValue(*ids, 0.0, (0.0, 0.0), half, 0.0, 0.0)
    largest = int(np.argmax(sizes))
    side = (sizes[largest] + LOOSE_COUNTS * (sum(sizes) - sizes[largest])) / half
    opened = float(np.average(free, weights=sizes))
    value = side * opened**OPEN_COUNTS
    return PairValue(*ids, common, (own_a, own_b), half, opened, value)
