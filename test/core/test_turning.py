"""Views of a known body that turns about a known axis, whatever the calibration says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from column import CALIBRATION, body, views_of
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.errors import InvalidCalibration, NotEnoughViews
from vflatten_ros.core.fused import fuse_views
from vflatten_ros.core.geometry import rotation_about, transform_points
from vflatten_ros.core.motions import effect, stepped
from vflatten_ros.core.registration import agreement, register_views, view_surface
from vflatten_ros.core.turning import apart, corrected, refine_axis, to_hanger
from vflatten_ros.core.values import Calibration

CONFIG = RotationConfig()
STILL = [(np.zeros(3), 0.0)] * 16


def off_by(shift_m: float, lean_deg: float, way: float = 0.7) -> Calibration:
    """The calibration with its axis shifted sideways, and leaning about that side."""
    side = np.array([np.cos(way), 0.0, np.sin(way)])
    turn = rotation_about(side, np.radians(lean_deg))
    place = tuple((np.array(CALIBRATION.axis_point) + shift_m * side).tolist())
    lean = tuple((turn @ np.array(CALIBRATION.axis_direction)).tolist())
    return replace(CALIBRATION, axis_point=place, gripper_tip=place, axis_direction=lean)


def told(fused) -> list[str]:
    """What is said of it, but that the points of the body are 4 mm apart."""
    return [notice.code for notice in fused.notices if notice.code != "coarse_points"]


@pytest.mark.parametrize(("shift_m", "lean_deg"), [(0.0, 0.0), (0.012, 2.0), (0.1, 10.0)])
def test_the_axis_is_found_by_what_turned_about_it(shift_m, lean_deg):
    rough = off_by(shift_m, lean_deg)
    np.testing.assert_allclose(
        apart(CALIBRATION, rough), [shift_m, np.radians(lean_deg)], atol=1e-9
    )
    views = views_of(STILL, noise_m=0.0005, assumed=rough)
    found = refine_axis(views, CONFIG)
    moved_m, leaned_rad = apart(CALIBRATION, found.calibration)
    assert moved_m < 0.0003
    assert leaned_rad < np.radians(0.06)
    assert found.calibration.joint_sign == 1
    tip = np.subtract(found.calibration.gripper_tip, CALIBRATION.gripper_tip)
    assert np.linalg.norm(np.cross(tip, CALIBRATION.axis_direction)) < 0.0003
    assert abs(found.moved_m - shift_m) < 0.0005
    assert abs(found.leaned_rad - np.radians(lean_deg)) < np.radians(0.1)
    assert found.agreement.enough


def test_sway_makes_the_axis_less_certain_but_does_not_pull_it():
    rng = np.random.default_rng(3)
    motions = [(rng.normal(0, 0.002, 3), np.radians(rng.normal(0, 0.3))) for _ in range(16)]
    views = views_of(motions, noise_m=0.0005, assumed=off_by(0.02, 3.0))
    moved_m, leaned_rad = apart(CALIBRATION, refine_axis(views, CONFIG).calibration)
    assert moved_m < 0.002
    assert leaned_rad < np.radians(0.3)


def test_a_joint_of_the_wrong_sign_is_told_and_corrected():
    wrong = replace(CALIBRATION, joint_sign=-1.0)
    views = [replace(v, calibration=wrong, angle_rad=-v.angle_rad) for v in views_of(STILL)]
    with pytest.raises(InvalidCalibration, match=r"other way.*set joint_sign to 1 "):
        fuse_views(views, CONFIG)
    found = refine_axis(views, CONFIG)
    assert found.calibration.joint_sign == 1
    assert apart(CALIBRATION, found.calibration)[0] < 0.0003


def test_an_item_that_does_not_turn_with_the_joint_is_told():
    first = views_of(STILL)[0]
    rng = np.random.default_rng(1)
    views = [
        replace(
            first,
            view_id=k,
            angle_rad=k * 2 * np.pi / 16,
            points_rig=first.points_rig + rng.normal(0, 0.0005, first.points_rig.shape),
        )
        for k in range(16)
    ]
    for attempt in (fuse_views, refine_axis):
        with pytest.raises(InvalidCalibration, match="'wrist' turns and the item does not"):
            attempt(views, CONFIG)


def test_too_few_views_tell_nothing():
    views = views_of([(np.zeros(3), 0.0)] * 5)  # 72 degrees apart
    assert told(fuse_views(views, CONFIG)) == []
    with pytest.raises(NotEnoughViews, match="every 30 degrees"):
        refine_axis(views, CONFIG)


@pytest.mark.parametrize(("shift_m", "lean_deg", "notices"), [(0.004, 0.5, 0), (0.025, 4.0, 1)])
def test_a_result_is_about_the_axis_that_the_views_show(shift_m, lean_deg, notices):
    rough = off_by(shift_m, lean_deg)
    fused = fuse_views(views_of(STILL, noise_m=0.0005, assumed=rough), CONFIG)
    assert told(fused) == ["axis_off"] * notices
    shown = fused.calibration
    off = []
    for angle in (0.0, 2.0):
        true = transform_points(CALIBRATION.T_rig_hanger(angle), body()[0])
        where = transform_points(shown.T_rig_hanger(angle), fused.samples.xyz)
        off.append(cKDTree(true).query(where)[0])
    assert np.median(off) < 0.002  # points of the body are 4 mm apart
    assert apart(CALIBRATION, shown)[0] < 0.001


def test_points_stay_where_the_rig_saw_them_whatever_the_axis():
    rough = off_by(0.05, 4.0, way=0.0)  # sideways: the hanger frame turns towards the rig
    views = views_of(STILL, assumed=rough)
    fused = fuse_views(views, CONFIG)
    kept = [view_surface(view, CONFIG).index for view in views]
    for k, view in enumerate(views):
        xyz = fused.points.xyz[fused.points.view == k]
        there = transform_points(fused.calibration.T_rig_hanger(view.angle_rad), xyz)
        assert np.linalg.norm(there - view.points_rig[kept[k]], axis=1).mean() < 0.0008


def test_two_pairs_of_views_move_no_axis():
    rough = off_by(0.01, 2.0)
    views = views_of(STILL[:9], assumed=rough)[:3]
    assert fuse_views(views, CONFIG).calibration == rough


def test_a_calibration_as_good_as_the_views_stays():
    near = off_by(0.001, 0.1)
    assert fuse_views(views_of(STILL, noise_m=0.0005, assumed=near), CONFIG).calibration == near


def test_the_correction_is_of_the_same_places():
    """What a pose takes to the common frame is at the same place of the rig, by either axis."""
    error = np.array([0.04, -0.06, 0.03, 0.02])
    true, xyz = corrected(CALIBRATION, error), body()[0][::100]
    for angle in (0.0, 1.0, 4.0):
        pose = stepped(np.eye(4), effect(angle) @ error)
        T_rig_true = true.T_rig_hanger(angle) @ to_hanger(CALIBRATION, error) @ pose
        by_given = transform_points(CALIBRATION.T_rig_hanger(angle), xyz)
        np.testing.assert_allclose(transform_points(T_rig_true, xyz), by_given, atol=1e-12)


def test_agreement_is_of_cloth_that_both_show():
    views = views_of(STILL, noise_m=0.0005)
    surfaces = [view_surface(view, CONFIG) for view in views]
    poses = register_views(surfaces, CONFIG)
    right = agreement(surfaces, poses, CONFIG)
    assert right.enough
    assert right.share > 0.75
    shifted = [pose.copy() for pose in poses]
    for k, pose in enumerate(shifted):
        pose[2, 3] += 0.02 * (k % 2)
    assert agreement(surfaces, shifted, CONFIG).share < right.least < right.share
