"""Views of a known body that sways and lags: the corrections must undo it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from column import CALIBRATION, UP, body, views_of

from vflatten_ros.core import registration
from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.errors import NotEnoughViews
from vflatten_ros.core.geometry import inverse, rotation_about, transform_points
from vflatten_ros.core.grain import typical
from vflatten_ros.core.motions import axis_error, effect, stepped
from vflatten_ros.core.registration import (
    disagreement_m,
    fold_in,
    register_views,
    turned,
    view_surface,
)
from vflatten_ros.core.values import Calibration, View


def places(poses, motions):
    """Where each view puts every point of the body, (views, n, 3), centred over the views."""
    xyz = body()[0][::50]
    at = [
        transform_points(pose, xyz @ rotation_about(UP, lag).T + shift)
        for pose, (shift, lag) in zip(poses, motions, strict=True)
    ]
    return np.array(at) - np.mean(at, axis=0)


def test_sway_and_lag_are_undone():
    rng = np.random.default_rng(3)
    motions = [(rng.normal(0, 0.002, 3), np.radians(rng.normal(0, 0.3))) for _ in range(16)]
    views = views_of(motions, noise_m=0.0005)
    config = RotationConfig()
    surfaces = [view_surface(v, config) for v in views]
    before = places([np.eye(4)] * 16, motions)
    after = places(register_views(surfaces, config), motions)
    rms = [float(np.sqrt((p**2).sum(2).mean())) for p in (before, after)]
    assert rms[0] > 0.003
    assert rms[1] < 0.0006  # a fifth of the sway; the noise is half a millimetre


def test_views_folded_in_as_they_come_give_the_same(monkeypatch):
    """However far they were folded in before, also if a view went meanwhile."""
    rng = np.random.default_rng(3)
    motions = [(rng.normal(0, 0.002, 3), np.radians(rng.normal(0, 0.3))) for _ in range(8)]
    config = RotationConfig()
    surfaces = [view_surface(v, config) for v in views_of(motions, noise_m=0.0005)]
    at_once = register_views(surfaces, config)
    half = fold_in(surfaces[:4], config)
    other = fold_in([surfaces[0], surfaces[2], *surfaces[3:]], config, half)
    coarse = fold_in(surfaces, replace(config, register_points=300), half)
    for so_far in (half, fold_in(surfaces[4:], config, half), other, coarse):
        np.testing.assert_array_equal(register_views(surfaces, config, so_far=so_far), at_once)
    everything = fold_in(surfaces, config, half)
    monkeypatch.delattr(registration, "_placed_by")  # nothing is left to be placed
    np.testing.assert_array_equal(register_views(surfaces, config, so_far=everything), at_once)


def test_each_view_is_placed_by_those_before_it():
    """Most of the sway is undone before the last one comes."""
    rng = np.random.default_rng(3)
    motions = [(rng.normal(0, 0.002, 3), np.radians(rng.normal(0, 0.3))) for _ in range(16)]
    config = RotationConfig()
    surfaces = [view_surface(v, config) for v in views_of(motions, noise_m=0.0005)]
    folded = fold_in(surfaces, config)
    before, after = places([np.eye(4)] * 16, motions), places(folded.poses, motions)
    assert np.linalg.norm(np.diff(before, axis=0), axis=2).mean() > 0.003
    assert np.linalg.norm(np.diff(after, axis=0), axis=2).mean() < 0.001


def test_views_tell_where_the_axis_is_to_those_that_follow():
    config = RotationConfig()
    surfaces = [view_surface(v, config) for v in views_of([(np.zeros(3), 0.0)] * 8)]
    error = np.array([0.004, -0.006, 0.003, 0.002])  # lean in rad, place in m
    angles = [surface.angle_rad for surface in surfaces]
    poses = [stepped(np.eye(4), effect(angle) @ error) for angle in angles]
    told = axis_error(angles, poses, config)
    np.testing.assert_allclose(told, error, rtol=0.15)
    assert not axis_error([], [], config).any()


def test_a_shifted_axis_is_found_from_all_views():
    true = Calibration(
        "rig", (0.003, -0.4, 1.302), (0.0, -1.0, 0.0), (0.003, -0.4, 1.302), "wrist", 1.0, 0.0
    )
    motions = [(np.zeros(3), 0.0)] * 16
    views = views_of(motions, calibration=true)
    surfaces = [view_surface(v, RotationConfig()) for v in views]
    poses = register_views(surfaces, RotationConfig())
    xyz = body()[0][::50]
    raw, fixed = [], []
    for view, pose in zip(views, poses, strict=True):
        T = inverse(CALIBRATION.T_rig_hanger(view.angle_rad)) @ true.T_rig_hanger(view.angle_rad)
        raw.append(transform_points(T, xyz))
        fixed.append(transform_points(pose, raw[-1]))
    assert np.linalg.norm(raw - np.mean(raw, axis=0), axis=2).mean() > 0.003
    assert np.linalg.norm(fixed - np.mean(fixed, axis=0), axis=2).mean() < 0.0006


def test_views_tell_of_noise_that_neighbouring_points_have_in_common():
    still, config = [(np.zeros(3), 0.0)] * 16, RotationConfig()
    apart, alone = {}, {}
    for shared_m in (0.0, 0.001, 0.003):
        views = views_of(still, noise_m=0.0005, shared_m=shared_m)
        surfaces = [view_surface(v, config) for v in views]
        alone[shared_m] = typical([s.grain for s in surfaces]).noise_m
        poses = register_views(surfaces, config)
        apart[shared_m] = disagreement_m(surfaces, poses, config)
    assert apart[0.0] < 0.0005
    for shared_m in (0.001, 0.003):  # of both views; the surfaces are seen at an angle
        assert 0.6 * shared_m < apart[shared_m] / np.sqrt(2) < shared_m
    assert alone[0.003] < 1.5 * alone[0.0]  # no view shows it by itself
    two_sides = [surfaces[0], surfaces[8]]
    assert disagreement_m(two_sides, [np.eye(4)] * 2, config) == 0.0  # nothing seen by both


def test_normals_point_to_the_camera():
    view = views_of([(np.zeros(3), 0.0)])[0]
    surface = view_surface(view, RotationConfig())
    assert (((surface.camera - surface.points) * surface.normals).sum(1) > 0).all()


def test_one_view_and_an_empty_one_raise():
    views = views_of([(np.zeros(3), 0.0)])
    with pytest.raises(NotEnoughViews, match="2 or more"):
        register_views([view_surface(views[0], RotationConfig())], RotationConfig())
    none = View(0, 0, 0.0, np.zeros((0, 3)), np.zeros((0, 2), np.int32), None, (4, 4), CALIBRATION)
    with pytest.raises(NotEnoughViews, match="0 points"):
        view_surface(none, RotationConfig())


def test_pairs_grow_with_the_views_not_with_their_square():
    def pairs(count):
        return registration._overlapping(np.linspace(0, 2 * np.pi, count, endpoint=False), 50.0)

    assert len(pairs(12)) == 12 * 2  # 30 degrees apart: one on either side
    assert len(pairs(100)) == 100 * 2 * registration.MOST_PARTNERS
    first = {j for i, j in pairs(100) if i == 0}
    assert {1, 99, 13, 87} <= first  # the nearest and, 47 degrees away, the farthest


def test_a_surface_at_another_angle_about_another_axis_is_what_its_view_would_give():
    view = views_of([(np.zeros(3), 0.0)], noise_m=0.0005)[0]
    other = replace(
        CALIBRATION,
        axis_point=tuple(np.add(CALIBRATION.axis_point, [0.02, 0.0, 0.03])),
        axis_direction=(0.0, -np.cos(0.1), np.sin(0.1)),
        joint_sign=-CALIBRATION.joint_sign,
    )
    angle = view.angle_rad - 0.7
    expected = view_surface(replace(view, calibration=other, angle_rad=angle), RotationConfig())
    T_rig_old = CALIBRATION.T_rig_hanger(view.angle_rad)
    T_new_old = inverse(other.T_rig_hanger(angle)) @ T_rig_old
    surface = view_surface(view, RotationConfig())
    found = turned(surface, T_new_old, angle)
    assert np.abs(surface.points - expected.points).max() > 0.05
    for name in ("points", "smooth", "normals", "camera", "index", "angle_rad"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9)
    np.testing.assert_array_equal(found.tree.data, found.smooth)
    assert found.sight is None
