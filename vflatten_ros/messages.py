"""Core values as the fields of our messages, and back.

Every function gives plain nested dictionaries with the message's field names: no ROS is needed. The
node copies them into rclpy messages with `fill`, `vflatten replay` writes the same ones to mcap and
JSON: so the numbers agree byte for byte. Bulk data are numpy arrays of the message's own type, and
float32 fields are rounded here, once. Messages for RViz and Foxglove are in displays.py.
"""

from __future__ import annotations

import array
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np

from vflatten_ros.core.buffer import BufferState
from vflatten_ros.core.config import IntegrationConfig
from vflatten_ros.core.errors import InvalidCorrespondence
from vflatten_ros.core.values import (
    Correspondence,
    FlatGarment,
    Float,
    Landmark,
    Measurement,
    View,
)

Fields = dict[str, Any]

SEEN, INFERRED = 0, 1  # evidence of FlattenedView and Measurement
R_SCORE, PROBABILITY = 0, 1  # GarmentEstimate.score_kind
MANUAL, AUTOMATIC = 0, 1  # Correspondence.origin
PIXEL, POINT = 0, 1  # Correspondence.given_a, given_b

UNSEEN_NOTHING, UNSEEN_TURN, UNSEEN_REGRASP = 0, 1, 2  # GarmentEstimate.unseen

PIXEL_REACH = IntegrationConfig().pair_reach_px
POINT_REACH_M = 0.02  # a point given by hand may miss the surface by this much


def f32(value: float) -> float:
    """The number that a float32 field holds."""
    return float(np.float32(value))


def time_fields(stamp_ns: int) -> Fields:
    """builtin_interfaces/Time."""
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    return {"sec": seconds, "nanosec": nanoseconds}


def stamp_ns(time: Mapping[str, int]) -> int:
    """Nanoseconds of builtin_interfaces/Time fields."""
    return int(time["sec"]) * 1_000_000_000 + int(time["nanosec"])


def header_fields(stamp: int, frame_id: str) -> Fields:
    """std_msgs/Header, `stamp` in nanoseconds."""
    return {"stamp": time_fields(stamp), "frame_id": frame_id}


def point_fields(xyz: Iterable[float]) -> Fields:
    """geometry_msgs/Point, Point32 or Vector3."""
    return dict(zip("xyz", (float(v) for v in xyz), strict=True))


def frame_of(views: Sequence[View]) -> str:
    """Frame of the clouds that gave the views, "" if there are none."""
    return views[0].calibration.frame if views else ""


def angles_of(garment: FlatGarment, views: Iterable[View]) -> Float:
    """Item angle of each view used, radians; NaN for a view that is not among `views`."""
    known = {view.view_id: view.angle_rad for view in views}
    return np.array([known.get(i, np.nan) for i in garment.view_ids], dtype=np.float64)


def flattened_view_fields(garment: FlatGarment, views: Sequence[View], item: int = 0) -> Fields:
    """vflatten_ros/FlattenedView of a garment that was flattened from `views`."""
    points, outline = garment.points, garment.outline
    return {
        "header": header_fields(garment.stamp_ns, frame_of(views)),
        "item": int(item),
        "method": garment.method,
        "view_ids": np.array(garment.view_ids, dtype=np.uint32),
        "view_angles": angles_of(garment, views),
        **_share_fields(garment),
        "contour_u": outline.uv[:, 0].astype(np.float32),
        "contour_v": outline.uv[:, 1].astype(np.float32),
        "contour_sigma": outline.sigma_m.astype(np.float32),
        "contour_evidence": outline.inferred.astype(np.uint8),
        "u": points.uv[:, 0].astype(np.float32),
        "v": points.uv[:, 1].astype(np.float32),
        "x": points.xyz_hanger[:, 0].astype(np.float32),
        "y": points.xyz_hanger[:, 1].astype(np.float32),
        "z": points.xyz_hanger[:, 2].astype(np.float32),
        "view": points.view_id.astype(np.int32),
        "row": points.pixel[:, 0].astype(np.int32),
        "col": points.pixel[:, 1].astype(np.int32),
        "stress": points.stress.astype(np.float32),
        "sigma": points.sigma_m.astype(np.float32),
        "evidence": points.inferred.astype(np.uint8),
        "stress_rms": f32(_rms(points.stress)),
        "coverage": f32(garment.coverage),
        "quality": f32(garment.quality),
        **_notice_fields(garment),
    }


def garment_estimate_fields(garment: FlatGarment, views: Sequence[View], item: int = 0) -> Fields:
    """vflatten_ros/GarmentEstimate of a garment that was flattened from `views`."""
    ranked = sorted(garment.scores.items(), key=lambda item: (-item[1], item[0]))
    first = {"width": 0, "length": 1}
    sizes = sorted(garment.measurements, key=lambda m: first.get(m.name, 2))
    return {
        "header": header_fields(garment.stamp_ns, frame_of(views)),
        "item": int(item),
        "category": garment.category,
        "hypotheses": [{"category": name, "score": f32(score)} for name, score in ranked],
        "score_kind": PROBABILITY if garment.score_kind == "probability" else R_SCORE,
        "measurements": [measurement_fields(m) for m in sizes],
        "landmarks": [landmark_fields(mark) for mark in garment.landmarks],
        "coverage": f32(garment.coverage),
        "quality": f32(garment.quality),
        "enough": bool(garment.enough),
        "unseen": _unseen_kind(garment),
        "turn_to": _turn_to(garment),
        "trusted": garment.trusted,
        **_notice_fields(garment),
    }


def _share_fields(garment: FlatGarment) -> Fields:
    known = {share.view_id: share for share in garment.shares}
    shares = [known[i] for i in garment.view_ids if i in known]
    return {
        f"view_{name}": np.array([getattr(share, name) for share in shares], dtype=np.float32)
        for name in ("shows", "only", "first")
    }


def _unseen_kind(garment: FlatGarment) -> int:
    if garment.unseen is None:
        return UNSEEN_NOTHING
    return UNSEEN_REGRASP if garment.unseen.turn_to_rad is None else UNSEEN_TURN


def _turn_to(garment: FlatGarment) -> float:
    angle = garment.unseen.turn_to_rad if garment.unseen is not None else None
    return 0.0 if angle is None else float(angle)


def measurement_fields(measurement: Measurement) -> Fields:
    """vflatten_ros/Measurement."""
    return {
        "name": measurement.name,
        "value": float(measurement.value_m),
        "sigma": float(measurement.sigma_m),
        "evidence": INFERRED if measurement.inferred else SEEN,
    }


def landmark_fields(landmark: Landmark) -> Fields:
    """vflatten_ros/Landmark; the origin, with no sigma, where nothing of the item was seen."""
    return {
        "name": landmark.name,
        "seen": landmark.seen,
        "u": float(landmark.uv[0]),
        "v": float(landmark.uv[1]),
        "uv_sigma": float(landmark.uv_sigma_m),
        "position": point_fields(landmark.xyz_hanger or (0.0, 0.0, 0.0)),
        "position_sigma": float(landmark.xyz_sigma_m),
        "views": np.array(landmark.views, dtype=np.uint32),
        "certainty": f32(landmark.certainty),
    }


def view_info_fields(view: View, selected: bool) -> Fields:
    """vflatten_ros/ViewInfo."""
    return {
        "id": int(view.view_id),
        "stamp": time_fields(view.stamp_ns),
        "item_angle": float(view.angle_rad),
        "points": len(view.points_rig),
        "rows": int(view.shape[0]),
        "cols": int(view.shape[1]),
        "bytes": int(view.nbytes),
        "selected": bool(selected),
    }


def view_buffer_state_fields(
    state: BufferState,
    views: Sequence[View],
    frame_id: str,
    *,
    selected: Iterable[int],
    correspondences: int,
    enough: bool = False,
) -> Fields:
    """vflatten_ros/ViewBufferState; `selected` are ids, `correspondences` the pairs stored."""
    chosen = set(selected)
    by_id = sorted(views, key=lambda view: view.view_id)
    newest = max((view.stamp_ns for view in views), default=0)
    return {
        "header": header_fields(newest, frame_id),
        "state": int(state.stage.value),
        "item": int(state.item),
        "views": [view_info_fields(view, view.view_id in chosen) for view in by_id],
        "enough": bool(enough),
        "angle_covered": float(state.angle_covered_rad),
        "bytes": int(state.nbytes),
        "correspondences": int(correspondences),
        "clouds_received": int(state.clouds_received),
        "clouds_waiting": int(state.clouds_waiting),
        "drop_reasons": sorted(state.drops),
        "drop_counts": np.array([state.drops[k] for k in sorted(state.drops)], dtype=np.uint64),
    }


def correspondence_fields(
    pair: Correspondence, pair_id: int, views: Mapping[int, View] | None = None
) -> Fields:
    """vflatten_ros/Correspondence with its 3-D points where `views` (by id) hold them."""
    views = views or {}
    return {
        "id": int(pair_id),
        "view_a": int(pair.view_a),
        "view_b": int(pair.view_b),
        "given_a": PIXEL,
        "given_b": PIXEL,
        "pixel_a": np.array(pair.pixel_a, dtype=np.int32),
        "pixel_b": np.array(pair.pixel_b, dtype=np.int32),
        "point_a": point_fields(_point_at(views.get(pair.view_a), pair.pixel_a)),
        "point_b": point_fields(_point_at(views.get(pair.view_b), pair.pixel_b)),
        "origin": MANUAL if pair.manual else AUTOMATIC,
        "confidence": f32(pair.confidence),
    }


def correspondence_from_fields(
    fields: Mapping[str, Any],
    views: Mapping[int, View],
    reach_px: float = PIXEL_REACH,
) -> Correspondence:
    """The core's correspondence from vflatten_ros/Correspondence fields.

    A side given by POINT becomes the nearest pixel of its view; a side given by PIXEL moves to the
    item's nearest pixel if it misses the item's edge by no more than `reach_px`.

    Parameters
    ----------
    fields : mapping
        As `correspondence_fields` gives them, or `read(message)`.
    views : mapping of view id to View
    reach_px : float
        The setting integration.pair_reach_px.

    Raises
    ------
    InvalidCorrespondence
        Unknown or equal views, a confidence outside 0-1, a place that is not on the item.
    """
    ids = int(fields["view_a"]), int(fields["view_b"])
    if ids[0] == ids[1]:
        raise InvalidCorrespondence(f"both sides name view {ids[0]}; give two different views")
    confidence = float(fields.get("confidence", 1.0))
    if not 0.0 <= confidence <= 1.0:
        raise InvalidCorrespondence(f"confidence: expected 0 to 1, got {confidence}")
    pixel_a, pixel_b = (
        _side(fields, side, views, i, reach_px) for side, i in zip("ab", ids, strict=True)
    )
    manual = int(fields.get("origin", MANUAL)) == MANUAL
    return Correspondence(ids[0], ids[1], pixel_a, pixel_b, manual, confidence)


def checked_correspondence(
    pair: Correspondence,
    views: Mapping[int, View],
    reach_px: float = PIXEL_REACH,
) -> Correspondence:
    """The pair as the service would take it; raises InvalidCorrespondence as it would."""
    fields = {
        "view_a": pair.view_a,
        "view_b": pair.view_b,
        "pixel_a": pair.pixel_a,  # as given: in a message's array a huge one would come round
        "pixel_b": pair.pixel_b,
        "origin": MANUAL if pair.manual else AUTOMATIC,
        "confidence": pair.confidence,
    }
    return correspondence_from_fields(fields, views, reach_px)


def _side(
    fields: Mapping[str, Any], side: str, views: Mapping[int, View], view_id: int, reach_px: float
) -> tuple[int, int]:
    if view_id not in views:
        known = ", ".join(str(i) for i in sorted(views)) or "none"
        raise InvalidCorrespondence(f"view {view_id} is not in the buffer; views held: {known}")
    given = int(fields.get(f"given_{side}", PIXEL))
    if given == POINT:
        point = fields[f"point_{side}"]
        return _pixel_of_point(views[view_id], np.array([point[k] for k in "xyz"], dtype=float))
    if given == PIXEL:
        row, col = (int(v) for v in fields[f"pixel_{side}"])
        return pixel_on_item(views[view_id], (row, col), reach_px)
    raise InvalidCorrespondence(f"given_{side}: expected PIXEL (0) or POINT (1), got {given}")


def pixel_on_item(
    view: View, pixel: tuple[int, int], reach_px: float = PIXEL_REACH
) -> tuple[int, int]:
    """The item's pixel nearest to `pixel` (row, col); InvalidCorrespondence beyond the reach."""
    rows, cols = view.shape
    if not (0 <= pixel[0] < rows and 0 <= pixel[1] < cols):
        raise InvalidCorrespondence(
            f"pixel (row {pixel[0]}, col {pixel[1]}) lies outside view {view.view_id} "
            f"of {rows} x {cols}; pixels are given as row, col from 0"
        )
    away = view.pixel - np.array(pixel, dtype=view.pixel.dtype)
    gap = np.einsum("ij,ij->i", away, away)  # squared
    if not len(gap) or gap.min() > reach_px**2:
        nearest = f"{gap.min() ** 0.5:.0f} pixels away" if len(gap) else "nowhere"
        raise InvalidCorrespondence(
            f"pixel (row {pixel[0]}, col {pixel[1]}) of view {view.view_id} is not on the item, "
            f"which is {nearest}; choose a point of the cloth that both views show"
        )
    row, col = view.pixel[int(gap.argmin())]
    return int(row), int(col)


def _pixel_of_point(view: View, point: Float) -> tuple[int, int]:
    if not np.isfinite(point).all():
        raise InvalidCorrespondence(f"point {point.tolist()} of view {view.view_id} is not finite")
    gap = np.linalg.norm(view.points_rig - point, axis=1)
    if not len(gap) or gap.min() > POINT_REACH_M:
        nearest = f"{gap.min():.3f} m away" if len(gap) else "nowhere"
        raise InvalidCorrespondence(
            f"point {np.round(point, 3).tolist()} (rig frame) is not on the item in view "
            f"{view.view_id}: the item's nearest point is {nearest}, {POINT_REACH_M} m allowed"
        )
    row, col = view.pixel[int(gap.argmin())]
    return int(row), int(col)


def _point_at(view: View | None, pixel: tuple[int, int]) -> Float:
    if view is None:
        return np.full(3, np.nan)
    here = np.flatnonzero((view.pixel[:, 0] == pixel[0]) & (view.pixel[:, 1] == pixel[1]))
    return view.points_rig[here[0]] if len(here) else np.full(3, np.nan)


def _notice_fields(garment: FlatGarment) -> Fields:
    return {
        "notice_codes": [notice.code for notice in garment.notices],
        "notice_texts": [notice.text for notice in garment.notices],
    }


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


# rclpy messages: only the functions below touch them, through their own description

_TYPECODES = {
    "float": "f", "double": "d", "octet": "B", "uint8": "B", "int8": "b", "uint16": "H",
    "int16": "h", "uint32": "I", "int32": "i", "uint64": "Q", "int64": "q",
}  # fmt: skip
_field_types: dict[type, Mapping[str, str]] = {}  # of the classes filled so far
_AS_IT_IS = {*_TYPECODES, "boolean", "string"} - {"octet"}
_SEQUENCE = re.compile(r"sequence<(?P<of>[^,>]+)(, \d+)?>|(?P<fixed>[^\[]+)\[(?P<size>\d+)\]")


def fill(message: Any, fields: Mapping[str, Any]) -> Any:
    """Set an rclpy message from nested fields; returns the message.

    Raises
    ------
    KeyError
        A field that the message does not have.
    """
    types = _field_types.get(type(message))
    if types is None:  # asked once: every answer is a copy
        types = _field_types[type(message)] = message.get_fields_and_field_types()
    for name, value in fields.items():
        kind = types[name]
        setattr(message, name, value if kind in _AS_IT_IS else _as_field(kind, value))
    return message


def _as_field(kind: str, value: Any) -> Any:
    many = _SEQUENCE.fullmatch(kind)
    if many is None:
        if "/" in kind:
            return fill(message_class(kind)(), value)
        return bytes([value]) if kind == "octet" else value
    of = many["of"] or many["fixed"]
    if "/" in of:
        create = message_class(of)
        return [fill(create(), item) for item in value]
    if many["fixed"]:
        return (
            np.asarray(value, dtype=np.dtype(_TYPECODES[of])) if of in _TYPECODES else list(value)
        )
    if of in _TYPECODES:
        # an array.array is taken as it is; a list or ndarray is checked number by number
        code = _TYPECODES[of]
        return array.array(code, np.ascontiguousarray(value, dtype=np.dtype(code)).tobytes())
    return list(value)


def message_class(kind: str) -> Any:
    """The class of a message, by "package/Name" or "package/msg/Name"."""
    package, name = kind.split("/")[0], kind.split("/")[-1]
    return getattr(import_module(f"{package}.msg"), name)


def read(message: Any) -> Fields:
    """The fields of an rclpy message, nested; the reverse of `fill`."""
    return {name: _plain(getattr(message, name)) for name in message.get_fields_and_field_types()}


def _plain(value: Any) -> Any:
    if hasattr(value, "get_fields_and_field_types"):
        return read(value)
    if isinstance(value, array.array):
        return (
            np.frombuffer(value, dtype=np.dtype(value.typecode))
            if len(value)
            else np.empty(0, dtype=np.dtype(value.typecode))
        )
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, bytes) and len(value) == 1:
        return value[0]
    return value
