"""Writes our messages to an mcap file, with their definitions, without ROS.

The bytes depend on the messages alone: log times are the messages' own stamps.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer

from vflatten_ros import resources
from vflatten_ros.output_files import whole_file
from vflatten_ros.outputs import Message

_BUILT_IN = re.compile(r"(bool|byte|char|w?string|u?int(8|16|32|64)|float(32|64))(<=\d+)?")
_FIELD = re.compile(r"(?P<type>[A-Za-z][\w/]*)(<=\d+)?(\[[^\]]*\])?\s+[A-Za-z]\w*\s*(?P<equals>=)?")
_PARENT = "vflatten_ros"

# Field lists of the standard interfaces of Jazzy (common_interfaces, rcl_interfaces).
STANDARD: Mapping[str, str] = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Point32": "float32 x\nfloat32 y\nfloat32 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation\n",
    "geometry_msgs/Polygon": "Point32[] points\n",
    "geometry_msgs/PolygonStamped": "std_msgs/Header header\nPolygon polygon\n",
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count\n",
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nPointField[] fields\n"
        "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    ),
    "sensor_msgs/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        "uint8 is_bigendian\nuint32 step\nuint8[] data\n"
    ),
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "visualization_msgs/UVCoordinate": "float32 u\nfloat32 v\n",
    "visualization_msgs/MeshFile": "string filename\nuint8[] data\n",
    "visualization_msgs/Marker": (
        "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\n"
        "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\n"
        "builtin_interfaces/Duration lifetime\nbool frame_locked\ngeometry_msgs/Point[] points\n"
        "std_msgs/ColorRGBA[] colors\nstring texture_resource\n"
        "sensor_msgs/CompressedImage texture\nUVCoordinate[] uv_coordinates\nstring text\n"
        "string mesh_resource\nMeshFile mesh_file\nbool mesh_use_embedded_materials\n"
    ),
    "visualization_msgs/MarkerArray": "Marker[] markers\n",
}


def definition(name: str) -> str:
    """Text of one message "package/Name", our own or standard."""
    package, message = name.split("/")
    if package != _PARENT:
        return STANDARD[name]
    return resources.message_definition(message)


def full_definition(name: str) -> str:
    """Text of a message and of all that it holds, as mcap's "ros2msg" encoding wants it."""
    found: dict[str, str] = {}
    _collect(name, found)
    own = found.pop(name)
    return own + "".join(f"{'=' * 80}\nMSG: {part}\n{text}" for part, text in found.items())


def _collect(name: str, found: dict[str, str]) -> None:
    if name not in found:
        found[name] = definition(name)
        for part in _parts(name.split("/")[0], found[name]):
            _collect(part, found)


def _parts(package: str, text: str) -> Iterator[str]:
    """Message types in a definition, in order."""
    for line in text.splitlines():
        field = _FIELD.match(line)
        if field and not field["equals"] and not _BUILT_IN.fullmatch(field["type"]):
            yield field["type"] if "/" in field["type"] else f"{package}/{field['type']}"


def write_mcap(path: Path, to_write: Iterable[Message]) -> None:
    """Write messages to a file; raises OSError."""
    with whole_file(path) as partial, partial.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        schemas: dict[str, Any] = {}
        for message in to_write:
            if message.type not in schemas:
                ros_name = message.type.replace("/", "/msg/")
                schemas[message.type] = writer.register_msgdef(
                    ros_name, full_definition(message.type)
                )
            writer.write_message(
                topic=message.topic,
                schema=schemas[message.type],
                message=_plain(message.fields),
                log_time=message.stamp_ns,
                publish_time=message.stamp_ns,
            )
        writer.finish()


def _plain(value: Any) -> Any:
    """The writer takes lists and bytes, no arrays."""
    if isinstance(value, np.ndarray):
        return value.tobytes() if value.dtype == np.uint8 else value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return value
