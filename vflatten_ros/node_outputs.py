"""What the node publishes: results that stay for late subscribers, the buffer, diagnostics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from vflatten_ros import displays, messages
from vflatten_ros.core.events import REMEDIES, BufferState, WristStill
from vflatten_ros.goals import Goals
from vflatten_ros.messages import message_class
from vflatten_ros.msg import ViewBufferState
from vflatten_ros.outputs import TYPES
from vflatten_ros.parameters import OutputOptions
from vflatten_ros.session import Session

LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
RESULTS = {name: message_class(kind) for name, kind in TYPES.items()}
FEWEST_CLOUDS = 4  # that a share of them says something
OK, WARN, ERROR = 0, 1, 2  # diagnostic_msgs/DiagnosticStatus
Status = tuple[int, str, str, Mapping[str, Any]]  # level, part, message, values


class Outputs:
    """Publishers of the node."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._results = {
            name: node.create_publisher(kind, f"~/{name}", LATCHED)
            for name, kind in RESULTS.items()
        }
        self._buffer = node.create_publisher(ViewBufferState, "~/views", LATCHED)
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._hardware_id = node.get_fully_qualified_name()

    def publish_result(self, serialized: Mapping[str, bytes], options: OutputOptions) -> None:
        """Publish messages that the worker has serialized."""
        for name, publisher in self._results.items():
            if name in serialized and getattr(options, name, True):
                publisher.publish(serialized[name])

    def publish_buffer(self, state: ViewBufferState) -> None:
        """Publish what has been gathered."""
        self._buffer.publish(state)

    def publish_diagnostics(self, statuses: list[Status]) -> None:
        """Publish one status for every part of the node."""
        name = self._hardware_id.lstrip("/")  # two rigs may share the topic
        rows = [
            (level, f"{name}: {part}", text, self._hardware_id, values)
            for level, part, text, values in statuses
        ]
        stamp = self._node.get_clock().now().nanoseconds
        fields = displays.diagnostic_fields(stamp, rows)
        self._diagnostics.publish(messages.fill(DiagnosticArray(), fields))


def result_message(name: str, serialized: Mapping[str, bytes]) -> Any:
    """A message of the result as an object."""
    return deserialize_message(serialized[name], RESULTS[name])


def buffer_message(session: Session | None) -> ViewBufferState:
    """The state of the buffer; empty before the node was active."""
    if session is None:
        return ViewBufferState()
    fields = messages.view_buffer_state_fields(
        session.buffer.state(),
        session.buffer.views(),
        session.calibration.frame,
        selected=session.selected(),
        correspondences=len(session.pairs),
        enough=session.enough,
    )
    return messages.fill(ViewBufferState(), fields)


def buffer_status(session: Session) -> Status:
    """Diagnostics of the buffer: counts by reason."""
    state = session.buffer.state()
    values = {
        "item": state.item,
        "views": len(state.view_ids),
        "angle covered, deg": f"{state.angle_covered_rad * 57.29578:.0f}",
        "megabytes": f"{state.nbytes / 1e6:.1f}",
        "correspondences": len(session.pairs),
        "clouds received": state.clouds_received,
        "clouds waiting": state.clouds_waiting,
        "clock jumps": state.clock_jumps,
        "joint states without a position": state.joint_faults,
        **{f"dropped: {reason}": count for reason, count in state.drops.items()},
    }
    lost = sum(state.drops.values())
    text = f"{state.stage.name.lower()}, {len(state.view_ids)} views, {lost} clouds dropped"
    only_drops = lost > 0 and not state.view_ids
    troubles = _troubles(state, session.calibration.joint)
    level = WARN if only_drops or troubles else OK
    return level, "buffer", "; ".join([text, *troubles]), values


def still_text(joint: str, still: WristStill) -> str:
    """That the wrist does not turn, and what to look at."""
    return (
        f"wrist joint {joint!r} has moved by {still.moved_rad:.3f} rad while {still.clouds} clouds "
        "came; does the joint in the calibration turn, does the robot rotate?"
    )


def joint_fault_text(joint: str, state: BufferState) -> str:
    """That joint states give no position."""
    return (
        f"{state.joint_faults} states of joint {joint!r} came without a usable position, the "
        f"newest has {state.joint_fault or 'one again'}; check what publishes them"
    )


def _troubles(state: BufferState, joint: str) -> list[str]:
    """What an operator should look at; reasons without a remedy are part of every rotation."""
    troubles = [] if state.still is None else [still_text(joint, state.still)]
    if state.joint_fault:
        troubles.append(joint_fault_text(joint, state))
    reasons = Counter(reason for reason in state.recent if reason in REMEDIES)
    if len(state.recent) >= FEWEST_CLOUDS and 2 * reasons.total() > len(state.recent):
        most = reasons.most_common(1)[0][0]
        troubles.append(
            f"{reasons.total()} of the last {len(state.recent)} clouds dropped, most as {most}: "
            f"{REMEDIES[most]}"
        )
    return troubles


def flattening_status(
    goals: Goals | None,
    finished: int,
    failed: int,
    failing: bool,
    last: str,
    refused: int,
    last_refusal: str,
) -> Status:
    """Diagnostics of the flattening process."""
    if goals is None:
        return OK, "flattening", "not configured", {}
    values = {
        "done": finished,
        "failed": failed,
        "waiting": goals.waiting,
        "process restarts": goals.restarts,
        "last": last,
        "refused": refused,
        "last refusal": last_refusal,
    }
    if not goals.ready:
        return WARN, "flattening", "the process is starting", values
    if goals.busy:
        return OK, "flattening", f"{goals.stage} {goals.fraction:.0%}", values
    if failing:
        return WARN, "flattening", f"the last one failed: {last}", values
    return OK, "flattening", "idle", values
