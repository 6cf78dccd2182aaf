"""Patches laid flat beside their exact shape."""

from __future__ import annotations

import numpy as np
import pytest
import synthetic

from vflatten_ros.core.config import SurfaceConfig
from vflatten_ros.core.patch_flattening import flatten_patch
from vflatten_ros.core.surface import fit_surface


def rms_percent(patch, noise_m, seed=1, config=SurfaceConfig()) -> float:
    """RMS distance from the exact shape after rigid alignment, of the diameter."""
    points = patch.points(noise_m, seed=seed)
    surface = fit_surface(points, config, synthetic.TOWARD, patch.pixel, patch.mask.shape)
    place = np.round(surface.rays.to_grid(points)[0]).astype(int)
    found = flatten_patch(surface).uv[place[:, 0], place[:, 1]]
    a, b = found - found.mean(axis=0), patch.flat - patch.flat.mean(axis=0)
    left, _, right = np.linalg.svd(a.T @ b)
    diameter = np.linalg.norm(np.ptp(patch.flat, axis=0))
    return float(100 * np.sqrt(((a @ left @ right - b) ** 2).sum(axis=1).mean()) / diameter)


# 1 mm of noise leaves 0.1 mm in the depth of a place, and a diameter is 0.6 m or more
@pytest.mark.parametrize(
    "patch",
    [
        synthetic.plane(),
        synthetic.half_cylinder(part=0.97),
        synthetic.cone(),
        synthetic.curtain(0.02),
    ],
    ids=lambda patch: patch.name,
)
def test_developable_patches_unroll_to_their_shape(patch):
    assert rms_percent(patch, 0.001) < 0.05


@pytest.mark.parametrize("hidden", [synthetic.stripe, synthetic.slit])
def test_a_hole_or_a_slit_does_no_harm(hidden):
    assert rms_percent(synthetic.curtain(0.02, hidden=hidden), 0.001) < 0.05


def test_folds_oblique_to_the_grid_keep_their_arcs():
    # the fit is exact to 2 um here; chords, or arcs along the grid alone, are off by 50 um
    config = SurfaceConfig(radius_m=0.005, along_rulings=False)
    assert rms_percent(synthetic.curtain(0.02), 0.0, config=config) < 0.002


def test_the_halves_beside_a_missing_stripe_do_not_bend_against_one_another():
    whole, cut = (
        rms_percent(synthetic.curtain(0.02, hidden=hidden), 0.001)
        for hidden in (None, synthetic.stripe)
    )
    assert cut < 1.3 * whole


def test_a_flap_is_a_piece_of_its_own():
    patch, on_flap = synthetic.flap()
    points = patch.points(0.001)
    surface = fit_surface(points, SurfaceConfig(), synthetic.TOWARD, patch.pixel, patch.mask.shape)
    place = np.round(surface.rays.to_grid(points)[0]).astype(int)
    piece = flatten_patch(surface).piece[place[:, 0], place[:, 1]]
    assert len(np.unique(piece[on_flap])) == 1
    assert len(np.unique(piece[~on_flap])) == 2


def test_a_dome_shows_strain():
    x, y = np.meshgrid(np.arange(-0.08, 0.08, 0.0025), np.arange(-0.08, 0.08, 0.0025))
    points = np.stack([x, y, np.sqrt(0.12**2 - x**2 - y**2)], axis=-1).reshape(-1, 3)
    strained = flatten_patch(fit_surface(points, SurfaceConfig(), synthetic.TOWARD)).strain
    flat = points * [1, 1, 0]
    relaxed = flatten_patch(fit_surface(flat, SurfaceConfig(), synthetic.TOWARD)).strain
    assert strained.mean() > 0.01 > 100 * relaxed.mean()
