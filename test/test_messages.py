"""Core values <-> message fields, and message fields <-> message objects."""

import array
import json
import re
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from garments import example_garment, example_views

from vflatten_ros import displays, messages
from vflatten_ros.core.buffer import BufferState, Stage
from vflatten_ros.core.errors import InvalidCorrespondence
from vflatten_ros.core.geometry import transform_points
from vflatten_ros.core.values import Unseen, ViewShare

VIEWS = example_views()
GARMENT = example_garment(VIEWS)
BY_ID = {view.view_id: view for view in VIEWS}
MSG = Path(__file__).parent.parent / "msg"


def names_in(message: str) -> list[str]:
    """Field names of one of our messages, in order."""
    lines = (MSG / f"{message}.msg").read_text().splitlines()
    fields = [re.match(r"(\S+)\s+([a-z]\w*)\s*(#.*)?$", line) for line in lines]
    return [field[2] for field in fields if field]


@pytest.mark.parametrize(
    ("message", "fields"),
    [
        ("FlattenedView", messages.flattened_view_fields(GARMENT, VIEWS)),
        ("GarmentEstimate", messages.garment_estimate_fields(GARMENT, VIEWS)),
        ("ViewInfo", messages.view_info_fields(VIEWS[0], True)),
        ("Measurement", messages.measurement_fields(GARMENT.measurements[0])),
        ("Landmark", messages.landmark_fields(GARMENT.landmarks[0])),
        ("Correspondence", messages.correspondence_fields(GARMENT.correspondences[0], 1, BY_ID)),
    ],
)
def test_every_field_of_the_message_is_given(message, fields):
    assert list(fields) == names_in(message)


def test_buffer_state_counts_and_sorts():
    state = BufferState(
        stage=Stage.GATHERING,
        item=3,
        view_ids=(2, 5),
        angle_covered_rad=1.5,
        nbytes=1000,
        clouds_received=9,
        clouds_waiting=1,
        drops={"too_old": 4, "duplicate_angle": 2},
        joint_states=7,
        joints_seen=("wrist_roll",),
        clock_jumps=0,
    )
    fields = messages.view_buffer_state_fields(
        state, VIEWS[::-1], "rig_optical", selected=[5], correspondences=2
    )
    assert list(fields) == names_in("ViewBufferState")
    assert [view["id"] for view in fields["views"]] == [2, 5]
    assert [view["selected"] for view in fields["views"]] == [False, True]
    assert fields["drop_reasons"] == ["duplicate_angle", "too_old"]
    assert fields["drop_counts"].tolist() == [2, 4]
    assert fields["state"] == 1
    assert messages.stamp_ns(fields["header"]["stamp"]) == VIEWS[1].stamp_ns


def test_what_views_add_and_where_to_turn():
    shares = tuple(ViewShare(i, 0.5 + i / 100, 0.125, 0.25) for i in (2, 5))
    garment = replace(GARMENT, shares=shares, unseen=Unseen(1.5), enough=True)
    fields = messages.flattened_view_fields(garment, VIEWS)
    assert fields["view_shows"].tolist() == pytest.approx([0.52, 0.55])
    assert fields["view_only"].tolist() == [0.125, 0.125]
    assert fields["view_first"].tolist() == [0.25, 0.25]
    estimate = messages.garment_estimate_fields(garment, VIEWS)
    assert (estimate["enough"], estimate["unseen"], estimate["turn_to"]) == (True, 1, 1.5)
    regrasp = replace(garment, unseen=Unseen(None))
    estimate = messages.garment_estimate_fields(regrasp, VIEWS)
    assert (estimate["unseen"], estimate["turn_to"]) == (2, 0.0)
    plain = messages.garment_estimate_fields(GARMENT, VIEWS)
    assert (plain["enough"], plain["unseen"], plain["turn_to"]) == (False, 0, 0.0)
    assert not len(messages.flattened_view_fields(GARMENT, VIEWS)["view_shows"])


def test_flattened_view_holds_the_garment_in_float32():
    fields = messages.flattened_view_fields(GARMENT, VIEWS)
    assert fields["header"]["frame_id"] == "rig_optical"
    assert fields["u"].dtype == np.float32
    assert np.array_equal(fields["u"], GARMENT.points.uv[:, 0].astype(np.float32))
    assert fields["row"].tolist() == GARMENT.points.pixel[:, 0].tolist()
    assert np.degrees(fields["view_angles"]) == pytest.approx([-40, 40])
    assert len({len(fields[k]) for k in ("u", "v", "x", "view", "stress", "evidence")}) == 1
    assert fields["stress_rms"] == pytest.approx(0.001)


def test_estimate_ranks_hypotheses_and_puts_width_and_length_first():
    fields = messages.garment_estimate_fields(GARMENT, VIEWS)
    assert [h["category"] for h in fields["hypotheses"]] == ["towel", "trousers", "shorts"]
    assert [m["name"] for m in fields["measurements"]] == ["width", "length"]
    assert [m["evidence"] for m in fields["measurements"]] == [messages.SEEN, messages.INFERRED]
    assert [mark["seen"] for mark in fields["landmarks"]] == [True, True, False]
    assert fields["trusted"]


def test_a_correspondence_survives_the_round_trip():
    pair = GARMENT.correspondences[1]
    fields = messages.correspondence_fields(pair, 7, BY_ID)
    assert messages.correspondence_from_fields(fields, BY_ID) == pair


def test_a_point_becomes_the_nearest_pixel():
    pair = GARMENT.correspondences[1]
    fields = messages.correspondence_fields(pair, 7, BY_ID)
    given = {**fields, "given_a": messages.POINT, "pixel_a": [0, 0]}
    assert messages.correspondence_from_fields(given, BY_ID) == pair


def test_a_pixel_just_off_the_edge_moves_onto_the_item():
    view = VIEWS[0]
    row = int(np.median(view.pixel[:, 0]))
    edge = int(view.pixel[view.pixel[:, 0] == row, 1].min())
    assert messages.pixel_on_item(view, (row, edge - 2)) == (row, edge)
    assert messages.pixel_on_item(view, (row, edge - 9), reach_px=10.0) == (row, edge)
    with pytest.raises(InvalidCorrespondence, match="not on the item"):
        messages.pixel_on_item(view, (row, edge - 9))


@pytest.mark.parametrize("row", [2**32 + 77, 10**12, -(2**40)])
def test_a_pixel_beyond_any_image_does_not_come_round(row):
    pair = replace(GARMENT.correspondences[0], pixel_a=(row, 80))
    with pytest.raises(InvalidCorrespondence, match=str(row)):
        messages.checked_correspondence(pair, BY_ID)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"view_a": 9}, "view 9 is not in the buffer; views held: 2, 5"),
        ({"view_b": 2}, "two different views"),
        ({"pixel_a": [2, 2]}, "not on the item"),
        ({"pixel_b": [480, 10]}, "outside view 5"),
        ({"given_a": 1, "point_a": {"x": 0.0, "y": 0.0, "z": 0.0}}, "nearest point is"),
        ({"given_a": 1, "point_a": {"x": float("nan"), "y": 0.0, "z": 0.0}}, "not finite"),
        ({"given_b": 4}, "given_b"),
        ({"confidence": 1.5}, "confidence"),
    ],
)
def test_a_wrong_correspondence_is_refused_with_its_reason(change, says):
    fields = messages.correspondence_fields(GARMENT.correspondences[0], 1, BY_ID)
    with pytest.raises(InvalidCorrespondence, match=re.escape(says)):
        messages.correspondence_from_fields({**fields, **change}, BY_ID)


def test_cloud_and_markers_cover_the_newest_view():
    newest = VIEWS[1]
    own = GARMENT.points.view_id == newest.view_id
    fields = displays.points_fields(GARMENT, VIEWS)
    rows = np.frombuffer(fields["data"].tobytes(), "<f4").reshape(fields["width"], -1)
    T_rig_hanger = newest.calibration.T_rig_hanger(newest.angle_rad)
    there = transform_points(T_rig_hanger, GARMENT.points.xyz_hanger)
    assert np.abs(rows[own, :3] - there[own]).max() < 1e-6  # float32 at 1.3 m
    live = {tuple(p) for p in newest.pixel.tolist()}
    assert all(tuple(p) in live for p in GARMENT.points.pixel[own].tolist())
    assert [f["name"] for f in fields["fields"]] == ["x", "y", "z", "u", "v", "sigma"]
    assert len(fields["data"]) == fields["row_step"] == fields["width"] * fields["point_step"]


def test_what_hangs_is_shown_about_the_axis_that_the_views_told():
    newest, axis = VIEWS[1], VIEWS[1].calibration
    point, tip = (tuple(x + 0.03 for x in at) for at in (axis.axis_point, axis.gripper_tip))
    told = replace(axis, axis_point=point, gripper_tip=tip)
    fields = displays.points_fields(replace(GARMENT, calibration=told), VIEWS)
    rows = np.frombuffer(fields["data"].tobytes(), "<f4").reshape(fields["width"], -1)
    there = transform_points(told.T_rig_hanger(newest.angle_rad), GARMENT.points.xyz_hanger)
    assert np.abs(rows[:, :3] - there[GARMENT.points.view_id >= 0]).max() < 1e-6


def test_markers_show_every_part():
    markers = displays.marker_fields(GARMENT, VIEWS)["markers"]
    by_name = {marker["ns"]: marker for marker in markers}
    assert markers[0]["action"] == 3  # delete what the last result drew
    assert len(by_name["geodesic_lines"]["points"]) == 8 * 14 * 2
    assert len(by_name["geodesic_lines"]["colors"]) == 8 * 14 * 2
    assert len(by_name["correspondences"]["points"]) == 6
    assert len(by_name["outline"]["points"]) == 2 * len(GARMENT.outline.uv)
    assert len(by_name["sizes"]["points"]) == 4
    assert len(by_name["landmarks"]["points"]) == 2
    # the flat outline stands upright beside the item: metric, not mirrored
    outline = np.array([[p[k] for k in "xyz"] for p in by_name["outline"]["points"]])
    assert np.ptp(outline, axis=0) == pytest.approx([0.30, 0.50, 0.0], abs=1e-9)


def test_both_ends_of_a_pair_are_turned_about_the_axis_that_was_found():
    axis = np.add(GARMENT.calibration.axis_point, [0.03, 0.0, 0.0])
    found = replace(GARMENT.calibration, axis_point=tuple(axis))
    shown = displays.marker_fields(replace(GARMENT, calibration=found), VIEWS)["markers"]
    newest = max(VIEWS, key=lambda view: (view.stamp_ns, view.view_id))
    (spheres,) = (marker for marker in shown if marker["ns"] == "correspondences")
    points = [[p[k] for k in "xyz"] for p in spheres["points"]]
    pair = GARMENT.correspondences[0]
    for place, view_id, pixel in zip(
        points, (pair.view_a, pair.view_b), (pair.pixel_a, pair.pixel_b)
    ):
        view = replace(BY_ID[view_id], calibration=found)
        (hanging,) = view.points_hanger[(view.pixel == np.array(pixel)).all(axis=1)]
        there = transform_points(found.T_rig_hanger(newest.angle_rad), hanging[None])[0]
        assert place == pytest.approx(there, abs=1e-6)


def test_markers_of_an_empty_garment_are_empty():
    none = replace(
        GARMENT,
        lines=replace(
            GARMENT.lines,
            nodes_hanger=np.empty((0, 3, 3)),
            view_id=np.empty(0, np.int64),
            length_m=np.empty(0),
            sigma_m=np.empty(0),
            flagged=np.empty(0, bool),
        ),
        measurements=(),
        landmarks=(),
        correspondences=(),
    )
    by_name = {m["ns"]: m for m in displays.marker_fields(none, VIEWS)["markers"]}
    assert by_name["geodesic_lines"]["points"] == []
    assert by_name["sizes"]["points"] == []


def make_class(class_name, /, **types_of):
    """A class that looks like a generated message."""

    def get_fields_and_field_types(self):
        return types_of

    return type(class_name, (), {"get_fields_and_field_types": get_fields_and_field_types})


@pytest.fixture
def fake(monkeypatch):
    point = make_class("Point", x="double", y="double")
    module = types.SimpleNamespace(Point=point)
    monkeypatch.setattr(messages, "import_module", {"fake_msgs.msg": module}.__getitem__)
    return make_class(
        "Fake",
        name="string",
        level="octet",
        u="sequence<float>",
        data="sequence<uint8>",
        ids="sequence<uint32, 10>",
        pixel="int32[2]",
        names="sequence<string>",
        at="fake_msgs/Point",
        places="sequence<fake_msgs/Point>",
    )


FILLED = {
    "name": "a",
    "level": 2,
    "u": np.array([0.5, 1.5], np.float32),
    "data": np.array([1, 2, 255], np.uint8),
    "ids": [3, 4],
    "pixel": np.array([7, 8], np.int32),
    "names": ["b", "c"],
    "at": {"x": 1.0, "y": 2.0},
    "places": [{"x": 3.0, "y": 4.0}, {"x": 5.0, "y": 6.0}],
}


def test_fill_gives_every_field_the_type_that_rclpy_takes_unchecked(fake):
    message = messages.fill(fake(), FILLED)
    assert message.u == array.array("f", [0.5, 1.5])
    assert message.data == array.array("B", [1, 2, 255])
    assert message.ids == array.array("I", [3, 4])
    assert message.level == b"\x02"
    assert message.pixel.dtype == np.int32
    assert message.names == ["b", "c"]
    assert (message.at.x, message.places[1].y) == (1.0, 6.0)


def test_read_is_the_reverse_of_fill(fake):
    fields = messages.read(messages.fill(fake(), FILLED))
    plain = json.loads(json.dumps(fields, default=lambda a: a.tolist()))
    assert plain == json.loads(json.dumps(FILLED, default=lambda a: a.tolist()))


def test_fill_refuses_an_unknown_field(fake):
    with pytest.raises(KeyError, match="colour"):
        messages.fill(fake(), {"colour": 1})


def test_a_result_says_whose_item_it_is():
    for fields_of in (messages.flattened_view_fields, messages.garment_estimate_fields):
        assert fields_of(GARMENT, VIEWS)["item"] == 0  # of no node
        assert fields_of(GARMENT, VIEWS, 7)["item"] == 7
