"""What becomes of every cloud: each reason to drop one, as a planner and an operator see it."""

import runpy
import signal
import types

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from ros_rig import CALIBRATION, ROOT, Process, Rig
from sensor_msgs.msg import JointState, PointCloud2, PointField

from vflatten_ros.core.events import DROP_REASONS, REMEDIES

START_S = 1_800_000_000
FIELDS = [
    PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
    for i, name in enumerate("xyz")
]
OPEN, CLOSED = 0.04, 0.0


def stamped(header, at_s):
    header.stamp.sec = START_S + int(at_s)
    header.stamp.nanosec = round(at_s % 1 * 1e9)


def strip(at_s, shift_m=0.0, frame="rig_optical", **lies):
    """A strip of cloth below the gripper, 4 mm between points."""
    row, col = np.mgrid[:60, :30]
    xyz = np.stack([0.004 * (col - 15) + shift_m, 0.004 * row - 0.48, np.full(row.shape, 1.3)], 2)
    message = PointCloud2(height=60, width=30, fields=FIELDS, point_step=12, row_step=360)
    message.header.frame_id = frame
    stamped(message.header, at_s)
    message.data = xyz.astype("<f4").tobytes()
    for name, value in lies.items():
        setattr(message, name, value)
    return message


class Turning:
    """A wrist that turns as told, and a camera that looks at a strip of cloth."""

    def __init__(self, rig):
        self.rig, self.now_s, self.position, self.clouds = rig, 1.0, 0.0, 0

    def turn(self, seconds, rate=0.0, fingers=CLOSED):
        """Joint states at 50 Hz."""
        for _ in range(round(seconds * 50)):
            self.now_s += 0.02
            self.position += 0.02 * rate
            message = JointState(name=["wrist_roll", "finger_left", "finger_right"])
            message.position = [self.position, fingers, fingers]
            stamped(message.header, self.now_s)
            self.rig.publish(message)
        self.rig.buffer()  # not faster than the node takes them

    def see(self, at_s, reason=None, **how):
        """One cloud; waits until the node has decided."""
        before = self.rig.drops()
        self.rig.publish(strip(at_s, **how))
        self.clouds += 1
        self.rig.until(lambda: self.rig.settled(self.clouds), f"cloud {self.clouds}")
        after = self.rig.drops()
        gained = {name for name in after if after[name] != before.get(name, 0)}
        assert gained == ({reason} if reason else set())


def reactivate(rig):
    for transition in (4, 3):
        assert rig.ask("change_state", transition=Transition(id=transition)).success
    rig.reconnect()


def test_every_reason_to_drop_a_cloud_is_counted_reported_and_explained(rig):
    reactivate(rig)
    changed = {"joints.wait_s": 0.3, "buffer.max_rate_rad_s": 1.0, "buffer.min_views": 3}
    changed |= {"buffer.max_views": 3}
    before = {"joints.wait_s": 1.0, "buffer.max_rate_rad_s": 0.0, "buffer.max_views": 128}
    before |= {"buffer.min_views": 6}
    for name, value in changed.items():
        assert rig.set_parameter(name, value).successful
    arm = Turning(rig)
    arm.see(1.0, "no_joint_state")
    arm.see(1.0, "invalid_cloud", width=4_000_000)
    arm.see(1.0, "wrong_frame", frame="map")
    arm.see(1.0, "empty_after_segmentation", shift_m=5.0)
    arm.turn(2.0, rate=0.5)
    arm.see(2.0)
    arm.see(1.9, "time_went_backwards")
    arm.now_s += 0.5  # no joint states meanwhile
    arm.turn(1.0, rate=0.5)
    arm.see(arm.now_s - 1.25, "too_old")
    arm.turn(0.5, rate=3.0)
    arm.see(arm.now_s - 0.2, "wrist_moving_too_fast")
    arm.turn(2.0)
    arm.see(arm.now_s - 1.5)
    arm.see(arm.now_s - 1.2, "duplicate_angle")
    arm.see(arm.now_s - 0.9, "item_swinging", shift_m=0.1)
    arm.turn(1.0, rate=0.5)
    arm.see(arm.now_s - 0.5)
    arm.turn(1.0, rate=0.5)
    arm.see(arm.now_s - 0.5, "buffer_full")
    held = [view.id for view in rig.ask("list_views").views]
    assert rig.ask("clear_views", ids=held[:1]).removed == 1
    arm.turn(0.5, fingers=OPEN)
    arm.see(arm.now_s - 0.2, "gripper_open")
    counted = rig.check_accounts()
    reasons = dict(zip(counted.drop_reasons, counted.drop_counts, strict=True))
    assert reasons == dict.fromkeys(set(DROP_REASONS) - {"previous_item"}, 1)
    shown = rig.diagnostics()["buffer"]
    assert {name for name in shown if name.startswith("dropped: ")} == {
        f"dropped: {name}" for name in reasons
    }

    arm.turn(1.0)  # the fingers close: the next item
    assert rig.buffer().item == counted.item + 1
    assert f"item {counted.item + 1} begins: the fingers closed" in rig.node.log()
    arm.clouds = 0
    arm.see(arm.now_s - 1.2, "previous_item")
    arm.see(arm.now_s - 0.5)
    assert rig.check_accounts().clouds_received == 2
    for reason in REMEDIES:
        assert f"dropped, {reason}: " in rig.node.log(), reason
        assert REMEDIES[reason] in rig.node.log(), reason
    for name, value in before.items():
        assert rig.set_parameter(name, value).successful
    reactivate(rig)
    rig.serves_a_good_rotation()


def test_a_wrist_that_does_not_turn_is_told_in_the_log_and_in_the_diagnostics(rig):
    reactivate(rig)
    arm = Turning(rig)
    arm.turn(1.0)
    for number in range(12):
        arm.turn(0.5)
        arm.see(arm.now_s - 0.2, "duplicate_angle" if number else None)
    text = "wrist joint 'wrist_roll' has moved by 0.000 rad while {} clouds came; does the joint"
    assert rig.node.log().count(text.format(11)) == 1
    assert text.format(12) in rig.diagnostics()["buffer"][""]
    reactivate(rig)


def test_joint_states_without_a_position_are_told(rig):
    reactivate(rig)
    rig.publish(JointState(name=["finger_left", "wrist_roll"], position=[0.0]))
    rig.publish(JointState(name=["wrist_roll"], position=[np.nan]))
    said = "states of joint 'wrist_roll' came without a usable position, the newest has"
    rig.until(lambda: said in rig.node.log(), "a warning")
    shown = rig.until(
        lambda: (
            (now := rig.diagnostics()["buffer"])["joint states without a position"] == "2" and now
        ),
        "both",
    )
    assert f"2 {said} position nan" in shown[""]
    reactivate(rig)


def test_most_of_the_last_clouds_dropped_is_told_though_there_are_views(rig):
    reactivate(rig)
    arm = Turning(rig)
    arm.turn(4.0, rate=0.5)
    for at_s in (1.5, 2.0, 2.5):
        arm.see(at_s)
    arm.see(3.0, "wrong_frame", frame="map")
    assert "of the last" not in rig.diagnostics()["buffer"][""]
    for at_s in (3.1, 3.2, 3.3):
        arm.see(at_s, "wrong_frame", frame="map")
    text = "4 of the last 7 clouds dropped, most as wrong_frame: correct the frame"
    assert text in rig.diagnostics()["buffer"][""]
    reactivate(rig)


def test_each_way_in_which_a_cloud_is_wrong_is_told(rig):
    reactivate(rig)
    arm = Turning(rig)
    for lies in ({"fields": []}, {"point_step": 2}, {"data": b""}):
        arm.see(1.0, "invalid_cloud", **lies)
    arm.see(1.0, "empty_after_segmentation", data=np.zeros(60 * 30 * 3, "<f4").tobytes())
    arm.see(1.0, "empty_after_segmentation", data=np.full(60 * 30 * 3, 1300, "<f4").tobytes())
    lines = rig.node.log().splitlines()
    kinds = {line.split("invalid_cloud: ")[1] for line in lines if "invalid_cloud: " in line}
    assert len(kinds) >= 3, kinds
    assert any("none of its 60 x 30 points is measured" in line for line in lines)
    assert any("are these millimetres?" in line for line in lines)
    reactivate(rig)


def test_an_item_that_fills_the_image_is_told_as_it_arrives(rig):
    reactivate(rig)
    arm = Turning(rig)
    arm.turn(2.0, rate=0.5)
    arm.see(2.0)
    assert "the item reaches the upper and lower and left and right border" in rig.node.log()
    reactivate(rig)


def test_a_flood_of_mistakes_does_not_flood_the_log(rig):
    reactivate(rig)
    lines = len(rig.node.log().splitlines())
    for number in range(150):
        rig.publish(strip(number, frame="map"))
        rig.publish(strip(number, point_step=0))
        assert not rig.ask("change_state", transition=Transition(id=3)).success  # it is active
        if number % 5 == 4:
            rig.until(lambda sent=2 * number + 2: rig.settled(sent), "the clouds so far")
    assert rig.drops() == {"wrong_frame": 150, "invalid_cloud": 150}
    added = rig.node.log().splitlines()[lines:]
    assert 1 <= len(added) <= 3, added  # one for each reason, if not said a moment ago
    rig.serves_a_good_rotation()


def test_a_clock_that_goes_to_and_fro_does_not_flood_the_log(rig):
    """As where two publishers stamp by different clocks; an item with its views came before."""
    reactivate(rig)
    arm = Turning(rig)
    arm.turn(8.0, rate=0.5)
    for at_s in range(2, 8):
        arm.see(float(at_s))
    before = len(rig.node.log())
    item = rig.buffer().item
    for _ in range(5):
        for arm.now_s in (100.0, 1.0):
            arm.turn(0.1)
    rig.until(lambda: rig.buffer().item == item + 5, "an item for each time it was set back")
    assert 1 <= rig.node.log()[before:].count("begins: the clock was set back") <= 2
    reactivate(rig)


def test_two_rigs_side_by_side_each_hear_their_own(ros, tmp_path):
    """One of them by bag time, which is another's past."""
    recordings = [CALIBRATION.parents[1] / name for name in ("LS1_1", "TR1_1")]
    rigs = [
        Rig(tmp_path, arguments=["--calibration", str(folder / "calibration.yaml"), *more])
        for folder, more in zip(
            recordings, ([], ["--ros-args", "-p", "use_sim_time:=true"]), strict=True
        )
    ]
    try:
        for rig in rigs:
            rig.set_parameter("geodesics.nodes", 30)
        players = [
            rig.play("--rate", 4, *more, recording=folder, wait=False)
            for rig, folder, more in zip(rigs, recordings, ([], ["--clock"]), strict=True)
        ]
        sizes = []
        for rig, player in zip(rigs, players, strict=True):
            assert player.wait() == 0, player.log()
            buffer = rig.until(rig.complete, "the rotation")
            assert not buffer.drop_counts
            assert rig.diagnostics()["clouds"]["received"] == "24"
            rig.until(lambda rig=rig: "flattened in" in rig.node.log(), "flattening by itself")
            sizes.append([view.points for view in buffer.views])
        assert len(sizes[0]) == len(sizes[1]) == 24
        assert all(shirt != trousers for shirt, trousers in zip(*sizes, strict=True))
    finally:
        for rig in rigs:
            rig.close()


def test_bag_time_that_begins_anew_begins_one_item(ros, tmp_path):
    arguments = ["--calibration", str(CALIBRATION), "--ros-args", "-p", "use_sim_time:=true"]
    rig = Rig(tmp_path, arguments=arguments)
    try:
        rig.set_parameter("auto_flatten", False)
        rig.play("--rate", 6, "--loop", 2, "--clock")
        buffer = rig.until(rig.complete, "the rotation")
        assert buffer.item == 2
        # of the first round, the last cloud may come after the clock has been set back
        late = dict(zip(buffer.drop_reasons, buffer.drop_counts, strict=True))
        assert late in ({}, {"previous_item": 1})
        assert len(buffer.views) == 24
        assert rig.diagnostics()["buffer"]["clock jumps"] == "1"
    finally:
        rig.close()


class Impatient:
    """A planner whose views are gone some times when they are to be flattened."""

    def __init__(self, example, gone):
        self.example, self.gone, self.gathered = example, gone, 0

    def gather(self, player, wanted):
        self.gathered += 1

    def flatten(self, method, view_ids):
        if self.gathered <= self.gone:
            raise self.example.NoViews("flatten: the buffer holds no views")
        return "result"


def test_the_planner_gathers_again_where_its_views_are_gone():
    example = runpy.run_path(str(ROOT / "examples" / "planner.py"))
    example = types.SimpleNamespace(**example)
    again = Impatient(example, gone=2)
    gather_and_flatten = example.Planner.gather_and_flatten
    assert gather_and_flatten(again, None, {"views": []}, "rotation") == "result"
    assert again.gathered == 3
    with pytest.raises(example.NoViews):
        gather_and_flatten(Impatient(example, gone=99), None, {"views": []}, "rotation")
    turned_it_itself = Impatient(example, gone=1)
    with pytest.raises(example.NoViews):  # nobody turns it once more
        gather_and_flatten(turned_it_itself, object(), {"views": []}, "rotation")
    assert turned_it_itself.gathered == 1


def test_a_planner_without_a_recording_says_so_at_once(ros, tmp_path):
    planner = Process(["examples/planner.py", str(tmp_path / "nowhere")], tmp_path / "log")
    assert planner.wait() == 1
    (line,) = planner.log().splitlines()
    assert line.startswith("planner: ") and "nowhere: no such recording" in line


def test_a_recording_that_cannot_be_played_is_no_lack_of_views(ros, rig, tmp_path):
    arguments = ["examples/planner.py", str(tmp_path), "--node", f"{rig.namespace}/vflatten"]
    planner = Process(arguments, tmp_path / "log")
    assert planner.wait() == 1
    assert "the recording was not played (exit code 1)" in planner.log()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_planner_that_is_interrupted_ends_without_a_traceback(rig, tmp_path, how):
    arguments = ["examples/planner.py", str(CALIBRATION.parent), "--rate", "1"]
    arguments += ["--node", f"{rig.namespace}/vflatten", "--namespace", rig.namespace]
    planner = Process(arguments, tmp_path / "log")
    rig.until(lambda: "views: " in planner.log(), "the first view")
    assert planner.stop(how) == 130
    assert "Traceback" not in planner.log()
    rig.serves_a_good_rotation()


def test_planners_as_processes_at_once_each_get_a_result(rig, tmp_path):
    """Whatever the other one does meanwhile: each begins a new item before and after."""
    player = rig.play("--rate", 8, "--loop", wait=False)
    try:
        rig.until(lambda: len(rig.buffer().views) > 3, "some views")
        processes = [
            Process(
                [
                    "examples/planner.py",
                    str(CALIBRATION.parent),
                    *("--node", f"{rig.namespace}/vflatten", "--no-play", "--method", "rotation"),
                ],
                tmp_path / f"planner{number}.log",
            )
            for number in range(2)
        ]
        for process in processes:
            assert process.wait() == 0, process.log()
            assert "towel (quality" in process.log()
            assert "begins" in process.log()
    finally:
        player.kill()
    rig.serves_a_good_rotation()
