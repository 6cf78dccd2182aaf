"""`vflatten play` gives back what was recorded, in its own time."""

import itertools
import signal
import time
from types import SimpleNamespace

import pytest
import rclpy
import zstandard
from rclpy.qos import qos_profile_sensor_data
from recordings import Message, joints, write_bag
from ros_rig import RECORDING, Process, recorded, unused_namespace
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, PointCloud2

from vflatten_ros.bag import CLOUD_TYPE, RecordedCloud, open_recording
from vflatten_ros.player import Player


class Listener:
    """Everything that a player publishes, and when it came."""

    def __init__(self):
        self.namespace = unused_namespace()
        self.node = rclpy.create_node("listener", namespace=self.namespace)
        self.clouds, self.joints, self.clock = [], [], []
        subscribe = self.node.create_subscription
        subscribe(PointCloud2, "rig/points", self._on_cloud, qos_profile_sensor_data)
        subscribe(JointState, "gripper/joint_states", self._on_joints, 1000)
        subscribe(Clock, "clock", self._on_clock, 1000)

    def _on_cloud(self, message):
        self.clouds.append(nanoseconds(message.header.stamp))

    def _on_joints(self, message):
        self.joints.append(message.position[0])

    def _on_clock(self, message):
        self.clock.append(nanoseconds(message.clock))

    def play(self, log, *options):
        remap = ["--ros-args", "-r", f"__ns:={self.namespace}", "-r", "/clock:=clock"]
        command = ["-m", "vflatten_ros.player", str(RECORDING), *map(str, options), *remap]
        return Process(command, log)

    def listen(self, until):
        end = time.monotonic() + 60.0
        while not until():
            assert time.monotonic() < end
            rclpy.spin_once(self.node, timeout_sec=0.05)


def nanoseconds(stamp):
    return stamp.sec * 10**9 + stamp.nanosec


@pytest.fixture
def listener(ros):
    listener = Listener()
    yield listener
    listener.node.destroy_node()


def test_a_recording_is_played_twice_with_its_clock(listener, tmp_path):
    player = listener.play(tmp_path / "log", "--rate", 8, "--loop", 2, "--clock")
    listener.listen(lambda: not player.running())
    assert player.wait() == 0, player.log()
    clouds = [m for m in recorded() if isinstance(m, RecordedCloud)]
    joints = len(recorded()) - len(clouds)
    assert len(listener.clouds) == 48 and listener.clouds[:24] == listener.clouds[24:]
    assert listener.clouds[:24] == sorted(listener.clouds[:24])
    assert len(listener.joints) == 2 * joints
    assert f"published 48 on /rig/points, {2 * joints} on" in player.log()
    steps = [after - before for before, after in itertools.pairwise(listener.clock)]
    assert sum(step < 0 for step in steps) == 1  # as each round begins anew
    first_ns, last_ns = recorded()[0].log_ns, recorded()[-1].log_ns
    assert min(listener.clock) == first_ns
    assert 0 <= last_ns - max(listener.clock) < 20_000_000


class Stopwatch:
    """The player's `time`: it goes on while the player sleeps, and else not."""

    def __init__(self):
        self.now_s = 7.0

    def monotonic(self):
        return self.now_s

    def sleep(self, duration_s):
        self.now_s += duration_s


@pytest.mark.parametrize("clock", [False, True])
def test_a_player_keeps_the_recordings_time(ros, monkeypatch, clock):
    watch, published = Stopwatch(), []
    monkeypatch.setattr("vflatten_ros.player.time", watch)
    publisher = SimpleNamespace(publish=lambda message: published.append((watch.now_s, message)))
    node = SimpleNamespace(create_publisher=lambda kind, topic, qos: publisher)
    recording = open_recording(RECORDING)
    Player(node, recording, best_effort=False, clock=clock).play(recorded(), 8.0)
    times_s = [now_s for now_s, message in published if not isinstance(message, Clock)]
    expected_s = [7.0 + (m.log_ns - recorded()[0].log_ns) * 1e-9 / 8.0 for m in recorded()]
    assert times_s == pytest.approx(expected_s, abs=1e-9)
    of_clock = [(now_s, message) for now_s, message in published if isinstance(message, Clock)]
    assert bool(of_clock) == clock
    for now_s, message in of_clock:
        since_ns = nanoseconds(message.clock) - recorded()[0].log_ns
        assert since_ns * 1e-9 / 8.0 == pytest.approx(now_s - 7.0, abs=1e-6)


def test_a_player_that_is_interrupted_says_so_by_its_exit_code(listener, tmp_path):
    player = listener.play(tmp_path / "log", "--rate", 4, "--loop")
    listener.listen(lambda: listener.clouds)
    assert player.stop(signal.SIGINT) == 130
    assert not listener.clock
    assert "Traceback" not in player.log()


def test_a_rate_that_is_no_number_is_wrong_usage(tmp_path):
    player = Process(["-m", "vflatten_ros.player", "x", "--rate", "x"], tmp_path / "log")
    assert player.wait() == 2
    assert "--rate: expected a number above 0, got x" in player.log()


def test_a_recording_whose_messages_cannot_be_read_ends_with_one_line(tmp_path):
    message = Message(1, "/points", CLOUD_TYPE, zstandard.ZstdCompressor().compress(bytes(99)))
    bag = write_bag(tmp_path / "bag", [[message, joints(2, 0.0)]])
    command = ["-m", "vflatten_ros.player", str(bag), "--quiet", "--wait", "0"]
    player = Process(command, tmp_path / "log")
    assert player.wait() == 1
    (line,) = player.log().splitlines()
    assert line.startswith("vflatten play: ") and "compressed one by one" in line


def test_a_recording_that_is_not_there_ends_with_one_line(tmp_path):
    player = Process(["-m", "vflatten_ros.player", str(tmp_path / "none")], tmp_path / "log")
    assert player.wait() == 1
    (line,) = player.log().splitlines()
    assert line.startswith("vflatten play: ") and "none" in line
