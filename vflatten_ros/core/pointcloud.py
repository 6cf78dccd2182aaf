"""PointCloud2 bytes to points: any legal layout, and a clear refusal of the others."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.arrays import frozen
from vflatten_ros.core.errors import InvalidCloud
from vflatten_ros.core.values import Byte, Cloud

# sensor_msgs/PointField datatype -> numpy kind and size
DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
UINT32, FLOAT32, FLOAT64 = 6, 7, 8
MAX_POINTS = 64_000_000  # more than any camera delivers; a size beyond it is a lie


@dataclass(frozen=True)
class PointField:
    """One field of a point: where its bytes are and what they mean."""

    name: str
    offset: int  # bytes from the start of the point
    datatype: int  # as in sensor_msgs/PointField
    count: int  # elements


def decode_cloud(
    *,
    stamp_ns: int,
    frame_id: str,
    height: int,
    width: int,
    fields: Sequence[PointField],
    is_bigendian: bool,
    point_step: int,
    row_step: int,
    data: Any,
    zero_is_unmeasured: bool = True,
) -> Cloud:
    """Points and colours of a PointCloud2.

    x, y, z may be float32 or float64, in any order and with any padding; colour may be a packed
    'rgb' or 'rgba' (float32 or uint32, 0xAARRGGBB) or separate uint8 'r', 'g', 'b'. is_dense is
    not needed: a point with a coordinate that is not finite is unmeasured either way.

    Parameters
    ----------
    stamp_ns : int
        Time of capture.
    frame_id : str
        Frame of the points.
    height, width, fields, is_bigendian, point_step, row_step
        As in sensor_msgs/PointCloud2.
    data : buffer
        bytes, bytearray, memoryview, array.array or ndarray of uint8; not copied, not changed.
    zero_is_unmeasured : bool
        Many drivers write (0, 0, 0), the optical centre, where they measured nothing.

    Returns
    -------
    Cloud
        xyz float32 (rows, cols, 3) in metres, NaN where unmeasured; read-only. xyz and rgb are
        views of `data` where its layout allows.

    Raises
    ------
    InvalidCloud
        The layout contradicts itself or the data. Nothing large is allocated before that.
    """
    chosen = {field.name: field for field in fields}
    _check_sizes(height, width, point_step, row_step)
    for field in fields:
        _check_field(field, point_step)
    missing = [name for name in ("x", "y", "z") if name not in chosen]
    if missing:
        names = ", ".join(field.name for field in fields) or "none"
        raise InvalidCloud(f"cloud has no field {missing[0]!r} (fields: {names}); check the topic")
    _check_overlap([chosen[name] for name in ("x", "y", "z")])
    raw = _as_bytes(data)
    needed = (height - 1) * row_step + width * point_step if height and width else 0
    if len(raw) < needed:
        raise InvalidCloud(
            f"cloud of {height} x {width} points needs {needed} bytes (point_step {point_step}, "
            f"row_step {row_step}), got {len(raw)}; the driver or the network lost a part"
        )
    points: Byte = np.ndarray(
        (height, width, point_step),
        np.uint8,
        raw if needed else np.zeros(1, np.uint8),
        strides=(row_step, point_step, 1),
    )
    order = ">" if is_bigendian else "<"
    xyz = _decode_xyz(points, [chosen[name] for name in ("x", "y", "z")], order, zero_is_unmeasured)
    return Cloud(stamp_ns, frame_id, xyz, _decode_rgb(points, chosen, order))


def _check_sizes(height: int, width: int, point_step: int, row_step: int) -> None:
    sizes = {"height": height, "width": width, "point_step": point_step, "row_step": row_step}
    for name, size in sizes.items():
        if size < 0:
            raise InvalidCloud(f"cloud has {name} {size}; expected 0 or more")
    if max(height, width, height * width) > MAX_POINTS:
        raise InvalidCloud(f"cloud claims {height} x {width} points; at most {MAX_POINTS} are read")
    if height * width and point_step == 0:
        raise InvalidCloud(f"cloud of {height} x {width} points has point_step 0")
    # One row needs no row_step: several drivers leave it 0 or wrong there.
    if height > 1 and row_step < width * point_step:
        raise InvalidCloud(
            f"cloud has row_step {row_step}, less than width {width} x point_step {point_step}"
        )


def _check_field(field: PointField, point_step: int) -> None:
    kind = DATATYPES.get(field.datatype)
    if kind is None:
        raise InvalidCloud(f"field {field.name!r} has datatype {field.datatype}; expected 1 to 8")
    # A count of 0 is what some drivers write for 1.
    size = int(kind[1]) * max(field.count, 1)
    if field.offset < 0 or field.count < 0 or field.offset + size > max(point_step, 0):
        raise InvalidCloud(
            f"field {field.name!r} covers bytes {field.offset} to {field.offset + size} "
            f"of a point of {point_step} bytes"
        )
    if field.name in ("x", "y", "z") and field.datatype not in (FLOAT32, FLOAT64):
        raise InvalidCloud(
            f"field {field.name!r} has datatype {field.datatype}; "
            "expected 7 (float32) or 8 (float64)"
        )


def _check_overlap(fields: list[PointField]) -> None:
    spans = sorted((f.offset, f.offset + int(DATATYPES[f.datatype][1]), f.name) for f in fields)
    for (_, end, first), (start, _, second) in pairwise(spans):
        if start < end:
            raise InvalidCloud(
                f"fields {first!r} and {second!r} overlap at byte {start} of a point"
            )


def _as_bytes(data: Any) -> NDArray[np.uint8]:
    if isinstance(data, list):
        return np.array(data, dtype=np.uint8)
    try:
        return np.frombuffer(data, dtype=np.uint8) if len(data) else np.zeros(0, np.uint8)
    except (TypeError, ValueError, BufferError) as error:
        raise InvalidCloud(f"cloud data is no buffer of bytes: {error}") from error


def _column(points: Byte, field: PointField, order: str) -> NDArray[Any]:
    """(rows, cols) view of one field's first element, in the data's byte order."""
    dtype = np.dtype(order + DATATYPES[field.datatype])
    return points[..., field.offset : field.offset + dtype.itemsize].view(dtype)[..., 0]


def _decode_xyz(
    points: Byte, fields: list[PointField], order: str, zero_is_unmeasured: bool
) -> NDArray[np.float32]:
    xyz = _gather_xyz(points, fields, order)
    x, y, z = np.moveaxis(xyz, 2, 0)
    with np.errstate(over="ignore", invalid="ignore"):
        square = x * x
        square += y * y
        square += z * z
    measured = square < np.inf  # False for NaN too
    if zero_is_unmeasured:
        measured &= square > 0
    # Most drivers write NaN where they measured nothing: then the message's own bytes will do.
    wrong = ~measured & ~(np.isnan(x) & np.isnan(y) & np.isnan(z))
    if wrong.any():
        xyz = xyz.copy()
        xyz[wrong] = np.nan
    return frozen(xyz)


def _gather_xyz(points: Byte, fields: list[PointField], order: str) -> NDArray[np.float32]:
    """(rows, cols, 3) coordinates: a view of the data where they lie side by side as float32."""
    offsets = [field.offset for field in fields]
    native = order == ("<" if sys.byteorder == "little" else ">")
    side_by_side = offsets == [offsets[0], offsets[0] + 4, offsets[0] + 8]
    if native and side_by_side and all(field.datatype == FLOAT32 for field in fields):
        return points[..., offsets[0] : offsets[0] + 12].view(np.float32)
    xyz = np.empty((*points.shape[:2], 3), np.float32)
    with np.errstate(over="ignore"):  # a float64 beyond float32 becomes inf
        for axis, field in enumerate(fields):
            xyz[..., axis] = _column(points, field, order)
    return xyz


def _decode_rgb(points: Byte, fields: dict[str, PointField], order: str) -> Byte | None:
    packed = fields.get("rgb") or fields.get("rgba")
    if packed is not None and packed.datatype in (FLOAT32, UINT32):
        block = points[..., packed.offset : packed.offset + 4]
        colours: Byte = block[..., 1:] if order == ">" else block[..., 2::-1]  # 0xAARRGGBB
        return colours
    separate = [fields.get(name) for name in ("r", "g", "b")]
    if all(field is not None and field.datatype == 2 for field in separate):
        planes = [_column(points, field, order) for field in separate if field is not None]
        rgb: Byte = np.stack(planes, axis=2)
        return rgb
    return None
