"""Messages of mcap files and rosbag2 folders, and what to say of files that are none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml
from mcap.reader import SeekingReader
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.summary import Summary

from vflatten_ros.core.errors import InvalidRecording

# A file that ends early or is damaged makes the mcap reader and the decompressors, which differ
# between installations, raise errors with no nearer base in common.
BROKEN = Exception
ZSTD = b"\x28\xb5\x2f\xfd"  # what zstd has compressed begins so


@dataclass(frozen=True)
class Topic:
    """One topic of a recording."""

    name: str
    kind: str
    messages: int | None  # None: the file has no statistics


def recording_files(path: Path) -> tuple[Path, ...]:
    """The .mcap files of a recording in order; raises InvalidRecording."""
    if path.is_file():
        if path.name == "metadata.yaml":
            return recording_files(path.parent)
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
            f"{metadata}: not a rosbag2 metadata file ({one_line(error)}); try 'ros2 bag reindex'"
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
    elif start[:4] == ZSTD:
        kind, remedy = "compressed as a whole", "unpack it with 'zstd -d'"
    elif not start:
        kind = "empty"
    raise InvalidRecording(f"{path}: is {kind}; {remedy}")


def recorded_topics(files: tuple[Path, ...]) -> tuple[Topic, ...]:
    """Topics of all files, by name; counts where every file has statistics."""
    found: dict[str, Topic] = {}
    for path in files:
        for topic in _topics_of(path):
            before = found.get(topic.name)
            if before is not None:
                counts = before.messages, topic.messages
                total = None if None in counts else sum(count or 0 for count in counts)
                topic = Topic(topic.name, topic.kind, total)
            found[topic.name] = topic
    return tuple(found[name] for name in sorted(found))


def first_log_ns(path: Path) -> int:
    """No message of a file was recorded earlier; 0 for a file that has no statistics."""
    summary = _summary(path)
    statistics = summary.statistics if summary is not None else None
    return statistics.message_start_time if statistics is not None else 0


def _summary(path: Path) -> Summary | None:
    """What a file says of itself; None: nothing, as the recorder was killed, or it is damaged."""
    with path.open("rb") as stream:
        try:
            return SeekingReader(stream).get_summary()
        except BROKEN:
            return None


def _topics_of(path: Path) -> list[Topic]:
    summary = _summary(path)
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
                f"({one_line(error)}); record it again or try 'mcap recover'"
            ) from error
    return list(seen.values())


def _kind(schema: Schema | None) -> str:
    return schema.name if schema is not None else ""


def recorded_messages(
    path: Path, topics: tuple[str, ...]
) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """Messages in log order by the file's index, or in file order where it has none."""
    summary = _summary(path)
    if summary is None or not summary.chunk_indexes:
        yield from _streamed(path, topics)
        return
    with path.open("rb") as stream:
        yield from SeekingReader(stream, validate_crcs=True).iter_messages(topics=topics)


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


def one_line(error: BaseException) -> str:
    """An error's type and, if it has one, its text, without line breaks."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
