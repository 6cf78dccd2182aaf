"""What a result is published as: the same messages by the node and in `vflatten replay --mcap`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from vflatten_ros import displays, messages
from vflatten_ros.core.values import FlatGarment, View
from vflatten_ros.messages import Fields
from vflatten_ros.picture import draw_flat

TYPES = {  # of the topics below the node's name
    "flattened_view": "vflatten_ros/FlattenedView",
    "garment": "vflatten_ros/GarmentEstimate",
    "contour": "geometry_msgs/PolygonStamped",
    "markers": "visualization_msgs/MarkerArray",
    "points": "sensor_msgs/PointCloud2",
    "image": "sensor_msgs/Image",
}


class Message(NamedTuple):
    """One message to write."""

    topic: str
    type: str  # "package/Name"
    stamp_ns: int
    fields: Fields


def result_messages(garment: FlatGarment, views: Sequence[View], item: int = 0) -> list[Message]:
    """What the node would publish, on the node's topics; `item` 0: not of a node."""
    fields: dict[str, Fields] = {
        "flattened_view": messages.flattened_view_fields(garment, views, item),
        "garment": messages.garment_estimate_fields(garment, views, item),
        "contour": displays.contour_fields(garment),
        "markers": displays.marker_fields(garment, views),
        "points": displays.points_fields(garment, views),
        "image": displays.image_fields(draw_flat(garment), garment.stamp_ns),
    }
    return [
        Message(f"/vflatten/{name}", kind, garment.stamp_ns, fields[name])
        for name, kind in TYPES.items()
    ]
