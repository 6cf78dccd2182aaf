"""The JSON object: keys, frames, and identity with the messages."""

import dataclasses
import json

import numpy as np
import pytest
from garments import CALIBRATION, example_garment, example_views

from vflatten_ros import messages, results
from vflatten_ros.core.geometry import rotation_about
from vflatten_ros.core.values import Unseen, ViewShare

VIEWS = example_views()
GARMENT = example_garment(VIEWS)
RESULT = results.garment_result(GARMENT, VIEWS)


def test_sizes_category_and_notices():
    assert RESULT["category"] == "towel"
    assert RESULT["scores"]["towel"] == pytest.approx(0.81)
    assert (RESULT["width_m"], RESULT["width_sigma_m"]) == (0.30, 0.003)
    assert (RESULT["length_m"], RESULT["length_sigma_m"]) == (0.50, 0.004)
    assert RESULT["notices"][0]["code"] == "length_unseen"
    assert RESULT["warnings"] == ["the lower left corner is in no view"]
    assert [view["id"] for view in RESULT["views"]] == [2, 5]


def test_what_views_add_and_where_to_turn():
    assert RESULT["unseen"] is None and RESULT["enough"] is False
    assert RESULT["views"][0]["only"] is None
    shares = tuple(ViewShare(i, 0.5, 0.125, 0.25) for i in (2, 5))
    garment = dataclasses.replace(GARMENT, shares=shares, unseen=Unseen(1.5), enough=True)
    result = results.garment_result(garment, VIEWS)
    assert result["unseen"] == {"turn_to_rad": 1.5} and result["enough"] is True
    view = {key: result["views"][1][key] for key in ("id", "shows", "only", "first")}
    assert view == {"id": 5, "shows": 0.5, "only": 0.125, "first": 0.25}
    regrasp = dataclasses.replace(garment, unseen=Unseen(None))
    assert results.garment_result(regrasp, VIEWS)["unseen"] == {"turn_to_rad": None}


def test_every_point_is_a_pixel_of_its_view():
    points = RESULT["points"]
    assert len({len(column) for column in points.values()}) == 1
    pixels = {(v.view_id, *pixel) for v in VIEWS for pixel in v.pixel.tolist()}
    given = list(zip(points["view"], points["row"], points["col"], strict=True))
    assert len(given) == len(GARMENT.points.uv)
    assert set(given) <= pixels


def test_points_without_a_pixel_are_left_out():
    fields = messages.flattened_view_fields(GARMENT, VIEWS)
    fields["view"] = np.where(np.arange(len(fields["u"])) % 2, -1, fields["view"])
    estimate = messages.garment_estimate_fields(GARMENT, VIEWS)
    points = results.result_from_fields(fields, estimate, CALIBRATION)["points"]
    assert len(points["u"]) == (len(fields["u"]) + 1) // 2
    assert min(points["view"]) >= 0


def test_landmarks_hang_in_the_rig_frame_with_the_item_turned_back_to_zero():
    """As the recordings' truth has it: p0 + R(axis, -angle) (p - p0) of the measured point."""
    mark = next(m for m in RESULT["landmarks"] if m["name"] == "right_top_corner")
    view = VIEWS[0]
    gap = np.linalg.norm(view.points_hanger - GARMENT.landmarks[1].xyz_hanger, axis=1)
    measured = view.points_rig[gap.argmin()]
    origin, axis = np.array(CALIBRATION.axis_point), np.array(CALIBRATION.axis_direction)
    back = origin + rotation_about(axis, -view.angle_rad) @ (measured - origin)
    assert mark["xyz"] == pytest.approx(back.tolist(), abs=0.002)  # one sample of the surface
    assert mark["view"] == 2


def test_an_unseen_landmark_hangs_somewhere_near_the_cloth_beside_it():
    mark = RESULT["landmarks"][2]
    assert mark["name"] == "left_bottom_corner"
    assert not mark["seen"] and RESULT["landmarks"][0]["seen"]
    assert len(mark["xyz"]) == 3 and mark["xyz_sigma_m"] == pytest.approx(0.102)
    assert mark["view"] is None
    assert mark["uv"] == [-0.15, -0.5]


def test_a_landmark_hangs_nowhere_where_nothing_was_seen():
    bare = dataclasses.replace(GARMENT.landmarks[2], xyz_hanger=None, xyz_sigma_m=float("nan"))
    garment = dataclasses.replace(GARMENT, landmarks=(bare,))
    mark = results.garment_result(garment, VIEWS)["landmarks"][0]
    assert mark["xyz"] is None and mark["xyz_sigma_m"] is None and not mark["seen"]


def test_landmarks_hang_about_the_axis_that_the_views_told():
    """Not about that of the calibration which the views came with."""
    shifted = tuple(x + 0.03 for x in CALIBRATION.axis_point)
    tip = tuple(x + 0.03 for x in CALIBRATION.gripper_tip)
    told = dataclasses.replace(CALIBRATION, axis_point=shifted, gripper_tip=tip)
    garment = dataclasses.replace(GARMENT, calibration=told)
    pairs = zip(results.garment_result(garment, VIEWS)["landmarks"], GARMENT.landmarks, strict=True)
    T = told.T_rig_hanger(0.0)
    for found, mark in pairs:
        there = T[:3, :3] @ np.array(mark.xyz_hanger) + T[:3, 3]
        assert found["xyz"] == pytest.approx(there.tolist())


def test_numbers_equal_the_message_fields_exactly():
    fields = messages.flattened_view_fields(GARMENT, VIEWS)
    read_back = json.loads(results.json_text(RESULT))
    assert read_back["points"]["u"] == [float(v) for v in fields["u"]]
    assert [p[1] for p in read_back["contour_uv"]] == [float(v) for v in fields["contour_v"]]


def test_what_was_not_measured_is_null():
    estimate = {**messages.garment_estimate_fields(GARMENT, VIEWS), "measurements": []}
    fields = messages.flattened_view_fields(GARMENT, VIEWS)
    result = results.result_from_fields(fields, estimate, CALIBRATION)
    assert result["width_m"] is None
    assert result["length_sigma_m"] is None


def test_the_text_is_valid_json_without_nan(tmp_path):
    path = tmp_path / "result.json"
    results.write_json(path, {**RESULT, "odd": [float("nan"), {"x": float("inf")}]})
    read_back = json.loads(path.read_text())
    assert read_back["odd"] == [None, {"x": None}]
    assert read_back["category"] == "towel"
    assert list(tmp_path.iterdir()) == [path]


def test_the_same_garment_gives_the_same_bytes():
    again = results.garment_result(example_garment(), example_views())
    assert results.json_text(again) == results.json_text(RESULT)
