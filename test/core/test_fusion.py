"""Samples of surfaces that are known, seen with noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.errors import DisconnectedSurface, NotEnoughViews
from vflatten_ros.core.fusion import Points, fuse

CONFIG = RotationConfig()
UP = np.array([0.0, 0.0, 1.0])


def cloud(height_m, noise_m=0.001, views=6, seed=0):
    """Noisy points of a level patch 0.1 m wide, 2.5 mm apart in each view."""
    rng = np.random.default_rng(seed)
    points, view = [], []
    for k in range(views):
        grid = np.mgrid[0:0.1:0.0025, 0:0.1:0.0025].reshape(2, -1).T + rng.uniform(0, 0.0025, 2)
        points.append(np.column_stack([grid, height_m + rng.normal(0, noise_m, len(grid))]))
        view += [k] * len(grid)
    return np.vstack(points), np.array(view)


def inner(xyz):
    return (np.abs(xyz[:, :2] - 0.05) < 0.035).all(1)


def test_noise_is_averaged_out_and_stated():
    points, view = cloud(0.0)
    found = fuse(Points(points, np.tile(UP, (len(points), 1)), view), CONFIG)
    height = found.xyz[inner(found.xyz), 2]
    assert height.std() < 0.0003
    assert 0.5 < height.std() / found.sigma_m[inner(found.xyz)].mean() < 2.0
    assert np.quantile(found.normal[inner(found.xyz), 2], 0.01) > 0.98
    assert found.views[inner(found.xyz)].mean() > 0.8


def test_samples_are_about_as_far_apart_as_asked():
    points, view = cloud(0.0)
    found = fuse(Points(points, np.tile(UP, (len(points), 1)), view), CONFIG)
    per_area = inner(found.xyz).sum() / 0.07**2
    assert 0.7 < per_area * CONFIG.spacing_m**2 < 1.4


def test_two_faces_3_mm_apart_stay_apart():
    front, view = cloud(0.0)
    back, _ = cloud(-0.003, seed=1)
    normals = np.vstack([np.tile(UP, (len(front), 1)), np.tile(-UP, (len(back), 1))])
    found = fuse(Points(np.vstack([front, back]), normals, np.r_[view, view]), CONFIG)
    up = found.normal[:, 2] > 0
    middle = inner(found.xyz)
    assert abs(np.median(found.xyz[middle & up, 2])) < 0.0002
    assert abs(np.median(found.xyz[middle & ~up, 2]) + 0.003) < 0.0002


def test_the_step_between_layers_that_face_alike_stays_a_step():
    low, view = cloud(0.0)
    high, _ = cloud(0.003, seed=1)
    points = np.vstack([low[low[:, 0] < 0.05], high[high[:, 0] >= 0.05]])
    views = np.r_[view[low[:, 0] < 0.05], view[high[:, 0] >= 0.05]]
    found = fuse(Points(points, np.tile(UP, (len(points), 1)), views), CONFIG)
    between = inner(found.xyz) & (found.xyz[:, 2] > 0.001) & (found.xyz[:, 2] < 0.002)
    assert between.sum() < 0.03 * inner(found.xyz).sum()


def test_sources_are_measured_points_beside_their_samples():
    points, view = cloud(0.0)
    found = fuse(Points(points, np.tile(UP, (len(points), 1)), view), CONFIG)
    assert np.linalg.norm(points[found.source] - found.xyz, axis=1).max() < 0.006


def test_another_draw_has_other_samples_of_the_same_surface():
    points, view = cloud(0.0)
    all_points = Points(points, np.tile(UP, (len(points), 1)), view)
    one, other = (fuse(all_points, CONFIG, draw=draw) for draw in (0, 1))
    set_so = fuse(all_points, replace(CONFIG, draw=1))
    np.testing.assert_array_equal(set_so.xyz, other.xyz)
    assert abs(len(one.xyz) / len(other.xyz) - 1.0) < 0.1
    away = cKDTree(one.xyz).query(other.xyz[inner(other.xyz)])[0]
    assert np.median(away) > 0.1 * CONFIG.spacing_m
    assert other.xyz[inner(other.xyz), 2].std() < 0.0003


@pytest.mark.parametrize(("apart", "error"), [(8, DisconnectedSurface), (10**9, NotEnoughViews)])
def test_points_too_far_apart_are_refused_in_words(apart, error):
    xyz, view = cloud(0.0, views=1)
    some = np.arange(len(xyz))[::apart] if apart < len(xyz) else np.zeros(0, dtype=int)
    normal = np.tile(UP, (len(some), 1))
    with pytest.raises(error, match="fusion"):
        fuse(Points(4 * xyz[some], normal, view[some]), CONFIG)
