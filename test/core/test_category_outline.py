"""A rectangle of which a corner is missing, seen to end there or not, or too much is there."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from flat import lying_at

from vflatten_ros.categories import load_templates
from vflatten_ros.core.category_outline import (
    DEEP_M,
    deep_inside_m,
    missing_share,
    with_category,
)
from vflatten_ros.core.config import RecognitionConfig
from vflatten_ros.core.geometry import twice_area
from vflatten_ros.core.recognition import recognise
from vflatten_ros.core.values import Outline

WIDTH_M, LENGTH_M, NOTCH_M, STEP_M = 0.34, 0.60, 0.10, 0.004
TOWEL = tuple(t for t in load_templates() if t.category == "towel")
CORNERS = np.array(
    [
        [0.0, 0.0],
        [WIDTH_M, 0.0],
        [WIDTH_M, LENGTH_M - NOTCH_M],
        [WIDTH_M - NOTCH_M, LENGTH_M - NOTCH_M],
        [WIDTH_M - NOTCH_M, LENGTH_M],
        [0.0, LENGTH_M],
    ]
)
NOTCH = (2, 3)  # the sides where it ends


MISFIT_M = RecognitionConfig().misfit_m


def notched(inferred_sides=NOTCH, step=1, corners=CORNERS):
    """Outline and points of the rectangle; `step` -1 goes round it the other way."""
    parts, inferred = [], []
    for k, (start, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        count = round(float(np.abs(end - start).sum()) / STEP_M)
        parts.append(start + np.linspace(0, 1, count, endpoint=False)[:, None] * (end - start))
        inferred.append(np.full(count, k in inferred_sides))
    uv, flags = np.vstack(parts)[::step], np.concatenate(inferred)[::step]
    u, v = (
        x.ravel() for x in np.meshgrid(np.arange(0.005, 0.34, 0.01), np.arange(0.005, 0.6, 0.01))
    )
    inside = (u < WIDTH_M - NOTCH_M) | (v < LENGTH_M - NOTCH_M)
    cloth = lying_at(np.column_stack([u, v])[inside])
    return Outline(uv, np.full(len(uv), 0.002), flags), cloth


def area(outline):
    return twice_area(outline.uv) / 2


def fit_of(outline, points):
    fit = recognise(outline, points, TOWEL, RecognitionConfig()).fit
    assert fit is not None
    return fit


@pytest.mark.parametrize("step", [1, -1])
def test_a_corner_that_no_view_shows_is_the_category_s(step):
    outline, points = notched(step=step)
    found = with_category(outline, fit_of(outline, points), MISFIT_M)
    assert step * area(found) == pytest.approx(WIDTH_M * LENGTH_M, rel=0.01)
    away = np.abs(found.uv - CORNERS[3] - NOTCH_M).max(axis=1)
    added = away < 0.8 * NOTCH_M
    assert found.inferred[added].all()
    assert not found.inferred[away > 1.3 * NOTCH_M].any()
    assert (found.sigma_m[added] > 0.002).all()
    assert (found.sigma_m[away > 1.3 * NOTCH_M] == 0.002).all()


@pytest.mark.parametrize(("inferred_sides", "kept"), [((), 0.85), ((5,), 0.85), ((2,), 0.0)])
def test_what_differs_a_little_stays_if_it_was_seen(inferred_sides, kept):
    little = 0.008
    corners = CORNERS + np.array([[0, 0], [0, 0], [0, -0.1], [0.0, -0.1], [0, 0], [0, 0]])
    corners[2:5, 1] = LENGTH_M - little * np.array([1, 1, 0])
    outline, points = notched(inferred_sides, corners=corners)
    found = with_category(outline, fit_of(outline, points), MISFIT_M)
    middle = np.abs(found.uv - [WIDTH_M - NOTCH_M / 2, LENGTH_M]) < [0.2 * NOTCH_M, 0.05]
    step = LENGTH_M - found.uv[middle.all(axis=1), 1]
    assert step.mean() == pytest.approx(kept * little, abs=0.002)
    assert found.inferred[middle.all(axis=1)].any() == (kept == 0.0)


def test_what_was_seen_to_differ_much_is_the_category_s_and_said_to_be():
    tail = np.array([[0.0, 0.2], [-0.12, 0.2], [-0.12, 0.17], [0.0, 0.17]])
    outline, points = notched((), corners=np.vstack([CORNERS, tail]))
    fit = fit_of(outline, points)
    found = with_category(outline, fit, MISFIT_M)
    assert area(found) == pytest.approx(WIDTH_M * LENGTH_M, rel=0.02)
    assert found.uv[:, 0].min() > -0.02
    corner = np.abs(found.uv - CORNERS[3] - NOTCH_M).max(axis=1) < 0.5 * NOTCH_M
    assert corner.any() and found.inferred[corner].all()
    assert found.inferred.mean() < 0.3
    wide = with_category(outline, fit, 10 * MISFIT_M)  # of which it could be any such item
    assert area(wide) < WIDTH_M * LENGTH_M - 0.6 * NOTCH_M**2
    assert wide.uv[:, 0].min() < -0.05


@pytest.mark.parametrize("start", [0, 40, -235])  # the last begins within the notch
def test_how_much_of_a_seen_outline_the_category_leaves_inside(start):
    outline, points = notched()
    fit = fit_of(outline, points)
    assert deep_inside_m(outline, fit) == 0.0  # no view shows it
    shown, _ = notched(inferred_sides=())
    turned = Outline(
        *(np.roll(x, start, axis=0) for x in (shown.uv, shown.sigma_m, shown.inferred))
    )
    assert deep_inside_m(turned, fit) == pytest.approx(2 * (NOTCH_M - DEEP_M), abs=0.012)


def test_what_of_the_category_is_missing_is_a_patch_and_no_strip():
    rectangle = np.array([[0.0, 0.0], [WIDTH_M, 0.0], [WIDTH_M, LENGTH_M], [0.0, LENGTH_M]])
    fit = SimpleNamespace(points=lambda: rectangle, template=SimpleNamespace(vertices=4))
    share = NOTCH_M**2 / (WIDTH_M * LENGTH_M)
    assert missing_share(notched()[0], fit) == pytest.approx(share, abs=0.006)
    assert missing_share(notched(corners=rectangle)[0], fit) == 0.0
    for narrower_m, missing in ((0.03, 0.0), (0.08, 0.08 / WIDTH_M)):
        narrow = notched(corners=rectangle * [1.0 - narrower_m / WIDTH_M, 1.0])[0]
        assert missing_share(narrow, fit) == pytest.approx(missing, abs=0.02)
    beyond = notched(corners=rectangle * 1.1)[0]
    assert missing_share(beyond, fit) == 0.0
