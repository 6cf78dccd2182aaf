"""Recordings of clouds and joint states: rosbag2 folders and bare mcap files, without ROS."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message, Schema
from mcap_ros2.decoder import DecoderFactory

from vflatten_ros.core.buffer import CloudDropped, Event, ViewAdded, ViewBuffer, ViewReplaced
from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import InvalidCloud, InvalidRecording
from vflatten_ros.core.pointcloud import PointField, decode_cloud
from vflatten_ros.core.values import Calibration, Cloud, Progress, View, no_progress
from vflatten_ros.mcap_files import (
    BROKEN,
    ZSTD,
    Topic,
    first_log_ns,
    one_line,
    recorded_messages,
    recorded_topics,
    recording_files,
)

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
JOINT_TYPE = "sensor_msgs/msg/JointState"


@dataclass(frozen=True, eq=False)
class RecordedCloud:
    """One PointCloud2 of a recording."""

    log_ns: int
    topic: str
    cdr: bytes  # as recorded
    message: Any  # with the fields of sensor_msgs/PointCloud2; None: cannot be read

    def decode(self) -> Cloud:
        """The points; raises InvalidCloud."""
        if self.message is None:
            raise InvalidCloud(f"message of {len(self.cdr)} bytes ends early")
        return cloud_from(self.message)


@dataclass(frozen=True, eq=False)
class RecordedJoints:
    """One JointState of a recording."""

    log_ns: int
    topic: str
    cdr: bytes
    stamp_ns: int
    names: tuple[str, ...]
    positions: tuple[float, ...]


@dataclass(eq=False)
class Recording:
    """An opened recording; what went wrong while reading gathers in `warnings`."""

    path: Path
    files: tuple[Path, ...]
    cloud_topic: str
    joint_topic: str
    guessed: tuple[str, ...]  # for each topic that was not given: which was taken
    clouds: int | None  # number of clouds, None if not known beforehand
    topics: tuple[Topic, ...]
    warnings: list[str] = field(default_factory=list)

    def messages(self) -> Iterator[RecordedCloud | RecordedJoints]:
        """Clouds and joint states in log order, read as they are asked for.

        Files may overlap in time; each is opened once its first message is due. One that ends
        early or is damaged gives what comes before, and a warning.
        """
        waiting = sorted((first_log_ns(path), k, path) for k, path in enumerate(self.files))
        due: list[tuple[int, int, RecordedCloud | RecordedJoints, Iterator[Any]]] = []
        while waiting or due:
            while waiting and (not due or waiting[0][0] <= due[0][0]):
                _, k, path = waiting.pop(0)
                _put_next(due, k, self._messages_of(path))
            if due:
                _, k, message, rest = heapq.heappop(due)
                yield message
                _put_next(due, k, rest)

    def _messages_of(self, path: Path) -> Iterator[RecordedCloud | RecordedJoints]:
        decoders: dict[int, Any] = {}
        factory = DecoderFactory()
        records = recorded_messages(path, (self.cloud_topic, self.joint_topic))
        count = unreadable = 0
        while True:
            try:
                schema, channel, message = next(records)
            except StopIteration:
                break
            except BROKEN as error:
                self.warnings.append(
                    f"{path}: ends early or is damaged ({one_line(error)}); "
                    f"used the {count} messages before; record it again or try 'mcap recover'"
                )
                break
            count += 1
            if message.data[:4] == ZSTD:
                raise InvalidRecording(
                    f"{path}: messages are compressed one by one; write the bag anew, "
                    "uncompressed, with 'ros2 bag convert'"
                )
            if channel.id not in decoders:
                decoders[channel.id] = _decoder(factory, schema, channel, path)
            try:
                decoded = decoders[channel.id](message.data)
            except BROKEN:
                decoded = None
            if channel.topic == self.cloud_topic:
                yield RecordedCloud(message.log_time, channel.topic, message.data, decoded)
            elif decoded is not None:
                yield _recorded_joints(channel.topic, message, decoded)
            else:
                unreadable += 1
        if unreadable:
            self.warnings.append(f"{path}: left out {unreadable} joint states that end early")


def _put_next(heap: list[Any], number: int, messages: Iterator[Any]) -> None:
    """Put the next message of a file, if there is one, into the heap of those that are due."""
    for message in messages:
        heapq.heappush(heap, (message.log_ns, number, message, messages))
        return


def open_recording(
    path: str | Path, cloud_topic: str | None = None, joint_topic: str | None = None
) -> Recording:
    """Open a rosbag2 folder or a bare .mcap file.

    Parameters
    ----------
    path : path
        Folder with metadata.yaml and one or more .mcap files, or one such file.
    cloud_topic, joint_topic : str, optional
        Needed where there are several topics of the type.

    Raises
    ------
    InvalidRecording
        Says what is missing, where, and what to try.
    """
    path = Path(path)
    files = recording_files(path)
    topics = recorded_topics(files)
    guessed: list[str] = []
    cloud = _choose(path, topics, CLOUD_TYPE, cloud_topic, "--cloud-topic", guessed)
    joints = _choose(path, topics, JOINT_TYPE, joint_topic, "--joint-topic", guessed)
    return Recording(path, files, cloud.name, joints.name, tuple(guessed), cloud.messages, topics)


def gather_views(
    recording: Recording,
    calibration: Calibration,
    config: Config,
    progress: Progress = no_progress,
    on_view: Callable[[View], None] = lambda view: None,
    on_drop: Callable[[CloudDropped], None] = lambda event: None,
) -> ViewBuffer:
    """Run a whole recording through a view buffer.

    Parameters
    ----------
    recording : Recording
    calibration : Calibration
    config : Config
    progress : Progress
    on_view : callable
        Told every view as it comes, those included that give way to better ones later.
    on_drop : callable
        Told every cloud that gives none, and every view that gives way, with the reason.

    Raises
    ------
    InvalidRecording
        The named joint is missing, or no cloud gave a view; says why.
    """
    buffer = ViewBuffer(calibration, config)
    clouds = 0
    for message in recording.messages():
        _tell(buffer, _take(buffer, message), on_view, on_drop)
        if isinstance(message, RecordedCloud):
            clouds += 1
            progress("views", min(clouds / recording.clouds, 1.0) if recording.clouds else 0.0)
    _tell(buffer, buffer.finish(), on_view, on_drop)
    _check_views(recording, calibration, buffer)
    progress("views", 1.0)
    return buffer


def _take(buffer: ViewBuffer, message: RecordedCloud | RecordedJoints) -> tuple[Event, ...]:
    at = message.log_ns
    if isinstance(message, RecordedJoints):
        return buffer.add_joint(message.stamp_ns, message.names, message.positions, at)
    try:
        return buffer.add_cloud(message.decode(), at)
    except InvalidCloud as error:
        return buffer.reject_cloud(str(error), at)


def _tell(
    buffer: ViewBuffer,
    events: Sequence[Event],
    on_view: Callable[[View], None],
    on_drop: Callable[[CloudDropped], None],
) -> None:
    for event in events:
        if isinstance(event, CloudDropped):
            on_drop(event)
    new = {e.view_id for e in events if isinstance(e, ViewAdded | ViewReplaced)}
    for view in buffer.views() if new else ():
        if view.view_id in new:
            on_view(view)


def cloud_from(message: Any) -> Cloud:
    """Points of a sensor_msgs/PointCloud2, of whatever library; raises InvalidCloud."""
    fields = [PointField(f.name, f.offset, f.datatype, f.count) for f in message.fields]
    return decode_cloud(
        stamp_ns=stamp_ns(message.header.stamp),
        frame_id=message.header.frame_id,
        height=message.height,
        width=message.width,
        fields=fields,
        is_bigendian=message.is_bigendian,
        point_step=message.point_step,
        row_step=message.row_step,
        data=message.data,
    )


def stamp_ns(stamp: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _recorded_joints(topic: str, message: Message, decoded: Any) -> RecordedJoints:
    stamp = stamp_ns(decoded.header.stamp)
    names, positions = tuple(decoded.name), tuple(decoded.position)
    return RecordedJoints(message.log_time, topic, message.data, stamp, names, positions)


def _choose(
    path: Path,
    topics: tuple[Topic, ...],
    kind: str,
    wanted: str | None,
    option: str,
    guessed: list[str],
) -> Topic:
    """The topic asked for, or the only one of its type that has messages."""
    known = ", ".join(f"{t.name} ({t.kind})" for t in topics) or "none"
    if wanted is not None:
        chosen = next((t for t in topics if t.name == wanted), None)
        if chosen is None:
            raise InvalidRecording(f"{path}: no topic {wanted!r}; topics: {known}")
        if chosen.kind != kind:
            raise InvalidRecording(f"{path}: topic {wanted!r} is {chosen.kind}, expected {kind}")
        return chosen
    fitting = [t for t in topics if t.kind == kind and t.messages != 0]
    if not fitting:
        raise InvalidRecording(
            f"{path}: no messages of type {kind}; topics: {known}; record that topic as well"
        )
    if len(fitting) > 1:
        names = ", ".join(t.name for t in fitting)
        raise InvalidRecording(f"{path}: several topics of type {kind} ({names}); give {option}")
    guessed.append(f"{option[2:]} {fitting[0].name} (the only one of type {kind})")
    return fitting[0]


def _decoder(factory: DecoderFactory, schema: Schema | None, channel: Channel, path: Path) -> Any:
    decoder = factory.decoder_for(channel.message_encoding, schema)
    if decoder is None:
        raise InvalidRecording(
            f"{path}: {channel.topic} is encoded as {channel.message_encoding!r} with schema "
            f"{schema.encoding if schema else 'none'!r}; expected cdr with ros2msg"
        )
    return decoder


def _check_views(recording: Recording, calibration: Calibration, buffer: ViewBuffer) -> None:
    state = buffer.state()
    where = f"{recording.path}"
    if not state.clouds_received and state.item == 1:
        raise InvalidRecording(f"{where}: no clouds on {recording.cloud_topic}{_also(recording)}")
    if not state.joint_states and calibration.joint not in state.joints_seen:
        names = ", ".join(state.joints_seen) or "none"
        raise InvalidRecording(
            f"{where}: no joint {calibration.joint!r} on {recording.joint_topic} "
            f"(joints: {names}); correct 'joint' in the calibration{_also(recording)}"
        )
    if not state.view_ids:
        drops = ", ".join(f"{reason} {count}" for reason, count in state.drops.items())
        raise InvalidRecording(
            f"{where}: none of {state.clouds_received} clouds gave a view ({drops}); check that "
            f"joint states cover the clouds' stamps, and the calibration{_also(recording)}"
        )


def _also(recording: Recording) -> str:
    return "; " + "; ".join(recording.warnings) if recording.warnings else ""
