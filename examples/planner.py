#!/usr/bin/env python3
"""What a task planner does: watch the views come in, give corresponding points, flatten, go on.

    vflatten node --calibration bags/LS1_1/calibration.yaml &
    python3 examples/planner.py bags/LS1_1

Without --no-play it turns the item itself, that is: it plays the recording.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger
from vflatten_ros.action import Flatten
from vflatten_ros.msg import Correspondence, Status, ViewBufferState
from vflatten_ros.srv import AddCorrespondences, GetState, LocateLandmark

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
ATTEMPTS = 5  # where another planner begins a new item between our last view and our goal


class NoViews(RuntimeError):
    """The views were gone, or too few, when they were to be flattened."""


class Planner(Node):
    """The few calls that a planner needs."""

    def __init__(self, vflatten: str = "vflatten") -> None:
        super().__init__("planner")
        self.views = ViewBufferState()
        self._vflatten = vflatten
        # All clients now: an answer to one that the node has not discovered yet is lost.
        self._clients_by_name = {
            name: self.create_client(kind, f"{vflatten}/{name}")
            for name, kind in (
                ("state", GetState),
                ("add_correspondences", AddCorrespondences),
                ("locate_landmark", LocateLandmark),
                ("new_item", Trigger),
            )
        }
        self._flatten = ActionClient(self, Flatten, f"{vflatten}/flatten")
        self.create_subscription(ViewBufferState, f"{vflatten}/views", self._on_views, LATCHED)

    def _on_views(self, message: ViewBufferState) -> None:
        if len(message.views) != len(self.views.views):
            turned = message.angle_covered * 57.3
            print(f"views: {len(message.views)}, {turned:.0f} degrees covered", flush=True)
        self.views = message

    def call(self, name: str, request: Any = None, limit_s: float = 10.0) -> Any:
        """One service call; a node that has gone away must not hang the planner."""
        client = self._clients_by_name[name]
        if not client.wait_for_service(timeout_sec=limit_s):
            raise TimeoutError(f"{name}: the node is not there")
        return self.wait(client.call_async(request or client.srv_type.Request()), limit_s)

    def wait(self, future: Any, limit_s: float) -> Any:
        """The result of a future; raises TimeoutError."""
        end = time.monotonic() + limit_s
        while not future.done() and (left_s := end - time.monotonic()) > 0.0:
            # a little at a time: Ctrl-C is seen between two waits
            rclpy.spin_until_future_complete(self, future, timeout_sec=min(left_s, 0.2))
        if not future.done():
            raise TimeoutError(f"no answer within {limit_s:g} s")
        return future.result()

    def state(self) -> Any:
        """Where the node is; asked again if the first answer is lost."""
        try:
            return self.call("state", limit_s=3.0)
        except TimeoutError:
            return self.call("state")

    def wait_until_active(self, limit_s: float = 20.0) -> None:
        """The node configures and activates itself; that takes a moment."""
        end = time.monotonic() + limit_s
        while self.state().lifecycle_state != 3:
            if time.monotonic() > end:
                raise TimeoutError("the node does not become active; its log says why")
            time.sleep(0.1)

    def gather(self, player: subprocess.Popen[bytes] | None, wanted: int | None) -> None:
        """Until the rotation is over: the item has stopped turning, or enough views are there."""
        while player is not None and player.poll() is None:
            rclpy.spin_once(self, timeout_sec=0.1)
        if player is not None and player.returncode:
            raise RuntimeError(f"the recording was not played (exit code {player.returncode})")
        end = time.monotonic() + 10.0
        while time.monotonic() < end:
            self.views = self.state().buffer
            if not self.views.clouds_waiting and len(self.views.views) >= (wanted or 1):
                return
            time.sleep(0.1)
        raise TimeoutError(f"{len(self.views.views)} views, expected {wanted or 'some'}")

    def add_correspondences(self, protocol: dict[str, Any]) -> None:
        """Points that a person, or a feature matcher, found in two views."""
        first, second = protocol["views"]
        pairs = [
            Correspondence(view_a=first, view_b=second, pixel_a=pair["a"], pixel_b=pair["b"])
            for pair in protocol["pairs"]
        ]
        answer = self.call("add_correspondences", AddCorrespondences.Request(pairs=pairs))
        print(f"corresponding points: {sum(answer.accepted)} of {len(pairs)} accepted")
        for reason in filter(None, answer.reasons):
            print(f"  refused: {reason}")

    def flatten(self, method: str, view_ids: list[int], limit_s: float = 120.0) -> Any:
        """Flatten with feedback; the result."""
        goal = Flatten.Goal(method=method, view_ids=view_ids)
        if not self._flatten.wait_for_server(timeout_sec=10.0):
            raise TimeoutError("flatten: the node is not there")
        handle = self.wait(self._flatten.send_goal_async(goal, self._on_feedback), 10.0)
        answer = self.wait(handle.get_result_async(), limit_s)
        if answer.status != GoalStatus.STATUS_SUCCEEDED:
            status = answer.result.status
            error = NoViews if status.code == Status.NO_VIEWS else RuntimeError
            raise error(f"flatten: {status.message}")
        return answer.result

    def gather_and_flatten(
        self, player: subprocess.Popen[bytes] | None, protocol: dict[str, Any], method: str
    ) -> Any:
        """The result; with the views of the next rotation if those of this one are gone."""
        wanted = max(protocol["views"], default=0) + 1 if "pairs" in protocol else None
        for attempt in range(ATTEMPTS):
            self.gather(player, wanted)
            if "pairs" in protocol:
                self.add_correspondences(protocol)
            try:
                return self.flatten(method, list(protocol["views"]))
            except NoViews as error:
                if player is not None or attempt + 1 == ATTEMPTS:
                    raise
                print(f"{error}; gathering again", flush=True)

    def _on_feedback(self, message: Any) -> None:
        feedback = message.feedback
        print(f"flattening: {feedback.progress:4.0%} {feedback.stage}", flush=True)


def report(planner: Planner, result: Any) -> None:
    """What a planner would act on."""
    estimate = result.estimate
    trusted = "" if estimate.trusted else ", not to be trusted"
    print(f"{estimate.category} (quality {estimate.quality:.2f}{trusted})")
    for size in estimate.measurements:
        print(f"  {size.name}: {size.value * 100:.1f} +- {size.sigma * 100:.1f} cm")
    for text in estimate.notice_texts:
        print(f"  {text}")
    seen = [mark for mark in estimate.landmarks if mark.seen]
    for mark in sorted(seen, key=lambda m: -m.certainty)[:1]:
        place = planner.call("locate_landmark", LocateLandmark.Request(name=mark.name))
        if place.status.code == Status.NO_JOINT_STATE:  # the recording is over: it hangs as it did
            angle = result.flattened.view_angles[-1]
            request = LocateLandmark.Request(name=mark.name, at_angle=True, item_angle=angle)
            place = planner.call("locate_landmark", request)
        if place.status.code == Status.OK:
            p = place.position.point
            print(f"  next grasp: {mark.name} at {p.x:.3f} {p.y:.3f} {p.z:.3f} m (rig frame)")


def save(result: Any, folder: Path) -> None:
    """The serialized messages, for comparison with `vflatten replay --mcap`."""
    from rclpy.serialization import serialize_message

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "flattened_view.cdr").write_bytes(serialize_message(result.flattened))
    (folder / "garment.cdr").write_bytes(serialize_message(result.estimate))


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("recording", type=Path, help="folder with protocol.json, if any")
    options.add_argument("--node", default="vflatten", help="name of the node, with its namespace")
    options.add_argument("--namespace", default="/", help="of the topics that are played")
    options.add_argument("--method", default="", help="default: kita2019 with a protocol.json")
    options.add_argument("--rate", type=float, default=1.0, help="of the recording")
    options.add_argument("--no-play", action="store_true", help="somebody else turns the item")
    options.add_argument("--save", type=Path, metavar="DIR", help="write the result's messages")
    args = options.parse_args()

    if not args.recording.exists():
        print(f"planner: {args.recording}: no such recording; try bags/LS1_1", file=sys.stderr)
        return 1
    protocol_file = args.recording / "protocol.json"
    by_hand = protocol_file.is_file() and args.method in ("", "kita2019")
    protocol = json.loads(protocol_file.read_text()) if by_hand else {"views": []}

    # rclpy's own handlers shut the context down from another thread, in the middle of a call
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    planner = Planner(args.node)
    player = None
    try:
        planner.wait_until_active()
        planner.call("new_item")
        if not args.no_play:
            command = [sys.executable, "-m", "vflatten_ros.player", str(args.recording)]
            command += ["--rate", str(args.rate), "--quiet"]
            player = subprocess.Popen([*command, "--ros-args", "-r", f"__ns:={args.namespace}"])
        method = args.method or ("kita2019" if by_hand else "")
        result = planner.gather_and_flatten(player, protocol, method)
        report(planner, result)
        if args.save:
            save(result, args.save)
        print(planner.call("new_item").message)
    except (TimeoutError, RuntimeError) as error:
        print(f"planner: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    finally:
        if player is not None:
            player.terminate()
        planner.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
