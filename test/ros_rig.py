"""A rig for tests: the node and the player as processes, and a planner in this one."""

from __future__ import annotations

import functools
import itertools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from running import children_of
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from vflatten_ros.action import Flatten

from vflatten_ros import srv
from vflatten_ros.bag import open_recording
from vflatten_ros.player import DISCOVERY_S, Player, rounds

ROOT = Path(__file__).parents[1]
RECORDING = ROOT / "bags" / "LS1_1"
CLOUDS, JOINTS = "/rig/points", "/gripper/joint_states"  # of the recording
CALIBRATION = RECORDING / "calibration.yaml"
QUICK = [str(Path(__file__).parent / "ros" / "quick_node.py")]
REAL = [str(ROOT / "scripts" / "vflatten"), "node"]  # as users start it
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LIMIT_S = 60.0  # for what should take moments, on a machine that is busy
_numbers = itertools.count(1)

SERVICES = {
    "state": srv.GetState,
    "list_views": srv.ListViews,
    "select_views": srv.SelectViews,
    "clear_views": srv.ClearViews,
    "add_correspondences": srv.AddCorrespondences,
    "list_correspondences": srv.ListCorrespondences,
    "clear_correspondences": srv.ClearCorrespondences,
    "locate_landmark": srv.LocateLandmark,
    "flatten": Trigger,
    "new_item": Trigger,
    "clear": Trigger,
    "change_state": ChangeState,
    "set_parameters": SetParameters,
    "get_parameters": GetParameters,
    "describe_parameters": DescribeParameters,
}


@functools.cache
def recorded():
    """The messages of the recording."""
    return list(next(iter(rounds(open_recording(RECORDING), 2))))


def unused_namespace():
    """A namespace for one node: those that were killed stay visible for a while."""
    return f"/rig{next(_numbers)}"


class Process:
    """A process of ours with its log; killed at the end whatever happens."""

    def __init__(self, command, log):
        self.log_path = log
        with log.open("ab") as stream:
            self._process = subprocess.Popen(
                [sys.executable, *command],
                stdout=stream,
                stderr=subprocess.STDOUT,
                cwd=ROOT,
                env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]])},
            )

    @property
    def pid(self):
        return self._process.pid

    def log(self):
        return self.log_path.read_text(encoding="utf-8", errors="replace")

    def running(self):
        return self._process.poll() is None

    def wait(self, limit_s=LIMIT_S):
        return self._process.wait(limit_s)

    def stop(self, how=signal.SIGINT):
        """End it; the exit code."""
        if self.running():
            self._process.send_signal(how)
        return self.wait()

    def kill(self):
        self._process.kill()
        self.wait()

    def children(self):
        """Processes that it has started."""
        return children_of(self.pid, b"spawn_main")

    def helpers(self):
        """Processes that its flattening process has started."""
        (worker,) = self.children()
        return children_of(worker, b"vflatten_ros.helper")


class Rig:
    """A node's process in a namespace of its own, and everything a planner calls."""

    def __init__(self, folder, kind=QUICK, arguments=(), wait=True):
        self.namespace = unused_namespace()
        self._folder, self._kind, self._arguments = folder, kind, list(arguments)
        self.planner = rclpy.create_node("planner", namespace=self.namespace)
        self._clients = {
            name: self.planner.create_client(kind, f"vflatten/{name}")
            for name, kind in SERVICES.items()
        }
        self._action = ActionClient(self.planner, Flatten, "vflatten/flatten")
        self.turntable = Player(self.planner, open_recording(RECORDING), False, clock=False)
        self._processes = []
        self.node = self.start(wait)

    def start(self, wait=True):
        """Start the node, again if it was killed."""
        given = self._arguments
        at = given.index("--ros-args") if "--ros-args" in given else len(given)
        ros = ["--ros-args", "-r", f"__ns:={self.namespace}", *given[at + 1 :]]
        log = self._folder / f"node{self.namespace.strip('/')}.log"
        self.node = Process([*self._kind, *given[:at], *ros], log)
        self._processes.append(self.node)
        self._connected = False
        if wait:
            self.until(lambda: self.lifecycle_state() == 3, "active")
        return self.node

    def turn(self, rate=12, keep=lambda message: True):
        """Publish the recording from this process: no start-up, no discovery."""
        self.connect()
        self.turntable.play(filter(keep, recorded()), rate)

    def connect(self):
        """Wait until the node hears what this process publishes."""
        if not self._connected:
            self.until(self.turntable.has_subscribers, "the node's subscriptions")
            time.sleep(DISCOVERY_S)
            self._connected = True

    def reconnect(self):
        """The node has new subscriptions."""
        self._connected = False
        self.connect()

    def publish(self, message):
        """Publish a cloud or a joint state."""
        self.connect()
        self.turntable.publish(CLOUDS if isinstance(message, PointCloud2) else JOINTS, message)

    def play(self, *options, recording=RECORDING, wait=True):
        """Play a recording to this node."""
        log = self._folder / f"player{next(_numbers)}.log"
        command = ["-m", "vflatten_ros.player", str(recording), *map(str, options)]
        player = Process([*command, "--ros-args", "-r", f"__ns:={self.namespace}"], log)
        self._processes.append(player)
        if wait:
            assert player.wait() == 0, player.log()
        return player

    def close(self):
        for process in self._processes:
            if process.running():
                process.kill()
        self.planner.destroy_node()

    # ---- waiting

    def until(self, condition, what="that", limit_s=LIMIT_S):
        """Wait for a condition; its value."""
        end = time.monotonic() + limit_s
        while True:
            value = condition()
            if value:
                return value
            assert time.monotonic() < end, f"{what} did not come; log:\n{self.node.log()[-3000:]}"
            rclpy.spin_once(self.planner, timeout_sec=0.05)

    def result_of(self, future, limit_s=LIMIT_S):
        self.until(future.done, "an answer", limit_s)
        return future.result()

    # ---- requests

    def ask(self, service, **fields):
        """One service call; asked again where the answer is lost while the node is discovered."""
        client = self._clients[service]
        self.until(client.service_is_ready, f"service {service}")
        request = client.srv_type.Request(**fields)
        again = service in ("state", "get_parameters", "new_item")
        future = client.call_async(request)
        if again:
            rclpy.spin_until_future_complete(self.planner, future, timeout_sec=5.0)
            if not future.done():
                future = client.call_async(request)
        return self.result_of(future)

    def lifecycle_state(self):
        return self.ask("state").lifecycle_state

    def buffer(self):
        return self.ask("state").buffer

    def drops(self):
        buffer = self.buffer()
        return dict(zip(buffer.drop_reasons, buffer.drop_counts, strict=True))

    def set_parameter(self, name, value):
        message = Parameter(name, value=value).to_parameter_msg()
        return self.ask("set_parameters", parameters=[message]).results[0]

    def diagnostics(self, node="vflatten"):
        """Values of the next diagnostics of this node, by part."""
        name = f"{self.namespace}/{node}"
        found = {}

        def keep(message):
            for status in message.status:
                if status.hardware_id == name:
                    values = {value.key: value.value for value in status.values}
                    of, part = status.name.split(": ")
                    assert of == name.lstrip("/")  # two rigs share /diagnostics
                    found[part] = values | {"": status.message}

        node = self.planner
        subscription = node.create_subscription(DiagnosticArray, "/diagnostics", keep, 10)
        self.until(lambda: "flattening" in found, "diagnostics")
        node.destroy_subscription(subscription)
        return found

    def send_goal(self, on_feedback=None, **goal):
        self.until(self._action.server_is_ready, "the action")
        handle = self.result_of(self._action.send_goal_async(Flatten.Goal(**goal), on_feedback))
        assert handle.accepted
        return handle

    def flatten(self, **goal):
        """The action's whole answer: status and result."""
        return self.result_of(self.send_goal(**goal).get_result_async())

    # ---- checks

    def check_accounts(self):
        """Every cloud is a view, waits, or is counted under a reason."""
        b = self.buffer()
        assert b.clouds_received == len(b.views) + b.clouds_waiting + sum(b.drop_counts)
        return b

    def serves_a_good_rotation(self):
        """Turn a new item: all clouds become views and are flattened."""
        for rate in (12, 4):  # slower if a busy machine lost messages on the way: the node says so
            before = len(self.node.log())
            self.ask("new_item")
            self.turn(rate)
            self.until(
                lambda since=before: (
                    self.complete() or "lost on the way" in self.node.log()[since:]
                ),
                "24 views",
            )
            if self.complete():
                break
        buffer = self.until(self.complete, "24 views")
        assert [view.id for view in buffer.views] == list(range(24))
        assert not buffer.drop_counts
        answer = self.flatten()
        assert answer.result.status.code == 0, answer.result.status.message
        assert list(answer.result.flattened.view_ids) == list(range(24))

    def settled(self, clouds):
        """The buffer once so many clouds have come and none waits, else None."""
        buffer = self.buffer()
        return buffer if buffer.clouds_received >= clouds and not buffer.clouds_waiting else None

    def complete(self):
        """The buffer once the rotation is complete, else None."""
        buffer = self.buffer()
        done = buffer.state == 2 and buffer.clouds_received >= 24 and not buffer.clouds_waiting
        return buffer if done else None
