"""Numbers of a calibration file or of parameters to a checked Calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vflatten_ros.core.arrays import as_vector
from vflatten_ros.core.errors import InvalidCalibration, InvalidInput
from vflatten_ros.core.geometry import Float
from vflatten_ros.core.values import Calibration

KEYS = {
    "frame": "frame_id of the clouds",
    "axis_point": "a point of the wrist axis, rig frame, m",
    "axis_direction": "direction of the wrist axis, upwards, rig frame",
    "gripper_tip": "where the item is held, rig frame, m",
    "joint": "name of the wrist joint in the joint states",
    "joint_sign": "+1 or -1",
    "joint_zero": "joint position at item angle 0, rad",
}
MAX_TIP_OFFSET_M = 0.3  # a gripper holds its item on or near the wrist axis
MAX_DISTANCE_M = 100.0  # larger coordinates are millimetres by mistake


def calibration_from(values: Mapping[str, Any]) -> Calibration:
    """A calibration whose every number has been checked; other keys are ignored.

    Parameters
    ----------
    values : mapping
        The keys of `KEYS`; vectors as sequences of three numbers.

    Returns
    -------
    Calibration
        axis_direction is normalised.

    Raises
    ------
    InvalidCalibration
        Names the key, what came and what to try.
    """
    if not isinstance(values, Mapping):
        raise InvalidCalibration(f"calibration: expected keys and values, got {values!r:.60}")
    for key, meaning in KEYS.items():
        if values.get(key) is None:
            raise InvalidCalibration(f"calibration: {key} is missing; add {key}: {meaning}")
    point, tip = _place(values, "axis_point"), _place(values, "gripper_tip")
    direction = _direction(values)
    _check_axis(point, direction, tip)
    return Calibration(
        frame=_name(values, "frame"),
        axis_point=_triple(point),
        axis_direction=_triple(direction),
        gripper_tip=_triple(tip),
        joint=_name(values, "joint"),
        joint_sign=_sign(values),
        joint_zero_rad=_number(values, "joint_zero"),
    )


def _number(values: Mapping[str, Any], key: str) -> float:
    value = values[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InvalidCalibration(
            f"calibration: {key}: expected a number ({KEYS[key]}), got {value!r}"
        )
    return float(value)


def _sign(values: Mapping[str, Any]) -> float:
    sign = _number(values, "joint_sign")
    if sign not in (1.0, -1.0):
        raise InvalidCalibration(f"calibration: joint_sign: expected 1 or -1, got {sign:g}")
    return sign


def _name(values: Mapping[str, Any], key: str) -> str:
    name = values[key]
    if not isinstance(name, str) or not name.strip():
        raise InvalidCalibration(f"calibration: {key}: expected a name ({KEYS[key]}), got {name!r}")
    return name


def _vector(values: Mapping[str, Any], key: str) -> Float:
    try:
        return as_vector(values[key], key)
    except (InvalidInput, TypeError, ValueError) as error:
        raise InvalidCalibration(
            f"calibration: {key}: expected three finite numbers ({KEYS[key]}), got {values[key]!r}"
        ) from error


def _place(values: Mapping[str, Any], key: str) -> Float:
    place = _vector(values, key)
    if np.abs(place).max() > MAX_DISTANCE_M:
        raise InvalidCalibration(
            f"calibration: {key}: {place.tolist()} is farther than {MAX_DISTANCE_M:g} m; "
            "give metres, not millimetres"
        )
    return place


def _direction(values: Mapping[str, Any]) -> Float:
    direction = _vector(values, "axis_direction")
    length = float(np.linalg.norm(direction))
    if length < 1e-6:
        raise InvalidCalibration(
            f"calibration: axis_direction: {direction.tolist()} has no length; give the upward "
            "direction of the wrist axis, in an optical frame near [0, -1, 0]"
        )
    unit: Float = direction / length
    return unit


def _check_axis(point: Float, direction: Float, tip: Float) -> None:
    # The hanger frame's x axis points from the wrist axis towards the rig.
    distance = float(np.linalg.norm(np.cross(point, direction)))
    if distance < 0.05:
        raise InvalidCalibration(
            f"calibration: axis_point: the axis passes {distance:.3f} m from the rig's origin, "
            "where the camera is; check axis_point and axis_direction"
        )
    offset = float(np.linalg.norm(np.cross(tip - point, direction)))
    if offset > MAX_TIP_OFFSET_M:
        raise InvalidCalibration(
            f"calibration: gripper_tip: lies {offset:.3f} m from the wrist axis, expected at most "
            f"{MAX_TIP_OFFSET_M} m; check gripper_tip, axis_point and axis_direction"
        )


def _triple(vector: Float) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
