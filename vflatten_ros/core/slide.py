"""Whether a print on the cloth bears out the registration of the views.

Views of a smooth tube or a flat side fit together wherever they are slid along themselves. Features
of the colour image, found in neighbouring views, tell by how much they were.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vflatten_ros.core.config import CorrespondenceConfig
from vflatten_ros.core.correspondences import PlacedView
from vflatten_ros.core.prints import common_features
from vflatten_ros.core.turntable import TURN
from vflatten_ros.core.values import Notice

FEWEST_FEATURES = 8  # of two views, for them to have a say
FEWEST_PAIRS = 2  # of views that have one
FAR_RAD = np.radians(35.0)  # farther apart, two views have few features in common


def neighbours(angles_rad: Mapping[int, float], count: int) -> list[tuple[int, int]]:
    """Ids of `count` views, evenly chosen round the turn, and of the next after each.

    Parameters
    ----------
    angles_rad : mapping of int to float
        Item angle by view_id.
    count : int
        Most pairs.
    """
    order = sorted(angles_rad, key=lambda i: (angles_rad[i] % TURN, i))
    pairs = [(i, order[(k + 1) % len(order)]) for k, i in enumerate(order)]
    near = [(i, j) for i, j in pairs if (angles_rad[j] - angles_rad[i]) % TURN <= FAR_RAD]
    picked = np.linspace(0, len(near), min(count, len(near)), endpoint=False).astype(int)
    return [near[k] for k in picked]


def slide_m(
    pairs: Sequence[tuple[PlacedView, PlacedView]], config: CorrespondenceConfig
) -> float | None:
    """How far apart the registration puts the same features of two views, median over the pairs.

    Returns
    -------
    float or None
        Metres; None where too few views have features in common, as on plain fabric.
    """
    off = []
    for a, b in pairs:
        found = common_features(a, b, config)
        if len(found.a) >= FEWEST_FEATURES:
            shift = np.median(a.points[found.a] - b.points[found.b], axis=0)
            off.append(float(np.linalg.norm(shift)))
    return float(np.median(off)) if len(off) >= FEWEST_PAIRS else None


def notice_of(off_m: float) -> Notice:
    """Says that the print contradicts the registration."""
    text = (
        f"the print on the cloth puts neighbouring views {1e3 * off_m:.0f} mm from where their "
        "surfaces put them: check the calibration, and whether the item hangs still"
    )
    return Notice("views_misplaced", text)
