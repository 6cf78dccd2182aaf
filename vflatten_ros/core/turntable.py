"""Angles of views about the wrist axis: how much of a turn they cover."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vflatten_ros.core.values import Float

TURN = 2.0 * np.pi


def angle_between(first_rad: float, second_rad: float) -> float:
    """Smallest angle between two directions, 0 to pi."""
    return float(abs((first_rad - second_rad + np.pi) % TURN - np.pi))


def angle_covered(angles_rad: Sequence[float], max_gap_rad: float) -> float:
    """Angle of the turn that views cover, 0 to 2 pi; what a gap exceeds max_gap_rad by is not."""
    if not len(angles_rad):
        return 0.0
    return float(np.minimum(_gaps(angles_rad), max_gap_rad).sum())


def rotation_complete(angles_rad: Sequence[float], max_gap_rad: float) -> bool:
    """Whether views in order of id go once round.

    No gap may exceed max_gap_rad, and the turn must be closed: either no gap stands out from the
    others, or the wrist has travelled a whole turn but for one usual step (then a dropped cloud
    has left a gap on the way).
    """
    if len(angles_rad) < 2:
        return False
    gaps = _gaps(angles_rad)
    if gaps.max() > max_gap_rad:
        return False
    usual = float(np.median(gaps))
    travelled = max(angles_rad) - min(angles_rad)
    return bool(gaps.max() <= 1.5 * usual or travelled + 1.5 * usual >= TURN)


def crowded(angles_rad: Sequence[float]) -> int:
    """Index of the view whose two neighbours in angle are nearest to each other."""
    order = np.argsort(np.mod(angles_rad, TURN), kind="stable")
    gaps = _gaps(angles_rad)  # from each in order to the next
    room = gaps + np.roll(gaps, 1)
    return int(order[int(room.argmin())])


def _gaps(angles_rad: Sequence[float]) -> Float:
    """Angles from each view to the next round the turn; they sum to 2 pi."""
    around = np.sort(np.mod(angles_rad, TURN))
    gaps: Float = np.diff(np.append(around, around[0] + TURN))
    return gaps
