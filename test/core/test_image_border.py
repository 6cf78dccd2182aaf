"""Views of a strip of cloth that the image cuts off, or that ends before it does."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from column import CALIBRATION

from vflatten_ros.core.image_border import cut_off, cut_off_now
from vflatten_ros.core.values import View

SHAPE = (100, 80)


def strip(view_id, rows, cols, shape=SHAPE):
    """A view that shows the item in these rows and columns, both ends included."""
    row, col = np.mgrid[rows[0] : rows[1] + 1, cols[0] : cols[1] + 1]
    pixel = np.column_stack([row.ravel(), col.ravel()]).astype(np.int32)
    return View(view_id, 0, 0.0, np.zeros((len(pixel), 3)), pixel, None, shape, CALIBRATION)


def codes(views):
    return [notice.code for notice in cut_off(views)]


def wedges(lowest):
    """Views of a corner that hangs down to these rows, one pixel wide at its end."""
    views = []
    for k, end in enumerate(lowest):
        view = strip(k, (20, end), (30, 50))
        row, col = view.pixel.T
        views.append(dataclasses.replace(view, pixel=view.pixel[abs(col - 40) <= end - row]))
    return views


def test_an_item_within_the_image_is_not_cut_off():
    assert codes(wedges([70 + k % 5 for k in range(12)])) == []


@pytest.mark.parametrize(
    ("rows", "cols", "side"),
    [
        ((0, 60), (30, 50), "upper"),
        ((20, 99), (30, 50), "lower"),
        ((20, 60), (0, 50), "left"),
        ((20, 60), (30, 79), "right"),
    ],
)
def test_the_side_and_the_number_of_views_are_told(rows, cols, side):
    within = [strip(k, (20 + k, 60 + k), (30 + k, 50 + k)) for k in range(8)]
    views = [*within, strip(8, rows, cols), strip(9, rows, cols)]
    (notice,) = cut_off(views)
    assert notice.code == "truncated"
    assert f"the {side} one in 2 of 10 views" in notice.text


def test_what_most_views_cut_off_is_not_trusted():
    inside, beyond = strip(0, (20, 60), (30, 50)), strip(1, (20, 98), (45, 50))
    assert codes([beyond, *[inside] * 2]) == ["truncated"]
    truncated, untrusted = cut_off([beyond, beyond, inside])
    assert (truncated.code, untrusted.code) == ("truncated", "untrusted")
    assert "lower border" in untrusted.text


def test_some_stray_pixels_at_the_border_cut_nothing_off():
    inside = strip(0, (20, 60), (30, 50))
    assert codes([strip(1, (96, 99), (30, 31)), inside, inside]) == ["truncated"]  # three rows
    assert codes([strip(1, (96, 98), (30, 31)), inside, inside]) == []


def test_a_straight_cut_within_the_border_is_one():
    """There is no depth in the last rows; most views end at the same one, straight."""
    cut = [strip(k, (20, 80), (30 + k, 50)) for k in range(6)]
    whole = wedges([75] * 6)
    assert codes([*cut, *whole]) == ["truncated", "untrusted"]
    assert codes([*cut[:5], *whole]) == []  # as some hems may lie
    assert codes(cut[:2]) == []  # of two views, both may
    one_row_less = [strip(k, (20, 79), (30 + k, 50)) for k in range(6)]
    assert codes([*cut[:5], *one_row_less]) == []
    other = strip(12, (20, 80), (30, 50), shape=(200, 160))
    assert codes([*cut, other]) == []  # images of two sizes have no rows in common


@pytest.mark.parametrize(
    ("up", "named"), [((0, 1, 0), "upper"), ((1, 0, 0), "left"), ((-1, 0, 0), "right")]
)
def test_a_camera_may_stand_on_its_head_or_on_its_side(up, named):
    turned = dataclasses.replace(CALIBRATION, axis_direction=up)
    view = dataclasses.replace(strip(0, (20, 60), (30, 50)), calibration=turned)
    views = [view] * 4  # straight on all sides
    truncated, _ = cut_off(views)
    assert f"the {named} one in 4 of 4 views" in truncated.text


def test_in_a_frame_that_is_no_cameras_below_is_no_side():
    level = dataclasses.replace(CALIBRATION, axis_direction=(0.0, 0.0, 1.0))  # x forward, z up
    assert codes([dataclasses.replace(strip(0, (20, 60), (30, 50)), calibration=level)] * 4) == []


def test_unorganised_clouds_have_no_border():
    view = dataclasses.replace(strip(0, (0, 0), (0, 500)), shape=(1, 501))
    assert cut_off([view]) == ()


def test_one_view_is_told_as_it_arrives():
    assert cut_off_now(strip(0, (20, 60), (30, 50))) == ""
    assert "the lower and right border" in cut_off_now(strip(0, (20, 98), (30, 79)))
    assert cut_off_now(strip(0, (0, 0), (0, 50), (1, 80))) == ""  # unorganised
