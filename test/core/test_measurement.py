"""Sizes of a rectangle whose ends are seen or not, from few views or many."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from flat import lying_at

from vflatten_ros.categories import load_templates
from vflatten_ros.core.config import MeasurementConfig, RecognitionConfig
from vflatten_ros.core.held_end import held_end_below
from vflatten_ros.core.measurement import measure
from vflatten_ros.core.recognition import recognise
from vflatten_ros.core.values import FlatPoints, Outline

WIDTH_M, LENGTH_M, STEP_M = 0.34, 0.60, 0.005
CONFIG = RecognitionConfig()
TOWEL = tuple(t for t in load_templates() if t.category == "towel")


def rectangle(*, top_seen: bool) -> Outline:
    """Counter-clockwise from the origin; the upper side is 'top'."""
    u, v = np.arange(0, WIDTH_M, STEP_M), np.arange(0, LENGTH_M, STEP_M)
    sides = [
        np.column_stack([u, 0 * u]),
        np.column_stack([0 * v + WIDTH_M, v]),
        np.column_stack([WIDTH_M - u, 0 * u + LENGTH_M]),
        np.column_stack([0 * v, LENGTH_M - v]),
    ]
    inferred = np.repeat([False, False, not top_seen, False], [len(side) for side in sides])
    return Outline(np.vstack(sides), np.where(inferred, 0.03, 0.002), inferred)


def cloth(views: int, length_m=LENGTH_M, strip_m=0.0, strip_width_m=0.0) -> FlatPoints:
    """Points all over the rectangle, of so many views in turn; a strip at its right is longer."""
    u, v = np.meshgrid(np.arange(0.005, WIDTH_M, 0.01), np.arange(0.005, length_m + strip_m, 0.01))
    uv = np.column_stack([u.ravel(), v.ravel()])
    uv = uv[(uv[:, 1] < length_m) | (uv[:, 0] > WIDTH_M - strip_width_m)]
    return lying_at(uv, views=views)


def measured(*, top_seen=True, views=2, **settings):
    outline, points = rectangle(top_seen=top_seen), cloth(views)
    found = recognise(outline, points, TOWEL, RecognitionConfig())
    result = measure(found, outline, points, MeasurementConfig(**settings))
    return result, {size.name: size for size in result.measurements}


def codes(result) -> set[str]:
    return {notice.code for notice in result.notices}


def test_sizes_that_are_seen_are_right_and_not_flagged():
    result, size = measured()
    assert size["width"].value_m == pytest.approx(WIDTH_M, abs=0.003)
    assert size["length"].value_m == pytest.approx(LENGTH_M, abs=0.003)
    assert not size["width"].inferred and not size["length"].inferred
    assert codes(result) == {"ends_alike"}


def test_a_length_whose_end_no_view_shows_is_flagged_and_uncertain():
    result, size = measured(top_seen=False)
    assert size["length"].inferred and not size["width"].inferred
    assert "length_unseen" in codes(result)
    share = size["length"].sigma_m / size["length"].value_m
    assert share > MeasurementConfig().unseen_share
    assert size["width"].sigma_m < 0.02 * WIDTH_M  # what is seen stays certain


def test_a_landmark_that_no_view_shows_hangs_no_farther_from_seen_cloth_than_it_lies():
    outline, points = rectangle(top_seen=True), cloth(2)
    hidden = np.linalg.norm(points.uv, axis=1) < 0.08  # by the fingers that hold the corner
    points = dataclasses.replace(points, inferred=hidden)
    found = recognise(outline, points, TOWEL, RecognitionConfig())
    marks = measure(found, outline, points, MeasurementConfig()).landmarks
    corner = [mark for mark in marks if not mark.seen]
    assert len(marks) >= 4 and len(corner) == 1
    assert corner[0].uv == pytest.approx((0.0, 0.0), abs=0.004)
    off = np.linalg.norm(np.array(corner[0].xyz_hanger) - [*corner[0].uv, 0.0])  # hangs as it lies
    assert 0.07 < off <= corner[0].xyz_sigma_m < 0.1
    assert corner[0].views == () and corner[0].certainty < 0.25


def test_a_strip_that_reaches_beyond_an_unseen_end_does_not_show_it():
    inner = WIDTH_M - 0.04
    corners = np.array(
        [(0, 0), (WIDTH_M, 0), (WIDTH_M, 0.75), (inner, 0.75), (inner, 0.45), (0, 0.45), (0, 0)]
    )
    unseen = [False, False, True, False, True, False]  # its tip, and the cloth beside it
    lines = [
        a + np.arange(0.0, 1.0, STEP_M / np.linalg.norm(b - a))[:, None] * (b - a)
        for a, b in itertools.pairwise(corners)
    ]
    inferred = np.repeat(unseen, [len(line) for line in lines])
    outline = Outline(np.vstack(lines), np.where(inferred, 0.03, 0.002), inferred)
    points = cloth(views=3, length_m=0.45, strip_m=0.3, strip_width_m=0.04)
    found = recognise(outline, points, TOWEL, RecognitionConfig())
    result = measure(found, outline, points, MeasurementConfig())
    size = {s.name: s for s in result.measurements}
    assert size["length"].inferred
    assert size["length"].sigma_m > 0.2 * size["length"].value_m  # as towels differ
    assert not size["width"].inferred and size["width"].sigma_m < 0.01


def test_the_size_that_is_seen_decides_on_trust():
    result, _ = measured(top_seen=False, unseen_share=0.9)
    assert "untrusted" not in codes(result)
    result, _ = measured(top_seen=False, trusted_quality=1.0)
    assert "untrusted" in codes(result)


def test_few_views_make_sizes_and_places_less_certain_than_many():
    few, few_sizes = measured(views=2, few_views_factor=3.0)
    many, many_sizes = measured(views=3, few_views_factor=3.0)
    for name in ("width", "length"):
        assert few_sizes[name].value_m == pytest.approx(many_sizes[name].value_m)
        assert few_sizes[name].sigma_m == pytest.approx(3.0 * many_sizes[name].sigma_m, rel=0.01)
    ratio = [a.uv_sigma_m / b.uv_sigma_m for a, b in zip(few.landmarks, many.landmarks)]
    assert ratio == pytest.approx(np.full(len(ratio), 3.0), rel=0.01)


def test_a_landmark_on_a_part_that_may_lie_turned_over_hangs_there_or_there():
    outline, points = rectangle(top_seen=True), cloth(2)
    upper = points.uv[:, 1] > LENGTH_M / 2
    either = dataclasses.replace(points, astray_m=np.where(upper, 0.12, 0.0))
    found = recognise(outline, points, TOWEL, RecognitionConfig())
    before, after = (
        {mark.name: mark for mark in measure(found, outline, p, MeasurementConfig()).landmarks}
        for p in (points, either)
    )
    on_it = {name for name, mark in before.items() if mark.uv[1] > 0.9 * LENGTH_M}
    assert len(on_it) == 2
    for name, mark in after.items():
        there = mark.xyz_hanger, mark.views
        assert there == (before[name].xyz_hanger, before[name].views)
        if name in on_it:
            assert mark.xyz_sigma_m == pytest.approx(0.06, abs=0.01)  # half of it either way
            assert mark.certainty < 0.4 * before[name].certainty
        elif name != "centre":
            assert mark == before[name]


def test_the_corners_of_a_towel_held_by_its_middle_may_be_named_the_other_way_round():
    outline = rectangle(top_seen=True)
    points = hanging(cloth(2), (WIDTH_M / 2, LENGTH_M / 2))
    found = held_end_below(recognise(outline, points, TOWEL, CONFIG), points)
    result = measure(found, outline, points, MeasurementConfig())
    (text,) = [notice.text for notice in result.notices if notice.code == "ends_alike"]
    assert "may be exchanged" in text
    certainty = {mark.name: mark.certainty for mark in result.landmarks}
    assert certainty.pop("centre") > 0.9
    assert len(certainty) == 4
    assert all(0.4 < corner <= 0.5 for corner in certainty.values())


def test_the_ends_of_a_skirt_that_flares_are_told_apart():
    wide, narrow = np.array([[0.0, 0.0], [0.5, 0.0]]), np.array([[0.4, 0.4], [0.1, 0.4]])
    corners = np.vstack([wide, narrow])
    share = np.linspace(0, 1, 80, endpoint=False)[:, None]
    uv = np.vstack(
        [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
    )
    outline = Outline(uv, np.full(len(uv), 0.002), np.zeros(len(uv), dtype=bool))
    points = cloth(24)
    inside = np.abs(points.uv[:, 0] - 0.25) < 0.25 - 0.25 * points.uv[:, 1]
    inside &= points.uv[:, 1] < 0.4
    arrays = {f.name: getattr(points, f.name) for f in dataclasses.fields(FlatPoints)}
    some = FlatPoints(**{name: a[inside] for name, a in arrays.items() if a is not None})
    skirt = tuple(t for t in load_templates() if t.category == "skirt")
    found = recognise(outline, some, skirt, RecognitionConfig())
    result = measure(found, outline, some, MeasurementConfig())
    assert "ends_alike" not in codes(result)
    assert max(mark.certainty for mark in result.landmarks) > 0.6


def hanging(points, corner):
    """The points as they hang from a place of the flat item, straight down."""
    away = np.linalg.norm(points.uv - corner, axis=1)
    none = np.zeros_like(away)
    return dataclasses.replace(points, xyz_hanger=np.column_stack([none, none, -away]))


@pytest.mark.parametrize(
    "corner", [(0.0, 0.0), (WIDTH_M, 0.0), (0.0, LENGTH_M), (WIDTH_M, LENGTH_M)]
)
def test_the_end_of_a_towel_at_the_gripper_is_the_bottom_one(corner):
    outline, points = rectangle(top_seen=True), hanging(cloth(24), corner)
    found = held_end_below(recognise(outline, points, TOWEL, CONFIG), points)
    result = measure(found, outline, points, MeasurementConfig())
    marks = {mark.name: mark for mark in result.landmarks}
    away = {name: np.linalg.norm(np.array(mark.uv) - corner) for name, mark in marks.items()}
    assert min(away, key=away.get) in ("left_bottom_corner", "right_bottom_corner")
    assert min(away.values()) < 0.01
    assert marks["left_top_corner"].certainty > 0.6  # by convention: no doubt which is meant
    sizes = {size.name: size.value_m for size in result.measurements}
    assert sizes["width"] == pytest.approx(WIDTH_M, abs=0.003)
    assert sizes["length"] == pytest.approx(LENGTH_M, abs=0.003)
    (text,) = [notice.text for notice in result.notices if notice.code == "ends_alike"]
    assert "the one at the gripper is called bottom" in text


@pytest.mark.parametrize("corner", [(0.0, 0.0), (WIDTH_M, LENGTH_M)])
def test_the_waist_of_a_skirt_is_not_a_matter_of_the_hold(corner):
    outline, points = rectangle(top_seen=True), hanging(cloth(24), corner)
    skirt = tuple(t for t in load_templates() if t.category == "skirt")
    found = recognise(outline, points, skirt, CONFIG)
    assert held_end_below(found, points) is found
    result = measure(found, outline, points, MeasurementConfig())
    (text,) = [notice.text for notice in result.notices if notice.code == "ends_alike"]
    assert "may be exchanged" in text


def test_naming_the_ends_changes_no_size_no_place_and_no_certainty():
    outline = rectangle(top_seen=False)
    either = []
    for corner in ((0.0, 0.0), (WIDTH_M, LENGTH_M)):
        points = hanging(cloth(24), corner)
        found = held_end_below(recognise(outline, points, TOWEL, CONFIG), points)
        unseen = found.template_uv[~found.template_seen]
        assert len(unseen) and np.allclose(
            unseen[:, 1], LENGTH_M, atol=0.01
        )  # the flat frame's top
        either.append(measure(found, outline, points, MeasurementConfig()))
    one, other = either
    for a, b in zip(one.measurements, other.measurements, strict=True):
        assert (a.name, a.inferred) == (b.name, b.inferred)
        assert (a.value_m, a.sigma_m) == pytest.approx((b.value_m, b.sigma_m), rel=1e-9)
    opposite = {"left_top": "right_bottom", "right_top": "left_bottom"}
    marks = {mark.name: mark for mark in other.landmarks}
    for mark in one.landmarks:
        for a, b in opposite.items():
            if mark.name in (f"{a}_corner", f"{b}_corner"):
                twin = marks[f"{b if mark.name.startswith(a) else a}_corner"]
                assert mark.uv == pytest.approx(twin.uv, abs=1e-9)
                assert mark.uv_sigma_m == pytest.approx(twin.uv_sigma_m, rel=1e-6)
