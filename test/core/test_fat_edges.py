"""A column seen from all round by a camera that makes edges fat: other views tell by how much."""

from __future__ import annotations

import numpy as np
import pytest
from round_column import COLS, PITCH_M, ROWS, VIEWS, column

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.edges import (
    FEWEST,
    MOST_PX,
    farther_around,
    inside_edges,
    pixels_to_edge,
    with_rows,
)
from vflatten_ros.core.fat_edges import fat_px, notice_of
from vflatten_ros.core.registration import view_surface


def found_px(fat, views=VIEWS, noise_m=0.0005):
    config = RotationConfig()
    seen = [column(2 * np.pi * k / views, fat, noise_m) for k in range(views)]
    surfaces = [view_surface(view, config) for view in seen]
    to_edge = [pixels_to_edge(v, PITCH_M)[s.index] for v, s in zip(seen, surfaces, strict=True)]
    return fat_px(surfaces, [np.eye(4)] * views, to_edge, config, PITCH_M)


@pytest.mark.parametrize("fat", [0, 1, 2])
def test_other_views_tell_by_how_much_edges_are_fat(fat):
    assert found_px(fat) == fat


def test_of_very_fat_edges_most_is_found():
    assert found_px(3) in (2, 3)


def test_noise_is_not_taken_for_it():
    assert found_px(0, noise_m=0.002) == 0


def test_views_from_too_far_round_tell_nothing():
    assert found_px(2, views=4) == 0


def test_what_is_taken_off_is_the_fat():
    view = column(0.0, 2)
    rows = inside_edges(view, pixels_to_edge(view, PITCH_M), 2)
    kept, thin = with_rows(view, rows), column(0.0, 0)
    images = np.zeros((2, ROWS, COLS), dtype=bool)
    images[0][tuple(kept.pixel.T)], images[1][tuple(thin.pixel.T)] = True, True
    inner = images[:, 5:-5]  # the image ends there, too
    assert not (inner[0] & ~inner[1]).any()
    assert inner[0].sum() > 0.9 * inner[1].sum()
    np.testing.assert_array_equal(kept.points_rig, view.points_rig[rows])
    assert kept.rgb is None


def test_a_view_is_not_left_without_points():
    view = with_rows(column(0.0, 0), np.arange(FEWEST))
    to_edge = pixels_to_edge(view, PITCH_M)
    np.testing.assert_array_equal(inside_edges(view, to_edge, MOST_PX), np.arange(FEWEST))


def test_steps_within_the_item_are_edges_of_what_is_in_front_and_holes_are_none():
    pixel = np.argwhere(np.ones((30, 40))).astype(np.int32)
    depth = np.where(pixel[:, 1] < 20, 1.0, 1.1)
    hole = (np.abs(pixel - [15, 10]) <= 1).all(axis=1)
    pixel, depth = pixel[~hole], depth[~hole]
    farther = farther_around(pixel, depth, 3)
    inner = (pixel[:, 0] > 5) & (pixel[:, 0] < 25) & (pixel[:, 1] > 5) & (pixel[:, 1] < 34)
    for k, away in enumerate(farther, start=1):
        front = inner & (pixel[:, 1] < 20) & (pixel[:, 1] >= 20 - k)
        np.testing.assert_allclose(away[front], 0.1, atol=1e-6)
        assert (away[inner & ~front] <= 1e-6).all()
        assert np.isinf(away[pixel[:, 0] < k]).all()


def test_the_notice_says_what_to_set():
    assert "2 more in segmentation.trim_px" in notice_of(2).text and "2 pixels" in notice_of(2).text
    assert "1 pixel," in notice_of(1).text
