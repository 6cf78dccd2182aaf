"""Transforms from TF, where tf2_ros is installed; it is not on PyPI, so nothing depends on it."""

from __future__ import annotations

from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.time import Time

from vflatten_ros.core.errors import InvalidCalibration
from vflatten_ros.core.geometry import Float, rigid
from vflatten_ros.parameters import CalibrationOptions
from vflatten_ros.session import UNKNOWN_NAME, Refused

try:
    import tf2_ros
except ImportError:
    tf2_ros = None

NO_TF = (
    "tf2_ros is not installed, so frames cannot be looked up (apt-get install ros-jazzy-tf2-ros-py)"
)


class Frames:
    """Looks transforms up in TF; without tf2_ros every look-up says so."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._buffer: Any = None

    def open(self) -> bool:
        """Begin to listen, at the first need: nobody pays for an unused listener. False: no TF."""
        if self._buffer is None and tf2_ros is not None:
            self._buffer = tf2_ros.Buffer(node=self._node)
            self._listener = tf2_ros.TransformListener(self._buffer, self._node)
        return self._buffer is not None

    def matrix(self, target: str, source: str) -> Float:
        """(4, 4) newest T_target_source. Raises Refused."""
        if tf2_ros is None:
            raise Refused(UNKNOWN_NAME, f"frame {target!r} is not {source!r}, and {NO_TF}")
        self.open()
        try:
            found = self._buffer.lookup_transform(target, source, Time()).transform
        except tf2_ros.TransformException as error:
            raise Refused(
                UNKNOWN_NAME, f"no transform from {source!r} to {target!r}: {error}"
            ) from error
        q, t = found.rotation, found.translation
        return rigid(_rotation(q.x, q.y, q.z, q.w), np.array([t.x, t.y, t.z]))

    def known(self, target: str, source: str) -> bool:
        """Whether a transform between the two has come."""
        return self._buffer is not None and bool(self._buffer.can_transform(target, source, Time()))

    def calibration_values(self, options: CalibrationOptions) -> dict[str, Any]:
        """Axis and gripper tip of `calibration.tf_frame` in the rig frame."""
        try:
            pose = self.matrix(options.frame, options.tf_frame)
        except Refused as error:
            raise InvalidCalibration(f"calibration.tf_frame: {error}") from error
        origin = pose[:3, 3].tolist()
        return {"axis_point": origin, "gripper_tip": origin, "axis_direction": pose[:3, 2].tolist()}


def _rotation(x: float, y: float, z: float, w: float) -> Float:
    """(3, 3) rotation of a unit quaternion."""
    q = np.array([x, y, z])
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Float = (w * w - q @ q) * np.eye(3) + 2.0 * np.outer(q, q) + 2.0 * w * cross
    return rotation
