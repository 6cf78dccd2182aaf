"""Points of the cloth that two views show, found by their colour where the fabric has texture.

Surfaces alone do not tell where along a smooth tube or a flat side two views meet; a print does.
A feature of one view is looked for only where the registered surfaces allow it in the other, so
that stripes and checks, which repeat, are less often taken for one another; what is left must agree
on one small motion. Plain fabric has few features or none, and that does no harm.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.config import CorrespondenceConfig
from vflatten_ros.core.correspondences import Matches, PlacedView
from vflatten_ros.core.values import Bool, Float, Int

ALIKE = 0.7  # least cosine between the normals of one point in two views
LEAST_AGREEING = 4  # matches that agree on a motion, and
LEAST_SHARE = 0.35  # their share of all, below which none of them counts
ROUNDS = 64  # of the search for the motion
TURN_M = 0.15  # lever of a turn about the vertical: how far most cloth is from the axis


def common_features(a: PlacedView, b: PlacedView, config: CorrespondenceConfig) -> Matches:
    """Features of two views that are the same point of the cloth.

    Parameters
    ----------
    a, b : PlacedView
        Of the same registration, with features.

    Returns
    -------
    Matches
        Those that agree on one small motion; often none.
    """
    none = Matches(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    of_a, of_b = a.features, b.features
    if not len(of_a.at) or not len(of_b.at):
        return none
    i, j, doubt = _matched(a, b, config)
    if len(i) < LEAST_AGREEING:
        return none
    p, q = a.points[of_a.at[i]] + of_a.offset_m[i], b.points[of_b.at[j]] + of_b.offset_m[j]
    agree, miss = agreeing(p, q, config.feature_agree_m)
    if agree.sum() < max(LEAST_AGREEING, LEAST_SHARE * len(i)):
        return none
    share = float(agree.mean())
    sure = (
        share
        * (1 - doubt[agree]) ** 0.5
        * np.exp(-0.5 * (miss[agree] / config.feature_agree_m) ** 2)
    )
    return Matches(of_a.at[i[agree]], of_b.at[j[agree]], sure)


def _matched(a: PlacedView, b: PlacedView, config: CorrespondenceConfig) -> tuple[Int, Int, Float]:
    """Features nearest to each other among those that may be the same, and their ratio."""
    of_a, of_b = a.features, b.features
    p, q = a.points[of_a.at] + of_a.offset_m, b.points[of_b.at] + of_b.offset_m
    may = np.zeros((len(p), len(q)), dtype=bool)
    for row, near in enumerate(cKDTree(q).query_ball_point(p, config.feature_reach_m)):
        may[row, near] = True
    may &= a.normals[of_a.at] @ b.normals[of_b.at].T > ALIKE
    one, other = of_a.descriptor, of_b.descriptor
    squared = (one**2).sum(1)[:, None] + (other**2).sum(1) - 2.0 * one @ other.T
    off = np.sqrt(np.maximum(squared, 0.0)).astype(np.float64)
    off[~may] = np.inf
    j = off.argmin(axis=1)
    i = np.arange(len(p))
    best = off[i, j]
    rest = off.copy()
    rest[i, j] = np.inf
    # the same feature found twice is no rival
    twin = np.linalg.norm(q[None] - q[j][:, None], axis=2) < config.feature_agree_m
    rest[twin] = np.inf
    second = np.minimum(rest.min(axis=1), config.feature_most)
    mutual = off.argmin(axis=0)[j] == i
    keep = np.isfinite(best) & (best < config.feature_ratio * second) & mutual
    return i[keep], j[keep], (best[keep] / second[keep]).clip(0, 1)


def agreeing(p: Float, q: Float, limit_m: float) -> tuple[Bool, Float]:
    """Which matches one small motion (a shift and a turn about the vertical) brings together.

    RANSAC (Fischler and Bolles 1981) over shifts, then least squares.

    Parameters
    ----------
    p, q : ndarray of shape (m, 3)
        Matched points, common frame.
    limit_m : float
        How far they may be apart.

    Returns
    -------
    agree : ndarray of shape (m,), bool
    miss_m : ndarray of shape (m,)
        What is left between them.
    """
    off = p - q
    tried = np.random.default_rng(0).permutation(len(off))[:ROUNDS]  # seeded: the same every time
    left = np.linalg.norm(off[None] - off[tried][:, None], axis=2)
    agree: Bool = left[(left < limit_m).sum(axis=1).argmax()] < limit_m
    miss = np.full(len(p), np.inf)
    for _ in range(3):
        design = np.zeros((len(p), 3, 4))
        design[:, :, :3] = np.eye(3)
        design[:, 0, 3], design[:, 1, 3] = -q[:, 1] / TURN_M, q[:, 0] / TURN_M
        chosen = design[agree].reshape(-1, 4)
        normal = chosen.T @ chosen + 0.1 * np.eye(4)
        motion = np.linalg.solve(normal, chosen.T @ off[agree].reshape(-1))
        miss = np.linalg.norm(off - design @ motion, axis=1)
        agree = miss < limit_m
        if not agree.any():
            break
    return agree, miss
