"""The smoothed surface of known shapes."""

from __future__ import annotations

import numpy as np
import pytest
import synthetic
from scipy.ndimage import binary_erosion

from vflatten_ros.core.config import SurfaceConfig
from vflatten_ros.core.errors import InvalidInput
from vflatten_ros.core.raygrid import camera_rays
from vflatten_ros.core.surface import fit_surface
from vflatten_ros.core.weighted_planes import spline_weight


def fitted(patch, noise_m=0.0, correlation=0.0, seed=1, **config):
    points = patch.points(noise_m, correlation, seed)
    return fit_surface(
        points, SurfaceConfig(**config), synthetic.TOWARD, patch.pixel, patch.mask.shape
    )


def depth_error(patch, surface) -> np.ndarray:
    return (surface.points - patch.xyz[patch.mask])[:, 2]


def test_the_weight_of_the_paper_is_a_fourth_order_spline():
    assert spline_weight(np.array([0.0, 1.0, 2.0])) == pytest.approx([1.0, 0.0, 0.0])
    step = 1e-6  # flat at both ends
    assert spline_weight(np.array([step]))[0] == pytest.approx(1.0, abs=1e-10)
    assert spline_weight(np.array([1 - step]))[0] == pytest.approx(0.0, abs=1e-10)


@pytest.mark.parametrize("fit", ["linear", "quadratic"])
def test_a_plane_is_reproduced(fit):
    patch = synthetic.plane(step_m=0.005)
    surface = fitted(patch, fit=fit)
    assert np.abs(depth_error(patch, surface)).max() < 1e-6
    exact = np.array([-0.3, -0.2, 1.0]) / np.sqrt(1.13)
    # the patch is turned by 20 degrees about the view
    turn = np.radians(20)
    exact = np.array(
        [
            [np.cos(turn), -np.sin(turn), 0.0],
            [np.sin(turn), np.cos(turn), 0.0],
            [0.0, 0.0, 1.0],
        ]
    ) @ exact  # fmt: skip
    assert surface.normals == pytest.approx(
        np.broadcast_to(exact, (len(surface.points), 3)), abs=1e-5
    )


def test_smoothing_takes_most_of_the_noise_away():
    patch = synthetic.curtain(0.020)
    error = depth_error(patch, fitted(patch, 0.001))
    assert error.std() < 0.0002  # 50 places under the weight, rulings aside: 1 mm / sqrt(50)


def test_averaging_along_rulings_beats_the_round_window():
    patch = synthetic.curtain(0.020)
    plain = depth_error(patch, fitted(patch, 0.001, along_rulings=False)).std()
    assert depth_error(patch, fitted(patch, 0.001)).std() < 0.7 * plain


@pytest.mark.parametrize("correlation", [0.0, 1.5])
def test_the_standard_deviation_is_that_of_the_errors(correlation):
    patch = synthetic.curtain(0.020)
    surface = fitted(patch, 0.001, correlation)
    ratio = np.std(depth_error(patch, surface) / surface.sigma_m)
    assert 0.5 < ratio < 2.0


def test_steep_places_are_as_good_as_flat_ones():
    patch = synthetic.half_cylinder(part=0.98)
    surface = fitted(patch, 0.001)
    slope = np.abs(patch.flat[:, 0]) / 0.1  # radians
    along_normal = depth_error(patch, surface) * np.cos(slope)
    steep = np.sin(slope) > 0.9
    assert along_normal[steep].std() < 0.0003
    normal_z = np.cos(slope)
    assert surface.normals[:, 2] == pytest.approx(normal_z, abs=0.1)


@pytest.mark.parametrize(
    "patch",
    [synthetic.curtain(0.02), synthetic.half_cylinder(radius_m=0.15, turn_deg=60.0, part=0.9)],
    ids=lambda patch: patch.name,
)
def test_the_outermost_places_are_much_better_than_measured(patch):
    border = patch.mask & ~binary_erosion(patch.mask)
    error = [depth_error(patch, fitted(patch, 0.002, seed=seed)) for seed in (1, 2)]
    error = np.concatenate([e[border[patch.mask]] for e in error])
    # one-sided quadratics leave 0.8 mm of 2 mm, and steep ones lean over by as much
    assert np.sqrt((error**2).mean()) < 0.0005
    assert abs(np.median(error)) < 0.0002


def test_folds_keep_their_height():
    patch = synthetic.curtain(0.02)
    inside = binary_erosion(patch.mask, iterations=9)[patch.mask]
    # a Gaussian quadratic alone takes 36 um from their tops
    assert np.abs(depth_error(patch, fitted(patch))[inside]).max() < 1.5e-5


def test_depths_do_not_mix_across_a_jump():
    patch, on_flap = synthetic.flap()
    surface = fitted(patch, 0.001)
    assert np.abs(depth_error(patch, surface)).max() < 0.0015  # 30 mm of jump, 1 mm of noise
    assert len(np.unique(surface.layer[on_flap])) == 1
    assert not np.isin(surface.layer[~on_flap], surface.layer[on_flap]).any()


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -0.2)])
def test_the_camera_is_found_from_pixels_and_noisy_points(shift):
    focal, shape = 520.0, (60, 80)
    row, col = (g.ravel() for g in np.mgrid[0:60, 0:80])
    ray = np.stack(
        [(col - 40) / focal + shift[0], (row - 30) / focal + shift[1], np.ones(len(row))], 1
    )
    random = np.random.default_rng(0)
    depth = (
        1.3
        + 0.05 * np.sin(col / 9)
        + 0.02 * np.cos(row / 7)
        + 0.001 * random.standard_normal(len(row))
    )
    pixel = np.stack([row, col], axis=1).astype(np.int32)
    rays = camera_rays(depth[:, None] * ray, pixel, shape)
    assert rays is not None and not rays.parallel
    assert np.abs(rays.origin).max() < 1e-6
    place, found = rays.to_grid(depth[:, None] * ray)
    assert place == pytest.approx(pixel, abs=1e-5)
    assert rays.to_points(place, found) == pytest.approx(depth[:, None] * ray, abs=1e-9)


def test_normals_point_to_the_viewer():
    patch = synthetic.cone(step_m=0.005)
    assert (fitted(patch, 0.001).normals[:, 2] > 0).all()


@pytest.mark.parametrize(
    "points, message",
    [
        (np.zeros((3, 3)), "at least 6"),
        (np.full((9, 3), np.nan), "not finite"),
        (np.zeros((9, 2)), "shape"),
    ],
)
def test_what_cannot_be_fitted_raises(points, message):
    with pytest.raises(InvalidInput, match=message):
        fit_surface(points, SurfaceConfig(), synthetic.TOWARD)


def test_a_thousand_points_are_enough():
    random = np.random.default_rng(2)
    xy = random.uniform(-0.1, 0.1, (1000, 2))
    points = np.column_stack([xy, 0.1 * xy[:, 0] + 2 * xy[:, 1] ** 2])
    surface = fit_surface(points, SurfaceConfig(), synthetic.TOWARD)
    inner = np.abs(xy).max(axis=1) < 0.08
    assert np.abs(surface.points - points)[inner].max() < 0.001
