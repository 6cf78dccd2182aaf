"""Faults: afterwards the node serves a good rotation, and its counters explain what happened."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import slow_work
from lifecycle_msgs.msg import Transition
from ros_rig import CALIBRATION, RECORDING, Rig, recorded
from sensor_msgs.msg import JointState, PointCloud2, PointField
from std_srvs.srv import Trigger

from vflatten_ros import msg
from vflatten_ros.bag import RecordedCloud, RecordedJoints

HEADER_NS = 1_800_000_000_000_000_000


def cloud(**changes):
    """A tiny valid cloud, with some of its fields replaced by lies."""
    fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
        for i, name in enumerate("xyz")
    ]
    message = PointCloud2(height=2, width=3, fields=fields, point_step=12, row_step=36)
    message.header.frame_id = "rig_optical"
    message.header.stamp.sec = HEADER_NS // 10**9
    message.data = np.ones(18, "<f4").tobytes()
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def lies(**changes):
    """Fields x, y, z at the same place, with one value changed."""
    right = {"offset": 0, "datatype": PointField.FLOAT32, "count": 1}
    return [PointField(name=name, **(right | changes)) for name in "xyz"]


GARBAGE = [
    cloud(height=2_000_000_000, width=2_000_000_000),
    cloud(width=4_000_000),
    cloud(point_step=0),
    cloud(point_step=4_000_000_000),
    cloud(row_step=1),
    cloud(data=b""),
    cloud(data=b"short"),
    cloud(fields=[]),
    cloud(fields=lies(offset=4_000_000_000)),
    cloud(fields=lies(datatype=99)),
    cloud(fields=lies(count=4_000_000_000)),
]


def test_garbage_clouds_are_counted_and_nothing_else(rig):
    for message in [*GARBAGE, cloud(height=0, width=0, data=b"", row_step=0)]:
        rig.publish(message)
    wanted = len(GARBAGE) + 1
    rig.until(lambda: rig.buffer().clouds_received == wanted, f"{wanted} clouds")
    assert rig.drops() == {"invalid_cloud": len(GARBAGE), "empty_after_segmentation": 1}
    assert rig.diagnostics()["node"]["internal errors"] == "0"
    rig.serves_a_good_rotation()


def test_a_cloud_of_another_frame_and_absurd_joint_states_are_counted(rig):
    for names, positions in ((["wrist_roll"], []), ([], [1.0]), (["wrist_roll"], [np.nan])):
        rig.publish(JointState(name=names, position=positions))
    rig.publish(JointState(name=["wrist_roll"] * 3, position=[np.inf, -np.inf, 1e308]))
    lost = cloud()
    lost.header.frame_id = "map"
    rig.publish(lost)
    rig.until(lambda: rig.buffer().clouds_received == 1, "the cloud")
    assert rig.drops() == {"wrong_frame": 1}
    (line,) = [line for line in rig.node.log().splitlines() if "wrong_frame" in line]
    assert f"{rig.namespace}/rig/points: cloud 0 dropped" in line
    assert "frame 'map', the calibration is for 'rig_optical'; correct the frame" in line
    rig.serves_a_good_rotation()


def test_joint_states_that_stop_and_resume_cost_only_the_clouds_between(rig):
    clouds = [m for m in recorded() if isinstance(m, RecordedCloud)]
    silent = range(clouds[8].log_ns - 400_000_000, clouds[12].log_ns - 400_000_000)
    rig.turn(keep=lambda m: isinstance(m, RecordedCloud) or m.log_ns not in silent)
    buffer = rig.until(lambda: rig.settled(24), "24 clouds")
    lost = rig.drops()
    assert set(lost) == {"too_old"}
    assert 3 <= lost["too_old"] <= 5
    assert {9, 10, 11}.isdisjoint(view.id for view in buffer.views)
    rig.check_accounts()
    rig.serves_a_good_rotation()


def test_without_joint_states_clouds_wait_a_bounded_time(rig):
    rig.set_parameter("joints.wait_s", 0.5)
    for transition in (4, 3):  # joint states of the rotations before have the same stamps
        assert rig.ask("change_state", transition=Transition(id=transition)).success
    rig.reconnect()
    rig.turn(keep=lambda m: isinstance(m, RecordedCloud), rate=20)
    rig.until(lambda: sum(rig.drops().values()) == 24, "all clouds dropped")
    assert set(rig.drops()) <= {"no_joint_state", "too_old"}
    rig.set_parameter("joints.wait_s", 1.0)
    rig.serves_a_good_rotation()


def test_a_clock_that_jumps_back_begins_a_new_item(rig):
    rig.turn()
    first = rig.until(rig.complete, "the rotation")
    jumps = int(rig.diagnostics()["buffer"]["clock jumps"])
    rig.turn()
    second = rig.until(lambda: (b := rig.complete()) and b.item > first.item and b, "the next item")
    assert len(second.views) == 24
    assert not second.drop_counts
    assert int(rig.diagnostics()["buffer"]["clock jumps"]) == jumps + 1
    assert "stamps went back" in rig.node.log()
    rig.turn()
    third = rig.until(lambda: (b := rig.complete()) and b.item > second.item and b, "one more")
    for item in (second.item, third.item):  # a looped bag has a line for each
        assert f"item {item} begins: the clock was set back" in rig.node.log()


def test_a_player_that_is_killed_and_started_again(rig):
    player = rig.play("--rate", 4, "--loop", wait=False)
    rig.until(lambda: len(rig.buffer().views) >= 4, "some views")
    player.kill()
    killed_at = rig.buffer().item
    rig.play("--rate", 6)
    buffer = rig.until(lambda: (b := rig.complete()) and b.item > killed_at and b, "all views")
    assert len(buffer.views) == 24
    assert not buffer.drop_counts
    rig.serves_a_good_rotation()


def test_what_is_lost_in_transport_is_counted(rig):
    def seen(topic):
        values = rig.diagnostics()[topic]
        return int(values["received"]) + int(values["lost in transport"])

    before = {topic: seen(topic) for topic in ("clouds", "joint states")}
    rig.turn(rate=1000)
    end = recorded()[-1]
    last = next(m for m in reversed(recorded()) if isinstance(m, RecordedCloud))
    for _ in range(2):  # what follows shows the gap
        time.sleep(0.5)
        rig.turntable.play([last, end], 1000)
    rig.until(lambda: seen("clouds") == before["clouds"] + 26, "26 clouds")
    joints = sum(isinstance(m, RecordedJoints) for m in recorded()) + 2
    rig.until(lambda: seen("joint states") == before["joint states"] + joints, f"{joints} states")
    rig.check_accounts()
    rig.serves_a_good_rotation()


def test_two_planners_at_once_both_get_their_results_and_the_queue_says_when_it_is_full(rig):
    rig.turn()
    rig.until(rig.complete, "the rotation")
    rig.set_parameter("geodesics.nodes", slow_work.SLOW)
    rig.set_parameter("max_queued_goals", 2)
    same = [rig.send_goal(view_ids=[1, 2]), rig.send_goal(view_ids=[1, 2])]
    others = [rig.send_goal(view_ids=ids) for ids in ([3, 4], [5, 6], [7, 8])]
    # a goal works on what the buffer held when it was accepted
    rig.ask("new_item")
    answers = [rig.result_of(goal.get_result_async()) for goal in [*same, *others]]
    codes = [answer.result.status.code for answer in answers]
    assert codes == [msg.Status.OK] * 4 + [msg.Status.BUSY]
    used = [list(answer.result.flattened.view_ids) for answer in answers[:4]]
    assert used == [[1, 2], [1, 2], [3, 4], [5, 6]]
    rig.set_parameter("geodesics.nodes", slow_work.GOOD)
    rig.set_parameter("max_queued_goals", 4)
    rig.serves_a_good_rotation()


@pytest.mark.parametrize("work", [slow_work.SLOW, slow_work.STUBBORN])
def test_a_cancelled_goal_is_answered_and_the_next_one_served(rig, work):
    rig.turn()
    rig.until(rig.complete, "the rotation")
    rig.set_parameter("geodesics.nodes", work)
    seen = []
    goal = rig.send_goal(lambda message: seen.append(message.feedback.stage))
    rig.until(lambda: "work" in seen, "the work to begin")
    rig.result_of(goal.cancel_goal_async())
    answer = rig.result_of(goal.get_result_async())
    assert answer.result.status.code == msg.Status.CANCELLED
    assert answer.status == 5  # action_msgs/GoalStatus.STATUS_CANCELED
    rig.set_parameter("geodesics.nodes", slow_work.GOOD)
    assert rig.flatten().result.status.code == msg.Status.OK


def test_a_flattening_process_that_is_killed_costs_one_goal(rig):
    rig.turn()
    rig.until(rig.complete, "the rotation")
    rig.set_parameter("geodesics.nodes", slow_work.STUBBORN)
    seen = []
    goal = rig.send_goal(lambda message: seen.append(message.feedback.stage))
    rig.until(lambda: "work" in seen, "the work to begin")
    (worker,) = rig.node.children()
    os.kill(worker, signal.SIGKILL)
    answer = rig.result_of(goal.get_result_async())
    assert answer.result.status.code == msg.Status.FAILED
    assert "process ended" in answer.result.status.message
    rig.set_parameter("geodesics.nodes", slow_work.GOOD)
    rig.serves_a_good_rotation()


def test_a_node_killed_in_mid_rotation_serves_after_its_restart(shared_rig, tmp_path):
    before = shared_rig.diagnostics()["clouds"]["received"]
    arguments = ["--calibration", str(CALIBRATION), "--ros-args", "-p", "use_sim_time:=true"]
    rig = Rig(tmp_path, arguments=arguments)
    try:
        player = rig.play("--rate", 4, "--clock", wait=False)
        rig.until(lambda: len(rig.buffer().views) >= 3, "some views")
        (worker,) = rig.node.children()
        rig.node.kill()
        assert player.wait() == 0
        rig.start()
        with pytest.raises(ProcessLookupError):  # its flattening process did not stay behind
            os.kill(worker, 0)
        assert rig.buffer().clouds_received == 0
        rig.serves_a_good_rotation()
        (worker,) = rig.node.children()
        # two rigs side by side: the other one has heard nothing of this
        assert shared_rig.diagnostics()["clouds"]["received"] == before
        assert rig.node.stop(signal.SIGTERM) == 0
        with pytest.raises(ProcessLookupError):
            os.kill(worker, 0)
    finally:
        rig.close()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_the_end_waits_for_the_callback_at_hand(ros, tmp_path, how):
    busy = [str(Path(__file__).parent / "busy_node.py")]
    rig = Rig(tmp_path, kind=busy, arguments=["--calibration", str(CALIBRATION)], wait=False)
    try:
        rig.until(lambda: rig.node.log().endswith("begins\n"), "a callback")
        (worker,) = rig.node.children()
        assert rig.node.stop(how) == 0
        log = rig.node.log()
        assert log.count("begins\n") == log.count("ended\n")  # nothing is begun anew
        assert "Traceback" not in log
        assert log.splitlines()[-1].endswith(f"the node ends: {how.name}")
        with pytest.raises(ProcessLookupError):
            os.kill(worker, 0)
    finally:
        rig.close()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_who_waits_for_a_result_is_answered_when_the_node_ends(ros, tmp_path, how):
    rig = Rig(tmp_path, arguments=["--calibration", str(CALIBRATION)])
    try:
        rig.set_parameter("auto_flatten", False)
        rig.set_parameter("geodesics.nodes", slow_work.STUBBORN)
        rig.turn()
        rig.until(rig.complete, "the rotation")
        goals = [rig.send_goal(view_ids=ids) for ids in ([1, 2], [3, 4])]
        results = [goal.get_result_async() for goal in goals]
        line = rig.planner.create_client(Trigger, "vflatten/flatten")
        rig.until(line.service_is_ready, "the service")
        called = line.call_async(Trigger.Request())
        rig.until(lambda: rig.ask("state").flattening, "the work to begin")
        rig.until(lambda: rig.diagnostics()["flattening"]["waiting"] == "2", "the queue")
        os.kill(rig.node.pid, how)
        answers = [rig.result_of(result) for result in results]
        for answer in answers:
            assert answer.status == 6  # action_msgs/GoalStatus.STATUS_ABORTED
            assert answer.result.status.code == msg.Status.CANCELLED
            assert f"the node was ended ({how.name})" in answer.result.status.message
        answer = rig.result_of(called)
        assert not answer.success and "the node was ended" in answer.message
        assert rig.node.wait() == 0
        assert f"the node ends: {how.name}" in rig.node.log()
        assert "3 requests for a result are abandoned" in rig.node.log()
    finally:
        rig.close()


def test_a_ros_time_that_jumps_back_begins_a_new_item(ros, tmp_path):
    from rosgraph_msgs.msg import Clock

    arguments = ["--calibration", str(CALIBRATION), "--ros-args"]
    arguments += ["-p", "use_sim_time:=true", "-r", "/clock:=clock"]
    rig = Rig(tmp_path, arguments=arguments)
    try:
        clock = rig.planner.create_publisher(Clock, "clock", 10)
        rig.until(clock.get_subscription_count, "the node")
        rig.turn()
        item = rig.until(rig.complete, "the rotation").item
        for seconds in (1_700_000_020, 1_699_999_999):  # just before the recording, again
            message = Clock()
            message.clock.sec = seconds
            for _ in range(5):  # a node takes the clock best effort
                clock.publish(message)
                time.sleep(0.1)
        rig.until(lambda: rig.buffer().item == item + 1, "a new item")
        assert "stamps went back" in rig.node.log()
        rig.serves_a_good_rotation()
        assert rig.node.stop(signal.SIGINT) == 0
    finally:
        rig.close()


def test_the_recording_is_the_one_that_the_tests_expect():
    assert sum(isinstance(m, RecordedCloud) for m in recorded()) == 24, RECORDING
