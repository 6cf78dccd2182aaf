"""Steps from one layer to another, and folds that are none."""

from __future__ import annotations

import numpy as np
import pytest

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.ramps import ramps

CONFIG = RotationConfig()
NOISE_M = 0.0007


def seen(height, slope, seed=4):
    """Points and samples of z = height(x) over 12 x 10 cm, as a fit of 7 mm leaves them.

    Returns
    -------
    x of the samples, and the arguments of ramps but the last.
    """
    rng = np.random.default_rng(seed)
    flat = rng.uniform(0.0, [0.12, 0.10], (12000, 2))
    z = height(flat[:, 0]) + NOISE_M * rng.normal(size=len(flat))
    points = np.column_stack([flat, z])
    normals = normals_of(slope(flat[:, 0]))
    grid = np.mgrid[0:0.12:0.004, 0:0.10:0.004].reshape(2, -1).T
    grid = grid + rng.uniform(-0.0005, 0.0005, grid.shape)
    xyz = np.column_stack([grid, smoothed(height, grid[:, 0])])
    rise = (smoothed(height, grid[:, 0] + 5e-4) - smoothed(height, grid[:, 0] - 5e-4)) / 1e-3
    return grid[:, 0], xyz, normals_of(rise), points, normals


def normals_of(rise):
    normal = np.column_stack([-rise, np.zeros(len(rise)), np.ones(len(rise))])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def smoothed(height, x):
    """Mean height within 5 mm: what a local fit makes of a step."""
    return np.mean([height(x + dx) for dx in np.linspace(-0.005, 0.005, 41)], axis=0)


def flat_slope(x):
    return np.zeros(len(x))


@pytest.mark.parametrize("step_m", [0.002, 0.003])
def test_the_ramp_that_a_fit_makes_of_a_layers_edge_is_found(step_m):
    x, *surface = seen(lambda x: np.where(x > 0.06, step_m, 0.0), flat_slope)
    doubt = ramps(*surface, CONFIG)
    assert (doubt[np.abs(x - 0.06) < 0.002] > 1.0).mean() > 0.9
    assert (doubt[(np.abs(x - 0.06) > 0.02)] > 1.0).mean() < 0.02


def test_a_fold_is_no_ramp():
    radius = 0.03

    def height(x):
        return np.sqrt(radius**2 - (x - 0.06).clip(-0.02, 0.02) ** 2)

    def slope(x):
        bent = (x - 0.06).clip(-0.02, 0.02)
        return -bent / np.sqrt(radius**2 - bent**2)

    x, *surface = seen(height, slope)
    doubt = ramps(*surface, CONFIG)
    assert (doubt[np.abs(x - 0.06) < 0.015] > 1.0).mean() < 0.05


def test_a_wave_of_the_cloth_is_no_ramp():
    def height(x):
        return 0.005 * np.sin(2 * np.pi * x / 0.08)

    def slope(x):
        return 0.005 * 2 * np.pi / 0.08 * np.cos(2 * np.pi * x / 0.08)

    _, *surface = seen(height, slope)
    assert (ramps(*surface, CONFIG) > 1.0).mean() < 0.05
