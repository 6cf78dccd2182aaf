"""How much of the item lies on other cloth of its own once it is flat.

A garment has a front and a back, which hang apart though they lie on each other when it is flat.
The two faces of a towel are one cloth: where they lie on each other they hang on each other, too.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.values import FlatPoints

AROUND = 8  # points nearest to each where it lies flat: of both layers, if there are two
APART_M = 0.020  # flattening is off by less; layers of a garment seldom hang so near everywhere
MISLAID = 0.06  # share that flattening makes of a single sheet that is laid out right


def doubled_share(points: FlatPoints) -> float:
    """Share of the points that hang far from what lies beside them.

    No chord is longer than the way along the cloth, so points that hang much farther apart than
    they lie are not of one sheet there.

    Parameters
    ----------
    points : FlatPoints
        Those that were seen count.

    Returns
    -------
    float
        0 to 1; 0 for too few points.
    """
    seen = ~points.inferred
    uv, xyz = points.uv[seen], points.xyz_hanger[seen]
    if len(uv) <= AROUND:
        return 0.0
    lies_m, beside = cKDTree(uv).query(uv, k=AROUND + 1)
    hangs_m = np.linalg.norm(xyz[beside] - xyz[:, None], axis=2)
    return float(((hangs_m - lies_m).max(axis=1) > APART_M).mean())
