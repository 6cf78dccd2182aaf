"""A rotation arrives whole, and its results stay for those who come late."""

import numpy as np
import rclpy
import slow_work
from garments import CALIBRATION, example_garment
from geometry_msgs.msg import PolygonStamped
from ros_rig import LATCHED
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from vflatten_ros import msg

OUTPUTS = {
    "flattened_view": msg.FlattenedView,
    "garment": msg.GarmentEstimate,
    "contour": PolygonStamped,
    "markers": MarkerArray,
    "image": Image,
    "points": PointCloud2,
    "views": msg.ViewBufferState,
}


def test_all_clouds_at_four_times_the_rate_are_buffered_and_flattened_without_asking(rig):
    rig.set_parameter("auto_flatten", True)
    before = rig.diagnostics()["clouds"]
    rig.play("--rate", 4, "--best-effort")
    buffer = rig.until(rig.complete, "the rotation")
    assert [view.id for view in buffer.views] == list(range(24))
    assert not buffer.drop_counts
    rig.until(lambda: "flattened in" in rig.node.log(), "flattening by itself")
    after = rig.diagnostics()["clouds"]
    assert int(after["received"]) - int(before["received"]) == 24
    assert int(after["lost in transport"]) == int(before["lost in transport"])


def test_on_the_way_the_node_says_when_the_views_are_enough(rig):
    rig.set_parameter("look_early_deg", 45.0)
    before = len(rig.node.log())
    try:
        rig.play("--rate", 4, "--best-effort")
        rig.until(lambda: rig.buffer().enough, "enough views")
        line = next(
            line for line in rig.node.log()[before:].splitlines() if "views are enough" in line
        )
        count = int(line.split(" views are enough")[0].split()[-1])
        assert slow_work.ENOUGH <= count < 24
        rig.until(rig.complete, "the rotation")
    finally:
        rig.set_parameter("look_early_deg", 0.0)
    assert rig.ask("new_item").success
    assert not rig.buffer().enough


def test_a_late_planner_gets_every_output(rig):
    rig.serves_a_good_rotation()
    late = rclpy.create_node("late", namespace=rig.namespace)
    got = {}
    for name, kind in OUTPUTS.items():
        late.create_subscription(
            kind, f"vflatten/{name}", lambda m, name=name: got.update({name: m}), LATCHED
        )
    end = rig.planner.get_clock().now().nanoseconds + 30e9
    while len(got) < len(OUTPUTS) and rig.planner.get_clock().now().nanoseconds < end:
        rclpy.spin_once(late, timeout_sec=0.1)
    late.destroy_node()
    assert set(got) == set(OUTPUTS)
    assert got["flattened_view"].header.frame_id == "rig_optical"
    assert got["garment"].category == "towel"
    assert [field.name for field in got["points"].fields][3:5] == ["u", "v"]
    image = np.frombuffer(got["image"].data, np.uint8)
    assert image.size == got["image"].step * got["image"].height
    assert image.min() < 100  # something is drawn
    namespaces = {marker.ns for marker in got["markers"].markers}
    assert {"item", "geodesic_lines", "correspondences", "outline", "landmarks"} <= namespaces


def test_feedback_comes_by_stage_and_never_goes_back(rig):
    rig.turn()
    rig.until(rig.complete, "the rotation")
    seen = []
    rig.set_parameter("geodesics.nodes", slow_work.SLOW)
    handle = rig.send_goal(lambda message: seen.append(message.feedback))
    answer = rig.result_of(handle.get_result_async())
    assert answer.result.status.code == msg.Status.OK
    assert "work" in {feedback.stage for feedback in seen}
    progress = [feedback.progress for feedback in seen]
    assert progress == sorted(progress)
    assert list(answer.result.stages)[-1] == "work"


def test_one_line_calls_do_what_their_names_say(rig):
    refused = rig.ask("flatten")
    assert not refused.success and "no views" in refused.message
    rig.turn()
    rig.until(rig.complete, "the rotation")
    done = rig.ask("flatten")
    assert done.success and done.message.startswith("towel, width 0.300")
    assert rig.ask("clear").message == "0 corresponding points removed"
    assert rig.ask("new_item").success
    assert rig.buffer().clouds_received == 0


def test_landmarks_turn_with_the_wrist(rig):
    assert rig.ask("locate_landmark", name="left_top_corner").status.code == msg.Status.NO_RESULT
    rig.serves_a_good_rotation()
    there = rig.ask("locate_landmark", name="left_top_corner", at_angle=True, item_angle=0.0)
    back = rig.ask("locate_landmark", name="left_top_corner", at_angle=True, item_angle=np.pi)
    now = rig.ask("locate_landmark", name="left_top_corner")
    assert there.status.code == now.status.code == msg.Status.OK
    assert there.position.header.frame_id == "rig_optical"
    p, q = there.position.point, back.position.point
    (mark,) = (m for m in example_garment().landmarks if m.name == "left_top_corner")
    by_result = CALIBRATION.T_rig_hanger(0.0) @ [*mark.xyz_hanger, 1.0]  # not by the node's own
    assert np.allclose([p.x, p.y, p.z], by_result[:3], atol=1e-9)
    assert np.hypot(p.x - q.x, p.z - q.z) > 0.2  # a corner 0.12 m from the axis, to the other side
    for name, code in (("left_ear", "UNKNOWN_NAME"), ("left_bottom_corner", "NOT_SEEN")):
        answer = rig.ask("locate_landmark", name=name)
        assert answer.status.code == getattr(msg.Status, code)
    assert "nearest cloth" in answer.status.message
    assert abs(answer.sigma - 0.102) < 1e-6 and not answer.views
    assert answer.position.header.frame_id == "rig_optical"
    elsewhere = rig.ask("locate_landmark", name="left_top_corner", frame_id="base_link")
    assert elsewhere.status.code == msg.Status.UNKNOWN_NAME
    assert "tf2_ros" in elsewhere.status.message or "transform" in elsewhere.status.message
