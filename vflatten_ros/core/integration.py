"""Two views become one set of distances, through points of the cloth that both show (section 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vflatten_ros.core.config import IntegrationConfig
from vflatten_ros.core.geometry import rigid, rotation_about
from vflatten_ros.core.sampling import neighbours, same_surface
from vflatten_ros.core.unrolling import Relations, joined, relate
from vflatten_ros.core.values import Bool, DistanceNetwork, Float, Int

UP = np.array([0.0, 0.0, 1.0])
LOCAL, OVERLAP, PAIR = 0, 1, 2
WEIGHT = np.array([1.0, 0.3, 5.0])  # of a pair of each kind when the surface is unrolled
SIGMA_M = np.array([0.0006, 0.0015])  # of the distances of neighbours, and of overlapping samples


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Samples of the surface that one view shows, the corresponding points first."""

    points: Float  # (n, 3) hanger frame
    normals: Float  # (n, 3) towards the camera
    patch: Int  # (n,) number of the smooth patch, -1: none


@dataclass(frozen=True, eq=False)
class Joint:
    """Samples of both views (rows of the second after those of the first), and how they relate."""

    points: Float  # (n, 3), hanger frame of the first view
    normals: Float  # (n, 3)
    relations: Relations
    kind: Int  # (m,) LOCAL, OVERLAP or PAIR
    piece: Int  # (n,) number of the connected piece, largest first
    own_patch: Int  # (n,) patch in the sample's own view, -1: none

    @property
    def weight(self) -> Float:
        """(m,) trust in each relation."""
        return WEIGHT[self.kind]


def consistent_pairs(points_a: Float, points_b: Float, config: IntegrationConfig) -> Bool:
    """Corresponding points that agree with the others: the item moves as one between two views.

    A pair is left out if it lies far from where the rigid motion of the pairs that agree puts it.
    The pair that disagrees most goes first; three pairs must remain for a judgement.

    Parameters
    ----------
    points_a, points_b : ndarray of shape (k, 3)
        The points in the hanger frames of both views.

    Returns
    -------
    ndarray of shape (k,), bool
    """
    keep = np.ones(len(points_a), dtype=bool)
    while keep.sum() > 3:
        rows = np.flatnonzero(keep)
        miss = np.array(
            [_miss_without(points_a[rows], points_b[rows], q) for q in range(len(rows))]
        )
        left = np.array(
            [_spread_without(points_a[rows], points_b[rows], q) for q in range(len(rows))]
        )
        worst = int(np.lexsort((-miss, left))[0])
        if miss[worst] <= config.reject_m:
            break
        keep[rows[worst]] = False
    if 2 <= keep.sum() <= 3:
        distance = [
            np.linalg.norm(p[keep][:, None] - p[keep][None], axis=-1) for p in (points_a, points_b)
        ]
        agree = np.abs(distance[0] - distance[1]) <= 2.0 * config.reject_m
        if keep.sum() == 3 and agree.sum() == 5:  # one pair of points agrees, the third is wrong
            rows = np.flatnonzero(keep)
            keep[rows[int(agree.sum(axis=1).argmin())]] = False
    return keep


def misses(points_a: Float, points_b: Float, keep: Bool) -> Float:
    """(k,) how far, in metres, each pair is from where the shift of the others kept puts it."""
    off = points_a - points_b
    miss = np.empty(len(off))
    for k in range(len(off)):
        others = keep & (np.arange(len(off)) != k)
        miss[k] = np.linalg.norm(off[k] - off[others].mean(axis=0)) if others.any() else np.inf
    return miss


def _miss_without(points_a: Float, points_b: Float, one: int) -> float:
    """How far a pair is from where the motion of all others puts it."""
    others = np.arange(len(points_a)) != one
    shift = points_a[others].mean(axis=0) - points_b[others].mean(axis=0)
    return float(np.linalg.norm(points_a[one] - points_b[one] - shift))


def _spread_without(points_a: Float, points_b: Float, one: int) -> float:
    """How much the others disagree among themselves."""
    others = np.arange(len(points_a)) != one
    off = points_a[others] - points_b[others]
    return float(np.linalg.norm(off - off.mean(axis=0)))


def align(
    a: SurfaceSamples, b: SurfaceSamples, pairs_a: Float, pairs_b: Float, config: IntegrationConfig
) -> Float:
    """Small motion that takes the second view's hanger frame to the first's: the item sways.

    A shift and a turn about the wrist axis, from the corresponding points and from the surface
    that both views show (Gauss-Newton on distances along the normals, robust).

    Returns
    -------
    ndarray of shape (4, 4)
    """
    motion = rigid(np.eye(3), np.median(pairs_a - pairs_b, axis=0)) if len(pairs_a) else np.eye(4)
    turned = 0.0
    for step in range(8):
        points = b.points @ motion[:3, :3].T + motion[:3, 3]
        normals = b.normals @ motion[:3, :3].T
        normal = np.diag(np.r_[np.full(3, 1.0 / config.sway_m**2), _lag_weight(config)])
        right = np.r_[-motion[:3, 3] / config.sway_m**2, -turned * _lag_weight(config)]
        i, j = same_surface(
            a.points, a.normals, points, normals, 0.012, 0.01 if step < 2 else 0.005
        )
        for rows, off, sigma, cut in (
            _surface_rows(a.points[i], a.normals[i], points[j]),
            _pair_rows(pairs_a, pairs_b @ motion[:3, :3].T + motion[:3, 3], config),
        ):
            weight = 1.0 / sigma**2 / (1.0 + (off / cut) ** 2) ** 2
            normal += rows.T @ (rows * weight[:, None])
            right += rows.T @ (weight * off)
        change = np.linalg.solve(normal, right)
        motion = rigid(rotation_about(UP, change[3]), change[:3]) @ motion
        turned += change[3]
    return motion


def _lag_weight(config: IntegrationConfig) -> float:
    result: float = 1.0 / np.radians(max(config.lag_deg, 1e-3)) ** 2
    return result


def _surface_rows(goal: Float, normal: Float, point: Float) -> tuple[Float, Float, float, float]:
    turn = normal[:, 1] * point[:, 0] - normal[:, 0] * point[:, 1]
    off = np.einsum("ij,ij->i", normal, goal - point)
    # neighbours repeat one another: about twenty of them count as one observation of 1 mm
    return np.column_stack([normal, turn]), off, 0.0045, 0.002


def _pair_rows(
    goal: Float, point: Float, config: IntegrationConfig
) -> tuple[Float, Float, float, float]:
    rows = np.zeros((len(point), 3, 4))
    rows[:, :, :3] = np.eye(3)
    rows[:, 0, 3], rows[:, 1, 3] = -point[:, 1], point[:, 0]
    sigma = config.pair_sigma_m
    return rows.reshape(-1, 4), (goal - point).reshape(-1), sigma, 3.0 * sigma


def join(
    a: SurfaceSamples, b: SurfaceSamples, pairs: Int, motion: Float, config: IntegrationConfig
) -> Joint:
    """Relations within each view's patches and between the views.

    Parameters
    ----------
    a, b : SurfaceSamples
    pairs : ndarray of shape (k,)
        Rows, equal in both, that are the same point of the cloth.
    motion : ndarray of shape (4, 4)
        From the second view's hanger frame to the first's.
    """
    shift = len(a.points)
    points = np.vstack([a.points, b.points @ motion[:3, :3].T + motion[:3, 3]])
    normals = np.vstack([a.normals, b.normals @ motion[:3, :3].T])
    none = a.patch.max(initial=0) + b.patch.max(initial=0) + 2 + np.arange(len(points))
    patch = np.r_[a.patch, np.where(b.patch >= 0, b.patch + a.patch.max(initial=0) + 1, -1)]
    patch = np.where(patch >= 0, patch, none)
    local = relate(points, normals, *neighbours(points, normals, patch, 1.9 * config.spacing_m))
    known = pairs[(a.patch[pairs] >= 0) & (b.patch[pairs] >= 0)]
    same = relate(points, normals, known, known + shift)
    zero = np.zeros(len(known), dtype=complex)
    parts = [local, Relations(same.i, same.j, zero, zero, same.turn)]
    kinds = [np.full(len(local.i), LOCAL), np.full(len(known), PAIR)]
    if config.overlap:
        over = _overlap(points, normals, patch, shift, config)
        parts.append(over)
        kinds.append(np.full(len(over.i), OVERLAP))
    relations, kind = joined(*parts), np.concatenate(kinds)
    piece = _pieces(len(points), relations)
    return Joint(points, normals, relations, kind, piece, np.r_[a.patch, b.patch])


def _overlap(
    points: Float, normals: Float, patch: Int, shift: int, config: IntegrationConfig
) -> Relations:
    """Relations between patches of the two views, where enough of the same cloth is in both.

    A patch that touches another in a few samples only may be another layer that ends there.
    """
    i, j = same_surface(
        points[:shift],
        normals[:shift],
        points[shift:],
        normals[shift:],
        1.1 * config.spacing_m,
        config.same_m,
    )
    over = relate(points, normals, i, j + shift)
    keep = np.zeros(len(i), dtype=bool)
    key = np.column_stack([patch[over.i], patch[over.j]])
    groups, group = np.unique(key, axis=0, return_inverse=True)
    for number in range(len(groups)):
        rows = np.flatnonzero(group.reshape(-1) == number)
        where = points[over.i[rows]]
        spread = np.linalg.norm(where - where.mean(axis=0), axis=1)
        keep[rows] = len(rows) >= 10 and np.sqrt((spread**2).mean()) > 2.0 * config.spacing_m
    return over.part(keep)


def _pieces(count: int, relations: Relations) -> Int:
    graph = coo_matrix(
        (np.ones(len(relations.i)), (relations.i, relations.j)), shape=(count, count)
    )
    label = connected_components(graph, directed=False)[1]
    order = np.argsort(-np.bincount(label), kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    result: Int = rank[label]
    return result


def network_of(joint: Joint, config: IntegrationConfig) -> DistanceNetwork:
    """The relations as distances."""
    sigma = np.r_[SIGMA_M, config.pair_sigma_m][joint.kind]
    length = joint.relations.length_m
    sigma = np.where(joint.kind == LOCAL, np.hypot(sigma, 0.02 * length), sigma)
    bound = np.zeros(len(length), dtype=bool)
    return DistanceNetwork(joint.relations.i, joint.relations.j, length, sigma, bound)


def merged(networks: list[DistanceNetwork]) -> DistanceNetwork:
    """All distances of several networks over the same points."""
    return DistanceNetwork(
        np.concatenate([n.i for n in networks]),
        np.concatenate([n.j for n in networks]),
        np.concatenate([n.distance_m for n in networks]),
        np.concatenate([n.sigma_m for n in networks]),
        np.concatenate([n.bound for n in networks]),
    )


def unknowns(count_a: int, count_b: int, at_a: Int, at_b: Int) -> Int:
    """Number of every point's unknown when corresponding points are one (paper, step 3).

    Parameters
    ----------
    count_a, count_b : int
        Points of each view.
    at_a, at_b : ndarray of shape (k,)
        Which of them correspond.

    Returns
    -------
    ndarray of shape (count_a + count_b,)
    """
    number = np.arange(count_a + count_b)
    number[count_a + at_b] = at_a
    result: Int = np.unique(number, return_inverse=True)[1].reshape(-1)
    return result


def start_places(xy_a: Float, xy_b: Float, at_a: Int, at_b: Int) -> tuple[Float, Float]:
    """(x, y) of both views, the second moved onto the first (paper, step 3).

    The rotation and translation that make the corresponding points' mean and direction agree.

    Parameters
    ----------
    xy_a, xy_b : ndarray of shape (n, 2) and (m, 2)
        Horizontal and vertical place in the view frame, metres.
    at_a, at_b : ndarray of shape (k,)
        Corresponding rows, two or more.
    """
    a, b = xy_a[at_a], xy_b[at_b]
    p, q = (c @ np.array([1.0, 1j]) for c in (a - a.mean(axis=0), b - b.mean(axis=0)))
    turn = (p * np.conj(q)).sum()
    turn = turn / abs(turn) if abs(turn) > 1e-12 else 1.0 + 0j
    moved = (xy_b - b.mean(axis=0)) @ np.array([1.0, 1j]) * turn
    return xy_a, np.column_stack([moved.real, moved.imag]) + a.mean(axis=0)
