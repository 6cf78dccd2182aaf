"""Whether the item is one cloth, whose two faces hang on each other wherever both were seen.

The front and the back of a garment may touch, but not everywhere: they are now millimetres, now
centimetres apart. The two faces of a towel are everywhere as far apart as it is thick.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.values import Float

MOST, AROUND = 1500, 128  # samples that are asked, and of each the nearest that are looked at
BEHIND_M, BEFORE_M = 0.02, 0.003  # where the other face may lie, from a sample of the one
OPPOSITE = -0.8  # cosine between their normals
FEWEST = 0.3  # share of the samples that have another face behind them
EVEN_M = 0.0015  # by which distances between two faces of one cloth differ, of errors
# Share that differs by less, of one cloth: in 21 recordings of towels 0.82 to 1, of 68 other items
# 0.12 to 0.66, of skirts of cloth half a millimetre thin up to 0.79
ONE_CLOTH = 0.75


def evenly_apart(xyz: Float, normal: Float, config: RotationConfig) -> float:
    """Share of the places seen from both sides at which the two faces are as far apart as most.

    Parameters
    ----------
    xyz, normal : ndarray of shape (n, 3)
        Samples and their outward normals.
    config : RotationConfig

    Returns
    -------
    float
        0 to 1, from ONE_CLOTH on they are faces of one cloth; 0: hardly any place was seen so.
    """
    count = len(xyz)
    asked = np.arange(0, count, max(1, count // MOST))
    nth = np.arange(1, min(AROUND, count) + 1)
    near = cKDTree(xyz).query(xyz[asked], k=nth, distance_upper_bound=BEHIND_M)[1]
    one, other = np.repeat(asked, near.shape[1]), near.ravel()
    one, other = one[other < count], other[other < count]
    opposite = np.einsum("mi,mi->m", normal[one], normal[other]) < OPPOSITE
    one, other = one[opposite], other[opposite]
    step = xyz[other] - xyz[one]
    behind_m = -np.einsum("mi,mi->m", step, normal[one])
    beside_m = np.linalg.norm(step + behind_m[:, None] * normal[one], axis=1)
    faces = (beside_m < config.spacing_m) & (behind_m > -BEFORE_M)
    one, behind_m = one[faces], behind_m[faces]
    order = np.lexsort((np.abs(behind_m), one))
    nearest = order[np.unique(one[order], return_index=True)[1]]
    if len(nearest) < FEWEST * len(asked):
        return 0.0
    apart_m = behind_m[nearest]
    return float((np.abs(apart_m - np.median(apart_m)) < EVEN_M).mean())
