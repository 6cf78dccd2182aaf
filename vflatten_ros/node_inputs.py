"""Subscriptions of the node, and the warnings when nothing, or nothing usable, comes in."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from sensor_msgs.msg import JointState, PointCloud2

from vflatten_ros.node_log import Log
from vflatten_ros.node_outputs import OK, WARN, Status
from vflatten_ros.parameters import CloudInput, JointInput

MAX_PUBLISHERS = 4
TYPES = {"clouds": "sensor_msgs/msg/PointCloud2", "joint_states": "sensor_msgs/msg/JointState"}


class Numbers:
    """Gaps in the numbers that publishers give their messages; whose they are, rclpy hides."""

    def __init__(self) -> None:
        self._last: list[int] = []  # of each publisher heard, the most recent first

    def missing_before(self, number: int) -> int:
        """How many messages are missing before this one; none before a publisher's first."""
        before = max((last for last in self._last if last < number), default=None)
        if before is not None:
            self._last.remove(before)
        self._last = [number, *self._last[: MAX_PUBLISHERS - 1]]
        return 0 if before is None else number - before - 1


@dataclass
class Traffic:
    """What has happened on one topic."""

    received: int = 0
    lost: int = 0  # gaps in the publisher's numbers
    numbers: Numbers = field(default_factory=lambda: Numbers())
    last_s: float = 0.0  # monotonic
    incompatible: str = ""  # QoS policy that keeps a publisher from us
    quiet: bool = False


class Inputs:
    """The two subscriptions; they exist while the node is active."""

    def __init__(
        self,
        node: Node,
        log: Log,
        on_cloud: Callable[[PointCloud2], None],
        on_joints: Callable[[JointState], None],
    ) -> None:
        self._node, self._log = node, log
        self._callbacks = {"clouds": on_cloud, "joint_states": on_joints}
        self._subscriptions: dict[str, Any] = {}
        self.traffic = {"clouds": Traffic(), "joint_states": Traffic()}

    def open(self, clouds: CloudInput, joints: JointInput) -> None:
        """Subscribe."""
        for name, kind, options in (
            ("clouds", PointCloud2, clouds),
            ("joint_states", JointState, joints),
        ):
            self.traffic[name] = Traffic(last_s=time.monotonic())
            self._subscriptions[name] = self._node.create_subscription(
                kind,
                options.topic,
                self._counted(name),
                _qos(options),
                event_callbacks=SubscriptionEventCallbacks(
                    incompatible_qos=self._on_incompatible(name)
                ),
            )

    def close(self) -> None:
        """Unsubscribe."""
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def topic(self, name: str) -> str:
        """Topic of "clouds" or "joint_states"; while not subscribed, that name."""
        subscription = self._subscriptions.get(name)
        return str(subscription.topic_name) if subscription is not None else name

    def take_joint_states(self) -> None:
        """Take every joint state that has come, now.

        rclpy's executor takes one message of each topic in turn: behind a few clouds, hundreds of
        joint states would wait until the clouds have no patience left, or push one another out.
        """
        subscription = self._subscriptions.get("joint_states")
        if subscription is None:
            return
        callback = self._counted("joint_states")
        with subscription.handle:
            taken = subscription.handle.take_message(JointState, False)
            while taken is not None:
                callback(*taken)
                taken = subscription.handle.take_message(JointState, False)

    def check_quiet(self, limit_s: float) -> None:
        """Warn of topics on which nothing has come for long; once for each time."""
        for name, subscription in self._subscriptions.items():
            traffic = self.traffic[name]
            silence = time.monotonic() - traffic.last_s
            if silence <= limit_s:
                continue
            if wrong := self._wrong_type(name, subscription.topic_name):
                # once a minute: such a publisher may come after the first warning
                self._log.warning(wrong, cause=f"type of {name}")
            elif not traffic.quiet:
                line = self._quiet_line(name, subscription.topic_name, silence)
                self._log.warning(line, cause=f"no {name} on {subscription.topic_name}")
            traffic.quiet = True

    def statuses(self, limit_s: float) -> list[Status]:
        """Diagnostics of each topic."""
        return [
            self._status(name, subscription.topic_name, limit_s)
            for name, subscription in self._subscriptions.items()
        ]

    def _status(self, name: str, topic: str, limit_s: float) -> Status:
        traffic = self.traffic[name]
        silence = time.monotonic() - traffic.last_s
        publishers = self._node.count_publishers(topic)
        values = {
            "topic": topic,
            "publishers": publishers,
            "received": traffic.received,
            "lost in transport": traffic.lost,
            "seconds since the last": f"{silence:.1f}",
        }
        part = name.replace("_", " ")
        if silence > limit_s and (wrong := self._wrong_type(name, topic)):
            return WARN, part, wrong, values
        if traffic.incompatible and silence > limit_s:
            return WARN, part, f"a publisher's QoS does not match ({traffic.incompatible})", values
        if silence > limit_s:
            return WARN, part, f"nothing for {silence:.0f} s, {publishers} publishers", values
        return OK, part, "receiving" if traffic.received else "waiting", values

    def _wrong_type(self, name: str, topic: str) -> str:
        """That publishers of a topic send something else, and nobody what is expected; else ""."""
        publishers = self._node.get_publishers_info_by_topic(topic)
        types = sorted({publisher.topic_type for publisher in publishers})
        if not types or TYPES[name] in types:
            return ""
        return (
            f"{topic} is published as {', '.join(types)}, expected {TYPES[name]}; "
            f"set {name}.topic, or remap"
        )

    def _quiet_line(self, name: str, topic: str, silence: float) -> str:
        what = "cloud" if name == "clouds" else "joint state"
        publishers = self._node.count_publishers(topic)
        if publishers == 0:
            remedy = f"nobody publishes it; start the driver, remap, or set {name}.topic"
        elif self.traffic[name].incompatible:
            remedy = _qos_remedy(name, self.traffic[name].incompatible)
        else:
            remedy = (
                f"{publishers} publish it; if they do send, large clouds may be lost in transport: "
                "see docs/node.md, DDS"
            )
        return f"no {what} on {topic} for {silence:.0f} s: {remedy}"

    def _counted(self, name: str) -> Callable[[Any, Any], None]:
        callback = self._callbacks[name]

        def take(message: Any, info: Any) -> None:
            traffic = self.traffic[name]
            self._count_lost(name, int(info.get("publication_sequence_number") or 0))
            traffic.received += 1
            traffic.last_s = time.monotonic()
            if traffic.quiet:
                traffic.quiet = False
                self._log.info(f"{name.replace('_', ' ')} come again", cause=f"{name} again")
            callback(message)

        return take

    def _on_incompatible(self, name: str) -> Callable[[Any], None]:
        def note(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind)
            self.traffic[name].incompatible = policy
            remedy = _qos_remedy(name, policy)
            text = f"a publisher of {self.topic(name)} cannot reach this node: {remedy}"
            self._log.warning(text, cause=f"QoS of {name}")

        return note

    def _count_lost(self, name: str, number: int) -> None:
        missing = self.traffic[name].numbers.missing_before(number)
        if missing and name in self._subscriptions:
            self.traffic[name].lost += missing
            topic = self._subscriptions[name].topic_name
            self._log.warning(
                f"{self.traffic[name].lost} messages of {topic} lost "
                f"on the way since the start; raise {name}.depth or see docs/node.md, DDS",
                cause=f"lost {name}",
            )


def _qos_remedy(name: str, policy: str) -> str:
    option = "durability" if "DURABILITY" in policy.upper() else "reliability"
    other = "volatile" if option == "durability" else "best_effort"
    remedy = f"set {name}.{option} to {other}, or change the publisher"
    return f"its QoS does not match ({policy}); {remedy}"


def _qos(options: CloudInput | JointInput) -> QoSProfile:
    return QoSProfile(
        depth=options.depth,
        reliability=ReliabilityPolicy[options.reliability.upper()],
        durability=DurabilityPolicy[options.durability.upper()],
    )
