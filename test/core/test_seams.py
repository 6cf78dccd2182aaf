"""Whether front and back hang together where a category has seams."""

from __future__ import annotations

import numpy as np
import pytest
from flat import lying_at

from vflatten_ros.core.seams import torn_share

WIDE_M, LONG_M, STEP_M = 0.40, 0.50, 0.005
OUTLINE = np.array([[0.0, 0.0], [WIDE_M, 0.0], [WIDE_M, LONG_M], [0.0, LONG_M]])
SIDES = np.array([False, True, False, True])


def tube(open_m=0.0, open_below_m=LONG_M, side_m=None):
    """A tube that lies flat, front and back, and hangs round; its right seam may be open.

    Parameters
    ----------
    open_m : float
        By how much the back hangs away from the front there.
    open_below_m : float
        Up to which height.
    side_m : float, optional
        Only what lies nearer to the left than this was seen.
    """
    face = np.mgrid[0 : WIDE_M + 1e-9 : STEP_M, 0:LONG_M:STEP_M].reshape(2, -1).T
    points = lying_at(np.vstack([face, face]))
    side = np.repeat([1.0, -1.0], len(face))
    u, v = points.uv.T
    radius = WIDE_M / np.pi
    angle = side * u / radius
    xyz = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), v])
    away = (side < 0) & (u > WIDE_M / 2) & (v < open_below_m)
    xyz[away, 1] -= open_m
    points.xyz_hanger[:] = xyz
    if side_m is not None:
        points.inferred[:] = u > side_m
    return points, side


def test_a_tube_hangs_together_along_both_sides():
    assert torn_share(*tube(), OUTLINE, SIDES) == 0.0
    assert torn_share(*tube(open_m=0.015), OUTLINE, SIDES) == 0.0  # flattening is no better


@pytest.mark.parametrize(("below_m", "share"), [(LONG_M, 0.5), (LONG_M / 2, 0.25)])
def test_the_share_of_an_open_seam_is_told(below_m, share):
    found = torn_share(*tube(open_m=0.1, open_below_m=below_m), OUTLINE, SIDES)
    assert found == pytest.approx(share, abs=0.02)


def test_openings_may_be_open():
    assert torn_share(*tube(open_m=0.1), OUTLINE, SIDES & False) == 0.0
    left = np.array([False, False, False, True])
    assert torn_share(*tube(open_m=0.1), OUTLINE, left) == 0.0


def test_an_outline_too_large_asks_what_lies_near_and_allows_for_how_far():
    larger = OUTLINE + np.sign(OUTLINE - OUTLINE.mean(axis=0)) * 0.02
    assert torn_share(*tube(), larger, SIDES) == 0.0
    assert torn_share(*tube(open_m=0.1), larger, SIDES) == pytest.approx(0.5, abs=0.03)


def test_what_was_not_seen_says_nothing():
    assert torn_share(*tube(open_m=0.1, side_m=WIDE_M / 2), OUTLINE, SIDES) == 0.0
    points, side = tube(open_m=0.1)
    assert torn_share(points, np.ones(len(side)), OUTLINE, SIDES) == 0.0
    points.inferred[:] = points.uv[:, 1] > 0.04  # both sides of too few places
    assert torn_share(points, side, OUTLINE, SIDES) == 0.0
