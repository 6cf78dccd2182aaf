"""A sheet before cameras of several resolutions: as many points as the method needs are left."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from column import CALIBRATION

from vflatten_ros.core.config import Config, RotationConfig
from vflatten_ros.core.geometry import inverse, transform_points
from vflatten_ros.core.observation import locate, observe
from vflatten_ros.core.registration import view_surface
from vflatten_ros.core.thinning import thinned
from vflatten_ros.core.values import View, no_progress

AWAY_M, FOCAL_PX = 1.3, 500.0  # 2.6 mm from pixel to pixel


def sheet(finer=1.0, noise_m=0.001):
    """A wavy sheet, 20 cm square, by an image so many times finer than the config is for."""
    rows, cols = round(480 * finer), round(360 * finer)
    row, col = (v.ravel() for v in np.mgrid[0:rows, 0:cols])
    focal = FOCAL_PX * finer
    ray = np.c_[(col - cols / 2) / focal, (row - rows / 2) / focal, np.ones(len(row))]
    depth = AWAY_M + 0.01 * np.sin(40.0 * ray[:, 0] * AWAY_M)
    depth += np.random.default_rng(5).normal(0.0, noise_m, len(row))
    on = (np.abs(ray[:, :2]) < 0.1 / AWAY_M).all(axis=1)
    pixel = np.c_[row, col][on].astype(np.int32)
    rgb = (pixel[:, [0, 1, 1]] % 256).astype(np.uint8)
    return View(0, 0, 0.3, depth[on, None] * ray[on], pixel, rgb, (rows, cols), CALIBRATION)


@pytest.mark.parametrize("finer", [0.5, 1.0, 2.0, 2.5])
def test_points_as_far_apart_as_the_method_is_for_are_all_needed(finer):
    view = sheet(finer)
    same, rows = thinned(view, RotationConfig())
    assert same is view
    np.testing.assert_array_equal(rows, np.arange(len(view.pixel)))


@pytest.mark.parametrize(("finer", "step"), [(3.0, 2), (3.6, 2), (4.5, 3)])
@pytest.mark.parametrize("noise_m", [0.0, 0.002])
def test_of_finer_images_as_many_rows_and_columns_are_left_as_are_needed(finer, step, noise_m):
    view = sheet(finer, noise_m)
    smaller, rows = thinned(view, RotationConfig())
    assert len(rows) == pytest.approx(len(view.pixel) / step**2, rel=0.05)
    np.testing.assert_array_equal(step * smaller.pixel, view.pixel[rows])
    np.testing.assert_array_equal(smaller.points_rig, view.points_rig[rows])
    np.testing.assert_array_equal(smaller.rgb, view.rgb[rows])
    assert (smaller.pixel.max(axis=0) < smaller.shape).all()
    assert abs(np.array(smaller.shape) * step - view.shape).max() < step


def test_what_was_thinned_stays_as_it_is_even_if_much_was_taken_away():
    view = sheet(3.0)
    smaller, rows = thinned(view, RotationConfig())
    some = rows[np.random.default_rng(1).random(len(rows)) < 0.9]
    left = dataclasses.replace(
        view, points_rig=view.points_rig[some], pixel=view.pixel[some], rgb=None
    )
    again, kept = thinned(left, RotationConfig())
    np.testing.assert_array_equal(kept, np.arange(len(some)))
    assert again.shape == smaller.shape and (again.pixel * 2 == left.pixel).all()
    elsewhere = dataclasses.replace(left, pixel=left.pixel + np.int32(1))  # thinned by a camera
    assert thinned(elsewhere, RotationConfig())[0] is elsewhere


def test_of_an_unorganised_cloud_all_points_are_needed():
    view = sheet(3.0)
    pixel = np.column_stack([np.zeros(len(view.pixel)), np.arange(len(view.pixel))])
    cloud = dataclasses.replace(view, pixel=pixel.astype(np.int32), shape=(1, len(pixel)))
    assert thinned(cloud, RotationConfig())[0] is cloud


def test_a_surface_says_of_which_of_all_points_it_is():
    view = sheet(3.0)
    surface = view_surface(view, RotationConfig())
    assert 0.24 < len(surface.index) / len(view.pixel) < 0.26
    T_hanger_rig = inverse(CALIBRATION.T_rig_hanger(view.angle_rad))
    there = transform_points(T_hanger_rig, view.points_rig[surface.index])
    np.testing.assert_allclose(surface.points, there, atol=1e-12)
    assert surface.sight is not None and surface.sight.shape == (720, 540)
    assert abs(surface.grain.pitch_m - 0.0018) < 0.0002


def test_one_view_is_fitted_by_fewer_points_with_the_pixels_of_the_whole_image():
    view = sheet(3.0)
    seen = observe(view, Config(), no_progress)
    assert len(seen.view.pixel) == pytest.approx(len(view.pixel) / 4, rel=0.05)
    assert max(seen.surface.rays.shape) < 130  # of the 231 rows and columns that show the sheet
    at = {tuple(pixel): point for pixel, point in zip(view.pixel.tolist(), view.points_rig)}
    for pixel, point in zip(seen.view.pixel.tolist(), seen.view.points_rig):
        np.testing.assert_array_equal(point, at[tuple(pixel)])
    asked = (int(view.pixel[:, 0].mean()) | 1, int(view.pixel[:, 1].mean()) | 1)  # was left out
    found = seen.view.pixel[locate(seen, asked, 3)]
    assert np.abs(found - asked).max() == 1
