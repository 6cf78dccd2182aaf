"""Small recordings written for tests, good and bad: a strip of cloth that turns before a camera."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2._dynamic import serialize_dynamic

BAGS = Path(__file__).parents[1] / "bags"
CLOUD_TYPE, JOINT_TYPE = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/JointState"
S = 1_000_000_000
CALIBRATION = {
    "frame": "rig",
    "axis_point": [0.0, -0.4, 1.3],
    "axis_direction": [0.0, -1.0, 0.0],
    "gripper_tip": [0.0, -0.4, 1.3],
    "joint": "wrist",
    "joint_sign": 1,
    "joint_zero": 0.0,
}


@dataclasses.dataclass(frozen=True)
class Message:
    """One message to be recorded."""

    log_ns: int
    topic: str
    kind: str
    fields: dict | bytes  # bytes: as they are


def header(stamp_ns, frame=""):
    stamp = {"sec": stamp_ns // S, "nanosec": stamp_ns % S}
    return {"stamp": stamp, "frame_id": frame}


def cloud(stamp_ns, *, topic="/points", frame="rig", rows=40, **changes):
    """Points of a strip below the tip, logged 60 ms after their stamp."""
    row, col = np.mgrid[:rows, :20]
    xyz = np.stack([0.004 * (col - 10), 0.004 * row - 0.39, np.full(row.shape, 1.3)], axis=2)
    fields = {
        "header": header(stamp_ns, frame),
        "height": rows,
        "width": 20,
        "fields": [
            {"name": name, "offset": 4 * k, "datatype": 7, "count": 1}
            for k, name in enumerate("xyz")
        ],
        "is_bigendian": False,
        "point_step": 12,
        "row_step": 240,
        "data": xyz.astype("<f4").tobytes(),
        "is_dense": True,
        **changes,
    }
    return Message(stamp_ns + 60_000_000, topic, CLOUD_TYPE, fields)


def joints(stamp_ns, position, *, topic="/joint_states", names=("wrist", "finger")):
    fields = {
        "header": header(stamp_ns),
        "name": list(names),
        "position": [position, 0.0][: len(names)],
        "velocity": [],
        "effort": [],
    }
    return Message(stamp_ns, topic, JOINT_TYPE, fields)


def turn(clouds=8, seconds=8, **options):
    """A wrist that turns once, 50 Hz, and clouds spread evenly over the turn."""
    rate = 2 * np.pi / seconds
    states = [joints(k * S // 50, rate * k / 50) for k in range(50 * seconds)]
    return states + [
        cloud((2 * k + 1) * seconds * S // (2 * clouds), **options) for k in range(clouds)
    ]


def definitions():
    """Text of the message types, as a recording carries it."""
    with next((BAGS / "SH1_1").glob("*.mcap")).open("rb") as stream:
        schemas = make_reader(stream).get_summary().schemas.values()
        return {schema.name: schema.data.decode() for schema in schemas}


def write_mcap(path, messages, *, compression="zstd", chunk_size=100_000, chunked=True, end=True):
    """Write messages in the given order; without `end` as if the recorder had been killed."""
    texts = definitions()
    with path.open("wb") as stream:
        writer = Writer(
            stream,
            chunk_size=chunk_size,
            compression=CompressionType[compression.upper()],
            use_chunking=chunked,
        )
        writer.start(profile="ros2", library="test")
        schemas = {}
        for kind in sorted({message.kind for message in messages}):
            schemas[kind] = writer.register_schema(kind, "ros2msg", texts[kind].encode())
        encoders = {kind: serialize_dynamic(kind, texts[kind])[kind] for kind in schemas}
        channels = {}
        for message in messages:
            if message.topic not in channels:
                channels[message.topic] = writer.register_channel(
                    message.topic, "cdr", schemas[message.kind]
                )
            data = message.fields
            if not isinstance(data, bytes):
                data = encoders[message.kind](data)
            writer.add_message(channels[message.topic], message.log_ns, data, message.log_ns)
        if end:
            writer.finish()
    return path


def write_bag(folder, parts, **options):
    """A rosbag2 folder with one .mcap file for each list of messages."""
    folder.mkdir()
    names = [f"{folder.name}_{number}.mcap" for number in range(len(parts))]
    for name, messages in zip(names, parts):
        write_mcap(folder / name, messages, **options)
    information = {"version": 5, "storage_identifier": "mcap", "relative_file_paths": names}
    (folder / "metadata.yaml").write_text(
        yaml.safe_dump({"rosbag2_bagfile_information": information})
    )
    (folder / "calibration.yaml").write_text(yaml.safe_dump(CALIBRATION))
    return folder


def in_log_order(messages):
    return sorted(messages, key=lambda message: message.log_ns)
