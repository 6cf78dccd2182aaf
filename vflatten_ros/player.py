"""`vflatten play`: publishes a recording's clouds and joint states, for those without rosbag2."""

from __future__ import annotations

import argparse
import itertools
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, PointCloud2

from vflatten_ros import transport
from vflatten_ros.bag import RecordedCloud, Recording, open_recording
from vflatten_ros.core.errors import VFlattenError
from vflatten_ros.messages import fill, time_fields

CLOCK_PERIOD_NS = 10_000_000
DISCOVERY_S = 0.5  # a publisher sees its subscriber before the subscriber sees the publisher
CACHED_BYTES = 512e6  # a looped recording up to this size is read once


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    options = argparse.ArgumentParser(
        prog="vflatten play",
        description="Publish a recording's clouds and joint states over ROS, in its own time.",
        epilog="ROS arguments (remapping, namespace) follow after --ros-args.",
    )
    options.add_argument("recording", help="rosbag2 folder or .mcap file")
    options.add_argument("--rate", type=_positive, default=1.0, help="times as fast (default 1)")
    options.add_argument(
        "--loop",
        type=int,
        nargs="?",
        const=0,
        default=1,
        metavar="N",
        help="N times; no N: for ever",
    )
    options.add_argument(
        "--clock", action="store_true", help="also publish /clock, for use_sim_time"
    )
    options.add_argument("--cloud-topic", help="topic of the clouds, where there are several")
    options.add_argument("--joint-topic", help="topic of the joint states, where there are several")
    options.add_argument(
        "--best-effort", action="store_true", help="publish best effort, as most cameras do"
    )
    options.add_argument(
        "--wait", type=float, default=10.0, metavar="S",
        help="wait so long for subscribers of both topics before the start, s (default 10)",
    )  # fmt: skip
    options.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return options


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
    return value


class Player:
    """Publishers of one recording."""

    def __init__(self, node: Node, recording: Recording, best_effort: bool, clock: bool) -> None:
        reliability = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
        self._publishers = {
            # relative names: a namespace given to the player moves them
            recording.cloud_topic: node.create_publisher(
                PointCloud2,
                recording.cloud_topic.lstrip("/"),
                QoSProfile(depth=20, reliability=reliability),
            ),
            recording.joint_topic: node.create_publisher(
                JointState,
                recording.joint_topic.lstrip("/"),
                QoSProfile(depth=500, reliability=reliability),
            ),
        }
        self._clock = node.create_publisher(Clock, "/clock", 10) if clock else None
        self._clock_ns = -CLOCK_PERIOD_NS
        self.published = dict.fromkeys(self._publishers, 0)

    def has_subscribers(self) -> bool:
        """Whether somebody listens to both topics."""
        return all(p.get_subscription_count() for p in self._publishers.values())

    def wait_for_subscribers(self, limit_s: float) -> bool:
        """Until both topics have a subscriber; False if the time was over before."""
        end = time.monotonic() + limit_s
        while rclpy.ok() and time.monotonic() < end:
            if self.has_subscribers():
                time.sleep(DISCOVERY_S)
                return True
            time.sleep(0.02)
        return False

    def publish(self, topic: str, message: Any) -> None:
        """Publish one message, or its serialized bytes, on a topic of the recording."""
        self._publishers[topic].publish(message)

    def play(self, messages: Iterable[Any], rate: float) -> None:
        """Publish messages at their log times, from now on."""
        start_s, first_ns = time.monotonic(), None
        for message in messages:
            first_ns = message.log_ns if first_ns is None else first_ns
            self._sleep_until(start_s, first_ns, message.log_ns, rate)
            if not rclpy.ok():
                return
            # the recorded bytes, not decoded and encoded again
            self.publish(message.topic, message.cdr)
            self.published[message.topic] += 1

    def _sleep_until(self, start_s: float, first_ns: int, log_ns: int, rate: float) -> None:
        while rclpy.ok():
            left_s = start_s + (log_ns - first_ns) * 1e-9 / rate - time.monotonic()
            self._publish_clock(log_ns - int(max(left_s, 0.0) * rate * 1e9))
            if left_s <= 0.0:
                return
            time.sleep(min(left_s, 0.1 if self._clock is None else CLOCK_PERIOD_NS * 1e-9))

    def _publish_clock(self, now_ns: int) -> None:
        if self._clock is not None and abs(now_ns - self._clock_ns) >= CLOCK_PERIOD_NS:
            self._clock.publish(fill(Clock(), {"clock": time_fields(max(now_ns, 0))}))
            self._clock_ns = now_ns

    def drain(self) -> None:
        """Let reliable subscribers get the last messages before the publishers go."""
        for publisher in self._publishers.values():
            if publisher.get_subscription_count():
                publisher.wait_for_all_acked(Duration(seconds=5))
        time.sleep(0.2)  # best effort has no acknowledgement


def rounds(recording: Recording, loops: int) -> Iterator[Iterable[Any]]:
    """The messages of each round; a small recording that is looped is read once."""
    if loops == 1:
        yield recording.messages()
        return
    kept = _all_if_small(recording)
    for _ in itertools.count() if loops <= 0 else range(loops):
        yield kept or recording.messages()


def _all_if_small(recording: Recording) -> list[Any]:
    """The messages, none if they are too large to keep."""
    kept: list[Any] = []
    size = 0
    for message in recording.messages():
        size += len(message.cdr)
        if size > CACHED_BYTES:
            return []
        kept.append(_without_decoded(message))
    return kept


def _without_decoded(message: Any) -> Any:
    if isinstance(message, RecordedCloud):
        return RecordedCloud(message.log_ns, message.topic, message.cdr, None)
    return message


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    argv : sequence of str, optional
        Options and ROS arguments; by default those of the command line.

    Returns
    -------
    int
        0 when all was played, 1 where the recording cannot be read, 130 when interrupted.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    at = given.index("--ros-args") if "--ros-args" in given else len(given)
    args = parser().parse_args(given[:at])
    try:
        recording = open_recording(args.recording, args.cloud_topic, args.joint_topic)
    except VFlattenError as error:
        return _fail(str(error))
    transport.use_profile()
    # rclpy's handlers shut the context down from another thread, perhaps while it is published
    try:
        rclpy.init(args=given[at:], signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # of rcl, which parses the arguments
        return _fail(" ".join(str(error).split()))
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as SIGINT
    node = Node("vflatten_player")
    try:
        return _play(node, recording, args)
    except VFlattenError as error:
        return _fail(str(error))
    except KeyboardInterrupt:
        return 130
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)  # it ends already
        node.destroy_node()
        rclpy.try_shutdown()


def _fail(text: str) -> int:
    print(f"vflatten play: {text}", file=sys.stderr)
    return 1


def _play(node: Node, recording: Recording, args: argparse.Namespace) -> int:
    say = (lambda text: None) if args.quiet else (lambda text: print(text, flush=True))
    player = Player(node, recording, args.best_effort, args.clock)
    if not player.wait_for_subscribers(args.wait):
        say(f"no subscriber of both topics after {args.wait:g} s; playing all the same")
    names = ", ".join(player.published)
    say(f"playing {recording.path} at {args.rate:g} times its rate on {names}")
    for messages in rounds(recording, args.loop):
        player.play(messages, args.rate)
        if not rclpy.ok():
            return 130
    player.drain()
    counts = ", ".join(f"{count} on {topic}" for topic, count in player.published.items())
    say(f"published {counts}")
    for warning in recording.warnings:
        print(f"vflatten play: {warning}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
