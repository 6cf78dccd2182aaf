"""A flattened garment as standard messages that RViz and Foxglove draw.

Fields as in messages.py. The point cloud and the markers lie in the frame of the clouds, turned to
the angle of the newest view, so that they cover the live cloud of that stamp; the flat outline
stands beside the hanging item, in the plane through the wrist axis that faces the rig. The contour
polygon holds plain (u, v, 0) in the frame `garment_flat`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.geometry import inverse, transform_points
from vflatten_ros.core.values import Byte, FlatGarment, Float, View
from vflatten_ros.messages import Fields, f32, frame_of, header_fields, point_fields

FLAT_FRAME = "garment_flat"
POINTS_SHOWN = 4000  # most item points in the markers; the point cloud has all
LINES_SHOWN = 200

# colour-blind-safe (Okabe and Ito 2008), red green blue alpha
BLUE = (0.0, 0.447, 0.698, 1.0)
ORANGE = (0.902, 0.624, 0.0, 1.0)
VERMILION = (0.835, 0.369, 0.0, 1.0)
GREEN = (0.0, 0.62, 0.451, 1.0)
GREY = (0.6, 0.6, 0.6, 1.0)
WHITE = (1.0, 1.0, 1.0, 1.0)

# visualization_msgs/Marker
_DELETE_ALL = 3
_LINE_LIST, _SPHERE_LIST, _POINTS, _TEXT = 5, 7, 8, 9
_FLOAT32 = 7  # sensor_msgs/PointField.FLOAT32


def contour_fields(garment: FlatGarment) -> Fields:
    """geometry_msgs/PolygonStamped: x = u, y = v, z = 0 in the frame `garment_flat`."""
    flat = np.c_[garment.outline.uv, np.zeros(len(garment.outline.uv))].astype(np.float32)
    points = [point_fields(row) for row in flat]
    return {"header": header_fields(garment.stamp_ns, FLAT_FRAME), "polygon": {"points": points}}


def points_fields(garment: FlatGarment, views: Sequence[View]) -> Fields:
    """sensor_msgs/PointCloud2 of the used points: x, y, z in the clouds' frame, u, v, sigma."""
    points = garment.points
    seen = points.view_id >= 0
    xyz = transform_points(_T_rig_hanger(garment, views), points.xyz_hanger[seen])
    rows = np.c_[xyz, points.uv[seen], points.sigma_m[seen]].astype("<f4")
    names = ("x", "y", "z", "u", "v", "sigma")
    return {
        "header": header_fields(garment.stamp_ns, frame_of(views)),
        "height": 1,
        "width": len(rows),
        "fields": [
            {"name": name, "offset": 4 * i, "datatype": _FLOAT32, "count": 1}
            for i, name in enumerate(names)
        ],
        "is_bigendian": False,
        "point_step": 4 * len(names),
        "row_step": 4 * len(names) * len(rows),
        "data": np.frombuffer(rows.tobytes(), dtype=np.uint8),
        "is_dense": True,
    }


def image_fields(picture: Byte, stamp_ns: int, frame_id: str = FLAT_FRAME) -> Fields:
    """sensor_msgs/Image (rgb8) of an (h, w, 3) picture."""
    height, width = picture.shape[:2]
    return {
        "header": header_fields(stamp_ns, frame_id),
        "height": height,
        "width": width,
        "encoding": "rgb8",
        "is_bigendian": 0,
        "step": 3 * width,
        "data": np.ascontiguousarray(picture, dtype=np.uint8).reshape(-1),
    }


def diagnostic_fields(
    stamp_ns: int, statuses: Sequence[tuple[int, str, str, str, Mapping[str, Any]]]
) -> Fields:
    """diagnostic_msgs/DiagnosticArray of (level, name, message, hardware_id, values) each.

    Level 0 is OK, 1 WARN, 2 ERROR, 3 STALE.
    """
    return {
        "header": header_fields(stamp_ns, ""),
        "status": [
            {
                "level": level,
                "name": name,
                "message": message,
                "hardware_id": hardware,
                "values": [{"key": key, "value": str(value)} for key, value in values.items()],
            }
            for level, name, message, hardware, values in statuses
        ],
    }


def marker_fields(garment: FlatGarment, views: Sequence[View]) -> Fields:
    """visualization_msgs/MarkerArray: item, geodesic lines, correspondences, outline, landmarks.

    The first marker deletes those of the result before.
    """
    header = header_fields(garment.stamp_ns, frame_of(views))
    T_rig_hanger = _T_rig_hanger(garment, views)
    beside = _beside(garment, views, T_rig_hanger)
    markers = [_marker(header, "", 0, 0, action=_DELETE_ALL)]
    markers.append(_item(garment, header, T_rig_hanger))
    markers.append(_lines(garment, header, T_rig_hanger))
    markers.append(_pairs(garment, header, views, T_rig_hanger))
    markers.append(_outline(garment, header, beside))
    markers.append(_sizes(garment, header, beside))
    markers.extend(_landmarks(garment, header, T_rig_hanger))
    return {"markers": markers}


def _T_rig_hanger(garment: FlatGarment, views: Sequence[View]) -> Float:
    """Hanger frame to the clouds' frame at the angle of the newest view used."""
    used = [v for v in views if v.view_id in garment.view_ids] or list(views)
    if not used:
        return np.eye(4)
    newest = max(used, key=lambda view: (view.stamp_ns, view.view_id))
    return garment.calibration.T_rig_hanger(newest.angle_rad)


def _beside(garment: FlatGarment, views: Sequence[View], T_rig_hanger: Float) -> Any:
    """A function from (n, 2) flat to (n, 3) rig coordinates, to the right of the hanging item."""
    T_view_rig = views[0].calibration.T_view_rig if views else np.eye(4)
    hanging = transform_points(T_view_rig @ T_rig_hanger, garment.points.xyz_hanger)
    uv = garment.outline.uv if len(garment.outline.uv) else np.zeros((1, 2))
    if len(hanging) == 0:
        hanging = np.zeros((1, 3))
    right = hanging[:, 0].max() + 0.1 - uv[:, 0].min()
    level = (hanging[:, 1].min() + hanging[:, 1].max() - uv[:, 1].min() - uv[:, 1].max()) / 2

    def place(flat: Float) -> Float:
        standing = np.c_[flat[:, 0] + right, flat[:, 1] + level, np.zeros(len(flat))]
        return transform_points(inverse(T_view_rig), standing)

    return place


def _item(garment: FlatGarment, header: Fields, T_rig_hanger: Float) -> Fields:
    xyz = garment.points.xyz_hanger[garment.points.view_id >= 0]
    xyz = xyz[:: max(1, -(-len(xyz) // POINTS_SHOWN))]
    points = transform_points(T_rig_hanger, xyz)
    return _marker(header, "item", 0, _POINTS, points, scale=0.003, colour=GREY)


def _lines(garment: FlatGarment, header: Fields, T_rig_hanger: Float) -> Fields:
    """Every line is a strip of segments; flagged ones in vermilion."""
    lines = garment.lines
    shown = slice(None, None, max(1, -(-len(lines.length_m) // LINES_SHOWN)))
    nodes = transform_points(T_rig_hanger, lines.nodes_hanger[shown])
    ends = _segments(nodes).reshape(-1, 3)
    per_line = 2 * (nodes.shape[1] - 1) if nodes.ndim == 3 else 0
    flagged = np.repeat(lines.flagged[shown], per_line)
    colours = np.where(flagged[:, None], VERMILION, BLUE)
    return _marker(header, "geodesic_lines", 0, _LINE_LIST, ends, scale=0.002, colours=colours)


def _pairs(
    garment: FlatGarment, header: Fields, views: Sequence[View], T_rig_hanger: Float
) -> Fields:
    """Both places of every corresponding point, in the item's frame: they should coincide."""
    places = []
    by_id = {view.view_id: view for view in views}
    for pair in garment.correspondences:
        for view_id, pixel in ((pair.view_a, pair.pixel_a), (pair.view_b, pair.pixel_b)):
            if view_id in by_id:
                # turned about the axis that was found, as everything else of the result is
                view = replace(by_id[view_id], calibration=garment.calibration)
                here = (view.pixel == np.array(pixel)).all(axis=1)
                places.append(view.points_hanger[here][:1])
    points = np.concatenate(places) if places else np.empty((0, 3))
    points = transform_points(T_rig_hanger, points)
    return _marker(header, "correspondences", 0, _SPHERE_LIST, points, scale=0.012, colour=GREEN)


def _outline(garment: FlatGarment, header: Fields, place: Any) -> Fields:
    outline = garment.outline
    closed = np.concatenate([outline.uv, outline.uv[:1]])
    ends = _segments(place(closed)[None]).reshape(-1, 3)
    colours = np.where(np.repeat(outline.inferred, 2)[:, None], ORANGE, BLUE)
    return _marker(header, "outline", 0, _LINE_LIST, ends, scale=0.004, colours=colours)


def _sizes(garment: FlatGarment, header: Fields, place: Any) -> Fields:
    ends = [m.ends_uv for m in garment.measurements if m.ends_uv and m.name in ("width", "length")]
    flat = np.array(ends, dtype=float).reshape(-1, 2)
    return _marker(header, "sizes", 0, _LINE_LIST, place(flat), scale=0.003, colour=VERMILION)


def _landmarks(garment: FlatGarment, header: Fields, T_rig_hanger: Float) -> list[Fields]:
    seen = [mark for mark in garment.landmarks if mark.seen]
    xyz = np.array([mark.xyz_hanger for mark in seen], dtype=float).reshape(-1, 3)
    points = transform_points(T_rig_hanger, xyz)
    markers = [_marker(header, "landmarks", 0, _SPHERE_LIST, points, scale=0.014, colour=ORANGE)]
    for i, (mark, point) in enumerate(zip(seen, points, strict=True)):
        text = _marker(header, "landmark_names", i, _TEXT, scale=0.02, colour=WHITE)
        text["pose"]["position"] = point_fields(point)
        text["text"] = mark.name
        markers.append(text)
    return markers


def _segments(nodes: Float) -> Float:
    """(lines, nodes, 3) -> (lines, nodes - 1, 2, 3) ends of the segments."""
    ends: Float = np.stack([nodes[:, :-1], nodes[:, 1:]], axis=2)
    return ends


def _marker(
    header: Fields,
    namespace: str,
    marker_id: int,
    kind: int,
    points: NDArray[Any] | None = None,
    *,
    scale: float = 0.0,
    colour: Sequence[float] = WHITE,
    colours: NDArray[Any] | None = None,
    action: int = 0,
) -> Fields:
    """visualization_msgs/Marker with every field set."""
    rgba = ("r", "g", "b", "a")
    thick = scale if kind in (_SPHERE_LIST, _POINTS, _TEXT) else 0.0
    return {
        "header": header,
        "ns": namespace,
        "id": marker_id,
        "type": kind,
        "action": action,
        "pose": {
            "position": point_fields((0.0, 0.0, 0.0)),
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
        "scale": point_fields((scale, thick, thick)),
        "color": {key: f32(v) for key, v in zip(rgba, colour, strict=True)},
        "lifetime": {"sec": 0, "nanosec": 0},
        "frame_locked": False,
        "points": [] if points is None else [point_fields(row) for row in points.tolist()],
        "colors": []
        if colours is None
        else [dict(zip(rgba, row, strict=True)) for row in colours.astype(np.float32).tolist()],
        "texture_resource": "",
        "texture": {"header": header_fields(0, ""), "format": "", "data": np.empty(0, np.uint8)},
        "uv_coordinates": [],
        "text": "",
        "mesh_resource": "",
        "mesh_file": {"filename": "", "data": np.empty(0, np.uint8)},
        "mesh_use_embedded_materials": False,
    }
