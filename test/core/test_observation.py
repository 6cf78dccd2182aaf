"""Where cloth ends, and where only what is seen of it ends."""

from __future__ import annotations

import numpy as np
import pytest

from vflatten_ros.core.observation import turns_away

PIXEL_M, WITHIN_M, ROWS = 0.0025, 0.012, 30


def ends_turning(x_m, facing, noise=0.01) -> tuple[float, float]:
    """Share of the left and of the right end of a strip of cloth that is taken for a silhouette."""
    cols = len(x_m)
    row, col = (v.ravel() for v in np.mgrid[0:ROWS, 0:cols])
    seen = np.tile(np.broadcast_to(facing, cols), ROWS)
    seen = seen + np.random.default_rng(1).normal(0.0, noise, len(seen))
    ends = np.flatnonzero((col == 0) | (col == cols - 1))
    place = np.column_stack([row, col])
    turning = turns_away(place, seen, np.zeros(len(place), int), ends, WITHIN_M / PIXEL_M)
    right = col[ends] > 0
    return float(turning[~right].mean()), float(turning[right].mean())


@pytest.mark.parametrize("radius_m", [0.02, 0.04, 0.08])
def test_a_round_fold_ends_in_a_silhouette(radius_m):
    x = np.arange(0.0, 0.98 * radius_m, PIXEL_M)  # beyond, a camera measures nothing
    hem, fold = ends_turning(x, np.sqrt(1.0 - (x / radius_m) ** 2))
    assert hem < 0.05
    assert fold > 0.95


@pytest.mark.parametrize("facing", [1.0, 0.7, 0.35])
def test_a_flat_sheet_ends_at_any_angle(facing):
    assert ends_turning(np.arange(0.0, 0.1, PIXEL_M), facing) == (0.0, 0.0)


def test_a_hem_on_the_flank_of_a_fold_is_an_end():
    x = np.arange(-0.02, 0.02, PIXEL_M)
    assert max(ends_turning(x, np.sqrt(1.0 - (x / 0.04) ** 2))) < 0.05
