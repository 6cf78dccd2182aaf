"""A print on the cloth tells when views were registered to slid places."""

from __future__ import annotations

import numpy as np
import pytest
from sheet import a_print, plain, seen_from

from vflatten_ros.core import fused
from vflatten_ros.core.config import CorrespondenceConfig, RotationConfig
from vflatten_ros.core.geometry import rigid
from vflatten_ros.core.slide import neighbours

ANGLES = (-0.5, -0.25, 0.0, 0.25, 0.5)
# the ends of a view that was slid are looked past by the others, which is another matter
CONFIG, PRINTS = RotationConfig(trim_edges=False), CorrespondenceConfig()


def views(colour):
    return [seen_from(k, angle, colour=colour)[0] for k, angle in enumerate(ANGLES)]


def slid(steps_m):
    """A registration that puts every view higher than the one before."""
    return lambda surfaces, config, progress, so_far: [
        rigid(np.eye(3), np.array([0.0, 0.0, k * steps_m])) for k in range(len(surfaces))
    ]


@pytest.mark.parametrize("colour, told", [(a_print, True), (plain, False), (None, False)])
def test_views_that_were_slid_are_told_where_there_is_a_print(monkeypatch, colour, told):
    monkeypatch.setattr(fused, "register_views", slid(0.006))
    found = fused.fuse_views(views(colour), CONFIG, prints=PRINTS)
    assert [notice.code for notice in found.notices] == ["views_misplaced"] * told
    if told:
        assert "6 mm" in found.notices[0].text


def test_views_in_their_place_are_not(monkeypatch):
    monkeypatch.setattr(fused, "register_views", slid(0.0))
    assert fused.fuse_views(views(a_print), CONFIG, prints=PRINTS).notices == ()


def test_nothing_is_checked_unless_asked_for(monkeypatch):
    monkeypatch.setattr(fused, "register_views", slid(0.006))
    none = CorrespondenceConfig(check_pairs=0)
    assert fused.fuse_views(views(a_print), CONFIG, prints=none).notices == ()
    assert fused.fuse_views(views(a_print), CONFIG).notices == ()


def test_neighbours_are_spread_round_the_turn():
    angles = {k: np.radians(15.0 * k) for k in range(24)}
    assert neighbours(angles, 4) == [(0, 1), (6, 7), (12, 13), (18, 19)]
    assert neighbours({0: 0.0, 1: 1.0}, 4) == []
    assert neighbours({3: 6.2, 5: 0.1}, 4) == [(3, 5)]
