"""Corresponding points of registered views against the flat places of a known sheet."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from sheet import HEIGHT_M, WIDTH_M, a_print, plain, seen_from, stripes

from vflatten_ros.core.config import CorrespondenceConfig, RotationConfig
from vflatten_ros.core.correspondences import as_pairs, common_cloth, place_view, spread
from vflatten_ros.core.geometry import rigid
from vflatten_ros.core.prints import agreeing, common_features
from vflatten_ros.core.registration import view_surface

CONFIG = CorrespondenceConfig()
ANGLES = (-0.35, 0.35)
PIXEL_M = 0.0025


def placed(colour=None, angles=ANGLES, noise=0.0, shift=(0.0, 0.0, 0.0)):
    """Two views of the sheet and their flat places; the second put off by `shift`."""
    seen = [seen_from(k, angle, colour=colour, noise=noise) for k, angle in enumerate(angles)]
    poses = [np.eye(4), rigid(np.eye(3), np.array(shift))]
    views = [
        place_view(view, view_surface(view, RotationConfig(), prints=True), pose)
        for (view, _), pose in zip(seen, poses, strict=True)
    ]
    return views, [flat for _, flat in seen]


def misses(views, flats, matches):
    rows = views[0].row[matches.a], views[1].row[matches.b]
    return np.linalg.norm(flats[0][rows[0]] - flats[1][rows[1]], axis=1)


def test_what_both_views_show_corresponds_to_a_pixel():
    views, flats = placed(noise=0.0005)
    found = common_cloth(*views, CONFIG)
    assert len(found.a) > 1000
    assert np.median(misses(views, flats, found)) < PIXEL_M
    assert misses(views, flats, found).max() < 2 * PIXEL_M


def test_pairs_name_the_pixels_and_are_not_manual():
    views, flats = placed()
    pairs = as_pairs(*views, common_cloth(*views, CONFIG))
    place = [
        {tuple(p): uv for p, uv in zip(v.view.pixel.tolist(), flat, strict=True)}
        for v, flat in zip(views, flats, strict=True)
    ]
    off = [np.linalg.norm(place[0][p.pixel_a] - place[1][p.pixel_b]) for p in pairs]
    assert max(off) < 2 * PIXEL_M
    assert not any(p.manual for p in pairs) and all(0 <= p.confidence <= 1 for p in pairs)


def test_cloth_near_its_end_or_seen_from_the_side_is_less_sure():
    views, flats = placed()
    found = common_cloth(*views, CONFIG)
    at = flats[0][views[0].row[found.a]]
    away = np.minimum(-at[:, 1], HEIGHT_M + at[:, 1])
    facing = np.minimum(views[0].facing[found.a], views[1].facing[found.b])
    frontal = (facing > 0.8) & (np.abs(at[:, 0]) < WIDTH_M / 4)
    sure = np.median(found.confidence[frontal & (away > 0.03)])
    assert np.median(found.confidence[frontal & (away < 0.003)]) < 0.2 * sure
    assert np.median(found.confidence[(facing < 0.55) & (away > 0.03)]) < 0.7 * sure


def test_another_layer_four_millimetres_behind_is_not_taken_for_the_same():
    views, _ = placed(shift=(0.004, 0.0, 0.0))  # along the normals in the middle
    found = common_cloth(*views, CONFIG)
    middle = np.abs(views[0].points[found.a, 1]) < 0.03
    assert not middle.any()


def test_the_chosen_points_are_spread_and_start_with_the_surest():
    points = np.c_[np.linspace(0, 1, 101), np.zeros((101, 2))]
    sure = np.where(np.arange(101) == 40, 1.0, 0.9)
    sure[100] = 0.01
    picked = spread(points, sure, 3)
    assert picked[0] == 40
    assert set(picked[1:].tolist()) == {0, 99}
    assert len(spread(points[:2], sure[:2], 5)) == 2
    assert not len(spread(points[:0], sure[:0], 5))


def test_a_print_gives_features_at_the_same_place_of_the_cloth():
    views, flats = placed(a_print)
    found = common_features(*views, CONFIG)
    assert len(found.a) > 20
    assert np.median(misses(views, flats, found)) < PIXEL_M
    assert np.quantile(misses(views, flats, found), 0.95) < 2 * PIXEL_M


def test_a_print_tells_how_far_surfaces_have_slid_along_one_another():
    """Surfaces put 8 mm too high look well registered; features say otherwise."""
    views, flats = placed(a_print, shift=(0.0, 0.0, 0.008))
    slid = common_cloth(*views, CONFIG)
    assert np.median(misses(views, flats, slid)) > 0.006
    found = common_features(*views, CONFIG)
    assert len(found.a) > 10
    assert np.median(misses(views, flats, found)) < PIXEL_M
    off = views[1].points[found.b] - views[0].points[found.a]
    assert np.median(off[:, 2]) == pytest.approx(0.008, abs=0.001)


def test_plain_fabric_gives_few_features_and_no_wrong_ones():
    views, _ = placed(plain)
    found = common_features(*views, CONFIG)
    assert len(found.a) < 5
    assert not len(placed()[0][0].features.at)  # no colour at all


def test_stripes_are_not_taken_for_their_neighbours():
    views, flats = placed(stripes)
    found = common_features(*views, CONFIG)
    assert (misses(views, flats, found) > 0.008).mean() < 0.05 if len(found.a) else True


def test_features_count_only_if_they_agree_on_one_motion():
    rng = np.random.default_rng(1)
    q = rng.uniform(-0.1, 0.1, (40, 3))
    p = q + np.array([0.004, 0.0, 0.006])
    p[30:] += rng.uniform(-0.02, 0.02, (10, 3))
    agree, miss = agreeing(p, q, 0.003)
    assert agree[:30].all()
    assert (agree[30:] == (miss[30:] < 0.003)).all() and agree[30:].sum() < 4
    scattered = q + rng.uniform(-0.015, 0.015, q.shape)
    assert agreeing(scattered, q, 0.003)[0].mean() < 0.35


def test_the_same_views_give_the_same_features():
    one, other = (
        common_features(*views, CONFIG) for views in (placed(a_print)[0], placed(a_print)[0])
    )
    for field in dataclasses.fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))
