"""Two views and points chosen by the method itself, on a bent sheet that no view shows whole."""

from __future__ import annotations

import dataclasses

import garments
import numpy as np
import pytest
import sheet
from sheet import HEIGHT_M, WIDTH_M, a_print, seen_from

from vflatten_ros.categories import load_templates
from vflatten_ros.core.automatic_pair import corresponding, fill_up, placed_views
from vflatten_ros.core.config import Config, CorrespondenceConfig
from vflatten_ros.core.errors import DisconnectedSurface, InvalidCorrespondence, NotEnoughViews
from vflatten_ros.core.pipeline import flatten_garment, prepare_view
from vflatten_ros.core.values import no_progress
from vflatten_ros.core.view_choice import pair_values

ANGLES = (-2.2, -0.7, 0.0, 0.7, 2.2)  # at the outer ones the sheet shows its edge at most
CONFIG = dataclasses.replace(Config(), method="kita2019")
SEEN = [seen_from(k, angle, colour=a_print, noise=0.0003) for k, angle in enumerate(ANGLES)]
VIEWS = [view for view, _ in SEEN]
FLATS = [flat for _, flat in SEEN]
TEMPLATES = tuple(t for t in load_templates() if t.category in ("towel", "skirt"))


def extent(garment):
    return np.ptp(garment.outline.uv, axis=0)


def codes(garment):
    return [notice.code for notice in garment.notices]


@pytest.fixture(scope="module")
def chosen():
    return flatten_garment(VIEWS, (), TEMPLATES, CONFIG)


def test_without_points_two_views_that_show_the_whole_sheet_are_chosen(chosen):
    shown = np.concatenate([FLATS[i][:, 0] for i in chosen.view_ids])
    assert np.ptp(shown) > 0.98 * WIDTH_M
    assert all(np.ptp(FLATS[i][:, 0]) < 0.95 * WIDTH_M for i in chosen.view_ids)
    assert extent(chosen) == pytest.approx([HEIGHT_M, WIDTH_M], abs=0.008)  # longer side upright
    assert codes(chosen).count("views_chosen") == 1
    a, b = chosen.view_ids
    apart = abs(np.degrees(ANGLES[a] - ANGLES[b]))
    assert f"views {a} and {b}, {apart:.0f} degrees apart" in chosen.notices[0].text


def test_the_points_are_found_and_say_so(chosen):
    pairs = chosen.correspondences
    assert 3 <= len(pairs) <= CorrespondenceConfig().count
    assert not any(p.manual for p in pairs) and all(0 < p.confidence <= 1 for p in pairs)
    for pair in pairs:
        places = [
            flat[(view.pixel == pixel).all(axis=1)][0]
            for view, flat, pixel in (
                (VIEWS[pair.view_a], FLATS[pair.view_a], pair.pixel_a),
                (VIEWS[pair.view_b], FLATS[pair.view_b], pair.pixel_b),
            )
        ]
        assert np.linalg.norm(places[0] - places[1]) < 0.006


def test_views_prepared_before_give_the_same(chosen):
    prepared = {view.view_id: prepare_view(view, CONFIG) for view in VIEWS}
    other = flatten_garment(VIEWS, (), TEMPLATES, CONFIG, prepared=prepared)
    np.testing.assert_array_equal(other.outline.uv, chosen.outline.uv)
    assert other.correspondences == chosen.correspondences


def test_pairs_are_valued_by_the_cloth_that_they_show_in_one_piece():
    values = pair_values(placed_views(VIEWS, CONFIG, no_progress, {}), CONFIG)
    by_ids = {frozenset((v.view_a, v.view_b)): v for v in values}
    sides, middle = by_ids[frozenset((1, 3))], by_ids[frozenset((1, 2))]
    for pair in (sides, middle):
        flats = [FLATS[i] for i in (pair.view_a, pair.view_b)]
        low, high = (
            f(flat[:, 0] for flat in flats)
            for f in ((lambda u: max(map(np.min, u))), (lambda u: min(map(np.max, u))))
        )
        shown = np.ptp(np.concatenate(flats)[:, 0]) * HEIGHT_M
        assert pair.common_m2 + sum(pair.own_m2) == pytest.approx(shown, rel=0.12)
        assert pair.common_m2 == pytest.approx((high - low) * HEIGHT_M, rel=0.2)
    assert sides.value > middle.value
    assert [v.value for v in values] == sorted((v.value for v in values), reverse=True)
    assert frozenset((0, 4)) not in by_ids or not by_ids[frozenset((0, 4))].value


def test_a_view_without_a_patch_of_its_own_joins_nothing():
    """Pixels far apart, as of cloth too shiny for stereo."""
    thin = slice(None, None, 15)
    full = VIEWS[2]
    scattered = dataclasses.replace(
        full, points_rig=full.points_rig[thin], pixel=full.pixel[thin], rgb=None
    )
    views = [VIEWS[1], scattered, VIEWS[3]]
    values = pair_values(placed_views(views, CONFIG, no_progress, {}), CONFIG)
    by_ids = {frozenset((v.view_a, v.view_b)): v for v in values}
    assert by_ids[frozenset((1, 3))].value > 0.5
    assert not any(v.value for ids, v in by_ids.items() if 2 in ids)


def test_points_given_by_hand_choose_the_views_and_come_first():
    places = ((0.0, -0.03), (0.02, -0.2), (-0.02, -0.12))
    given = [sheet.pair_at(VIEWS[2:4], FLATS[2:4], *place) for place in places]
    garment = flatten_garment(VIEWS, given, TEMPLATES, CONFIG)
    assert garment.view_ids == (2, 3)
    assert garment.correspondences == tuple(given)
    assert "views_chosen" not in codes(garment)


def test_one_point_given_by_hand_is_filled_up():
    given = sheet.pair_at(VIEWS[2:4], FLATS[2:4], 0.0, -0.1)
    garment = flatten_garment(VIEWS, [given], TEMPLATES, CONFIG)
    assert garment.correspondences[0] == given
    assert [p.manual for p in garment.correspondences[1:]] == [False] * 8


def test_of_two_points_that_contradict_each_other_the_wrong_one_is_told():
    right = sheet.pair_at(VIEWS[2:4], FLATS[2:4], 0.0, -0.03)
    wrong = sheet.pair_at(VIEWS[2:4], FLATS[2:4], 0.0, -0.2, slip_m=0.05)
    garment = flatten_garment(VIEWS, [right, wrong], TEMPLATES, CONFIG)
    assert right in garment.correspondences and wrong not in garment.correspondences
    rejected = [n.text for n in garment.notices if n.code == "correspondence_rejected"]
    assert len(rejected) == 1
    assert f"view {wrong.view_a} pixel {wrong.pixel_a}" in rejected[0]
    off = float(rejected[0].split(" cm apart")[0].split()[-1])
    assert off == pytest.approx(5.0, abs=0.7)


def test_views_without_common_cloth_are_refused():
    with pytest.raises((DisconnectedSurface, InvalidCorrespondence)):
        flatten_garment([VIEWS[0], VIEWS[4]], (), TEMPLATES, CONFIG)
    bare = dataclasses.replace(
        VIEWS[2], points_rig=VIEWS[2].points_rig[:50], pixel=VIEWS[2].pixel[:50]
    )
    with pytest.raises(NotEnoughViews):
        flatten_garment([VIEWS[1], bare], (), TEMPLATES, CONFIG)


def test_features_are_left_out_on_request():
    config = dataclasses.replace(CONFIG, correspondences=CorrespondenceConfig(features=False))
    placed = placed_views(VIEWS[2:4], config, no_progress, {})
    assert len(corresponding(*placed, config)) >= 8
    assert fill_up((VIEWS[2], VIEWS[3]), config, no_progress) == corresponding(*placed, config)


def test_a_towels_end_at_the_gripper_is_called_bottom():
    towel = tuple(t for t in TEMPLATES if t.category == "towel")
    garment = flatten_garment(garments.example_views(), (), towel, CONFIG)
    height = {mark.name: mark.xyz_hanger[2] for mark in garment.landmarks}  # the tip is at 0
    for side in ("left", "right"):
        assert height[f"{side}_bottom_corner"] == pytest.approx(-garments.BELOW_TIP_M, abs=0.02)
        assert height[f"{side}_top_corner"] < -garments.HEIGHT_M
