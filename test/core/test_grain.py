"""Noise and pitch of known points, and what is widened for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.grain import (
    Grain,
    borne_out,
    grain_of,
    notices_of,
    suited,
    too_noisy,
    typical,
)


def curved(pitch_m, noise_m, radius_m=0.05):
    """Half a cylinder, seen from above on an even grid."""
    x, y = np.mgrid[-0.04:0.04:pitch_m, 0:0.3:pitch_m]
    z = np.sqrt(radius_m**2 - x**2)
    points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    points[:, 2] += np.random.default_rng(5).normal(0.0, noise_m, len(points))
    return points


@pytest.mark.parametrize(("pitch_m", "noise_m"), [(0.002, 0.0005), (0.002, 0.001), (0.004, 0.002)])
def test_noise_and_pitch_are_measured(pitch_m, noise_m):
    found = grain_of(curved(pitch_m, noise_m))
    # the surface is tilted against the noise: a little less, and points a little farther apart
    assert 0.7 * noise_m < found.noise_m < 1.15 * noise_m
    assert pitch_m <= found.pitch_m < 1.5 * pitch_m


def test_the_noise_does_not_depend_on_where_the_points_are():
    points = curved(0.003, 0.001)
    moved = points + np.array([5.0, -2.0, 1.0])
    assert grain_of(moved).noise_m == pytest.approx(grain_of(points).noise_m, rel=1e-6)


def test_nothing_is_changed_for_points_as_good_as_the_config_is_for():
    config = RotationConfig()
    assert suited(config, Grain(0.7 * config.noise_m, config.pitch_m)) == config
    assert suited(config, Grain(0.0, 0.001)) == config


def test_noisier_points_widen_fits_and_steps_and_coarser_ones_spacing_and_rims():
    config = RotationConfig()
    noisy = suited(config, Grain(0.002, config.pitch_m))
    assert noisy.noise_m > 2 * config.noise_m
    assert noisy.fit_m > config.fit_m and noisy.view_fit_m > config.view_fit_m
    assert noisy.step_m > config.step_m
    assert (noisy.spacing_m, noisy.rim_m) == (config.spacing_m, config.rim_m)
    coarse = suited(config, Grain(0.0005, 2 * config.pitch_m))
    assert coarse.spacing_m > config.spacing_m
    assert coarse.link_m / coarse.spacing_m == pytest.approx(config.link_m / config.spacing_m)
    assert coarse.rim_m == pytest.approx(2 * config.rim_m)
    assert (coarse.noise_m, coarse.step_m) == (config.noise_m, config.step_m)


def test_nothing_is_widened_without_end_nor_against_the_setting():
    config = RotationConfig()
    assert suited(config, Grain(1.0, 1.0)) == suited(config, Grain(0.1, 0.1))
    widest = RotationConfig(noise_m=0.02, fit_m=0.05, rim_m=0.05)
    wider = suited(widest, Grain(0.03, 0.01))
    assert (wider.noise_m, wider.fit_m, wider.rim_m) == (0.02, 0.05, 0.05)  # the ranges' ends
    assert wider.spacing_m > widest.spacing_m
    never = RotationConfig(widen=False)
    assert suited(never, Grain(0.01, 0.01)) == never


def test_noise_that_a_view_hides_counts_once_other_views_tell_of_it():
    grain = Grain(0.0006, 0.0025)
    # neighbours that have little of their noise in common: surfaces about as far apart
    assert borne_out(grain, 0.0006) == borne_out(grain, 0.0) == grain
    # all of 3 mm in common: two such surfaces are sqrt(2) times as far apart
    told = borne_out(grain, 0.003 * np.sqrt(2))
    assert told.pitch_m == grain.pitch_m
    assert told.noise_m == pytest.approx(np.hypot(0.0006, 0.003) / np.sqrt(1.5))
    assert suited(RotationConfig(), told).view_fit_m > 1.5 * RotationConfig().view_fit_m


def test_the_typical_view_is_the_median():
    views = [Grain(0.001, 0.002), Grain(0.002, 0.003), Grain(0.009, 0.004)]
    assert typical(views) == Grain(0.002, 0.003)


def test_coarse_points_are_told_with_how_coarse_they_are():
    config = RotationConfig()
    assert notices_of(config, Grain(0.8 * config.noise_m, 1.1 * config.pitch_m), 0.0) == ()
    for grain in (Grain(0.002, 0.002), Grain(0.0005, 0.004)):
        (notice,) = notices_of(config, grain, grain.noise_m)
        assert notice.code == "coarse_points"
        assert f"by {1e3 * grain.noise_m:.1f} mm" in notice.text
        assert f"are {1e3 * grain.pitch_m:.1f} mm apart" in notice.text


def test_beyond_three_times_the_noise_nothing_is_trusted():
    config = RotationConfig()
    assert too_noisy(config, Grain(0.0022, 0.004)) == ""
    assert "scatter by 2.3 mm, 3.1 times as much" in too_noisy(config, Grain(0.0023, 0.002))
    assert too_noisy(replace(config, noise_m=0.002), Grain(0.0023, 0.002)) == ""


def test_smoothed_depth_is_told_by_views_that_differ_more_than_their_points_scatter():
    config, grain = RotationConfig(), Grain(0.0003, 0.0025)
    assert notices_of(config, grain, 0.0005) == ()
    (notice,) = notices_of(config, grain, 0.0008)
    assert notice.code == "smoothed_depth" and "differ by 0.8 mm" in notice.text
    both = notices_of(config, replace(grain, pitch_m=0.005), 0.0008)  # and far apart
    assert [notice.code for notice in both] == ["smoothed_depth", "coarse_points"]
