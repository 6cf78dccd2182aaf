"""Corresponding points given by hand, where all views are registered: checked, then joined."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import sheet
from sheet import seen_from

from vflatten_ros.core.config import IntegrationConfig, RotationConfig
from vflatten_ros.core.errors import NotEnoughViews
from vflatten_ros.core.fused import fuse_views
from vflatten_ros.core.rotation import TOLD_M, link_surface
from vflatten_ros.core.sheets import Links

ANGLES = (-0.6, -0.3, 0.0, 0.3, 0.6)
SEEN = [seen_from(k, angle, noise=0.0002) for k, angle in enumerate(ANGLES)]
VIEWS = [view for view, _ in SEEN]
FLATS = [flat for _, flat in SEEN]
CONFIG = RotationConfig()


def pair(u, v, slip_m=0.0):
    return sheet.pair_at(VIEWS[1:4:2], FLATS[1:4:2], u, v, slip_m)


@pytest.fixture(scope="module")
def fused():
    given = [pair(0.0, -0.05), pair(0.02, -0.15), pair(0.0, -0.1, slip_m=0.04)]
    return given, fuse_views(VIEWS, CONFIG, given=given)


def test_points_that_the_registration_bears_out_are_used_and_others_are_told(fused):
    given, surface = fused
    assert surface.given.used == tuple(given[:2])
    (notice,) = surface.given.notices
    assert notice.code == "correspondence_rejected"
    assert f"view 1 pixel {given[2].pixel_a} and view 3 pixel {given[2].pixel_b}" in notice.text
    off = float(notice.text.split(" cm apart")[0].split()[-1])
    assert off == pytest.approx(4.0, abs=0.5)
    assert "registration" in notice.text


def test_the_limit_is_a_setting():
    strict = IntegrationConfig(reject_m=0.004)
    given = [pair(0.0, -0.05, slip_m=0.007)]
    assert fuse_views(VIEWS, CONFIG, given=given).given.used == tuple(given)
    assert not fuse_views(VIEWS, CONFIG, given=given, limits=strict).given.used


def test_samples_that_are_said_to_be_one_point_hang_together():
    given = [pair(0.0, -0.05, slip_m=0.012), pair(0.01, -0.1, slip_m=-0.012)]
    surface = link_surface(fuse_views(VIEWS, CONFIG, given=given), CONFIG)
    told = surface.links.length_m == TOLD_M
    assert told.sum() == 2 and not surface.links.rim[told].any()
    apart = surface.samples.xyz[surface.links.a[told]] - surface.samples.xyz[surface.links.b[told]]
    assert np.linalg.norm(apart, axis=1) == pytest.approx([0.012, 0.012], abs=0.006)
    key = np.column_stack([surface.links.a, surface.links.b])
    assert len(np.unique(key, axis=0)) == len(key) and (key[:, 0] < key[:, 1]).all()


def test_without_points_the_links_are_as_they_were():
    surface = fuse_views(VIEWS, CONFIG)
    plain = link_surface(surface, CONFIG).links
    assert not (plain.length_m == TOLD_M).any()
    assert surface.given.used == () and surface.given.notices == ()


def test_a_link_takes_the_place_of_the_one_that_was_there():
    links = Links(
        np.array([0, 0, 1]),
        np.array([1, 2, 2]),
        np.array([0.004, 0.008, 0.004]),
        np.array([False, True, False]),
        np.array([0.0, 2.0, 0.0]),
    )
    found = links.with_links(np.array([2, 3]), np.array([0, 1]), TOLD_M)
    assert len(found.a) == 4
    table = {
        (a, b): (length, rim, doubt)
        for a, b, length, rim, doubt in zip(*dataclasses.astuple(found), strict=True)
    }
    assert table == {
        (0, 1): (0.004, False, 0.0),
        (1, 2): (0.004, False, 0.0),
        (0, 2): (TOLD_M, False, 0.0),
        (1, 3): (TOLD_M, False, 0.0),
    }


def test_a_view_that_is_not_there_is_named():
    wrong = dataclasses.replace(pair(0.0, -0.05), view_b=9)
    with pytest.raises(NotEnoughViews, match="name view 9"):
        fuse_views(VIEWS, CONFIG, given=[wrong])
