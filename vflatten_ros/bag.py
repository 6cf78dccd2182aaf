"""Recordings of clouds and joint states: rosbag2 folders and bare mcap files, without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from mcap.reader import SeekingReader
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

from vflatten_ros.core.buffer import ViewBuffer
from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import InvalidCloud, InvalidRecording
from vflatten_ros.core.pointcloud import PointField, decode_cloud
from vflatten_ros.core.values import Calibration, Cloud, Progress, no_progress

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
JOINT_TYPE = "sensor_msgs/msg/JointState"
# A file that ends early or is damaged makes the mcap reader and the decompressors, which differ
# between installations, raise errors with no nearer base in common.
BROKEN = Exception


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


@dataclass(frozen=True)
class Topic:
    """One topic of a recording."""

    name: str
    kind: str
    messages: int | None  # None: the file has no statistics


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

        A file that ends early or is damaged gives what comes before, and a warning.
        """
        for path in self.files:
            yield from self._messages_of(path)

    def _messages_of(self, path: Path) -> Iterator[RecordedCloud | RecordedJoints]:
        decoders: dict[int, Any] = {}
        factory = DecoderFactory()
        records = _records(path, (self.cloud_topic, self.joint_topic))
        count = unreadable = 0
        while True:
            try:
                schema, channel, message = next(records)
            except StopIteration:
                break
            except BROKEN as error:
                self.warnings.append(
                    f"{path}: ends early or is damaged ({_one_line(error)}); "
                    f"used the {count} messages before; record it again or try 'mcap recover'"
                )
                break
            count += 1
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
    files = _files(path)
    topics = _topics(files)
    guessed: list[str] = []
    cloud = _choose(path, topics, CLOUD_TYPE, cloud_topic, "--cloud-topic", guessed)
    joints = _choose(path, topics, JOINT_TYPE, joint_topic, "--joint-topic", guessed)
    return Recording(path, files, cloud.name, joints.name, tuple(guessed), cloud.messages, topics)


def gather_views(
    recording: Recording,
    calibration: Calibration,
    config: Config,
    progress: Progress = no_progress,
) -> ViewBuffer:
    """Run a whole recording through a view buffer.

    Raises
    ------
    InvalidRecording
        The named joint is missing, or no cloud gave a view; says why.
    """
    buffer = ViewBuffer(calibration, config)
    clouds = 0
    for message in recording.messages():
        if isinstance(message, RecordedJoints):
            buffer.add_joint(message.stamp_ns, message.names, message.positions, message.log_ns)
            continue
        try:
            cloud = message.decode()
        except InvalidCloud as error:
            buffer.reject_cloud(str(error), message.log_ns)
        else:
            buffer.add_cloud(cloud, message.log_ns)
        clouds += 1
        progress("views", min(clouds / recording.clouds, 1.0) if recording.clouds else 0.0)
    buffer.finish()
    _check_views(recording, calibration, buffer)
    progress("views", 1.0)
    return buffer


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


def _files(path: Path) -> tuple[Path, ...]:
    if path.is_file():
        if path.name == "metadata.yaml":
            return _files(path.parent)
        return (_mcap(path),)
    if not path.is_dir():
        raise InvalidRecording(f"{path}: no such file or folder")
    metadata = path / "metadata.yaml"
    if metadata.is_file():
        return tuple(_mcap(path / name) for name in _listed(metadata))
    found = sorted(path.glob("*.mcap"), key=lambda p: (len(p.name), p.name))
    if not found:
        raise InvalidRecording(f"{path}: no metadata.yaml and no .mcap file; give a rosbag2 folder")
    return tuple(_mcap(file) for file in found)


def _listed(metadata: Path) -> list[str]:
    """Names of a bag's files in order, from its metadata.yaml."""
    try:
        info = yaml.safe_load(metadata.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
        names = [Path(name).name for name in info["relative_file_paths"]]
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError) as error:
        raise InvalidRecording(
            f"{metadata}: not a rosbag2 metadata file ({_one_line(error)}); try 'ros2 bag reindex'"
        ) from error
    if not names:
        raise InvalidRecording(f"{metadata}: lists no files; try 'ros2 bag reindex'")
    return names


def _mcap(path: Path) -> Path:
    if not path.is_file():
        raise InvalidRecording(f"{path}: no such file, though the recording lists it")
    with path.open("rb") as stream:
        start = stream.read(8)
    if start[:5] == b"\x89MCAP":
        return path
    kind, remedy = "not an mcap file", "record with 'ros2 bag record --storage mcap'"
    if start[:6] == b"SQLite":
        kind, remedy = "an SQLite bag", "convert it with 'ros2 bag convert' to storage mcap"
    elif start[:4] == b"\x28\xb5\x2f\xfd":
        kind, remedy = "compressed as a whole", "unpack it with 'zstd -d'"
    elif not start:
        kind = "empty"
    raise InvalidRecording(f"{path}: is {kind}; {remedy}")


def _topics(files: tuple[Path, ...]) -> tuple[Topic, ...]:
    """Topics of all files, by name; counts where every file has statistics."""
    found: dict[str, Topic] = {}
    for path in files:
        for topic in _topics_of(path):
            before = found.get(topic.name)
            if before is not None and before.messages is not None and topic.messages is not None:
                topic = Topic(topic.name, topic.kind, before.messages + topic.messages)
            found[topic.name] = topic
    return tuple(found[name] for name in sorted(found))


def _topics_of(path: Path) -> list[Topic]:
    with path.open("rb") as stream:
        try:
            summary = SeekingReader(stream).get_summary()
        except BROKEN:
            summary = None
    if summary is not None and summary.channels and summary.statistics is not None:
        counts = summary.statistics.channel_message_counts
        return [
            Topic(c.topic, _kind(summary.schemas.get(c.schema_id)), counts.get(c.id, 0))
            for c in summary.channels.values()
        ]
    seen: dict[int, Topic] = {}
    try:
        for schema, channel, _ in _streamed(path, None):
            seen.setdefault(channel.id, Topic(channel.topic, _kind(schema), None))
    except BROKEN as error:
        if not seen:
            raise InvalidRecording(
                f"{path}: ends early or is damaged, and no message can be read "
                f"({_one_line(error)}); record it again or try 'mcap recover'"
            ) from error
    return list(seen.values())


def _kind(schema: Schema | None) -> str:
    return schema.name if schema is not None else ""


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


def _records(
    path: Path, topics: tuple[str, ...]
) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """Messages in log order by the file's index, or in file order where it has none."""
    with path.open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True)
        try:
            summary = reader.get_summary()
        except BROKEN:
            summary = None
        if summary is not None and summary.chunk_indexes:
            yield from reader.iter_messages(topics=topics)
            return
    yield from _streamed(path, topics)


def _streamed(
    path: Path, topics: tuple[str, ...] | None
) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """Messages in file order; raises where the file breaks off."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with path.open("rb") as stream:
        for record in StreamReader(stream, validate_crcs=True, record_size_limit=2**32).records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                if topics is None or channel.topic in topics:
                    yield schemas.get(channel.schema_id), channel, record


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


def _one_line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
