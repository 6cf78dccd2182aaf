"""From a recording to a calibration with the axis that its views show: `vflatten calibrate`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from vflatten_ros.bag import gather_views, open_recording
from vflatten_ros.core.config import Config
from vflatten_ros.core.turning import Axis, apart, refine_axis
from vflatten_ros.core.values import Calibration, Progress, View, no_progress
from vflatten_ros.files import calibration_beside, load_calibration

SETTLED_M, SETTLED_RAD = 0.002, np.radians(0.2)  # by which the item is cut out of the clouds alike
TIMES = 3  # of cutting it out, at most


@dataclass(frozen=True, eq=False)
class Calibrated:
    """An axis, and what it was found by."""

    axis: Axis
    given: Calibration
    views: tuple[View, ...]  # by the axis


def calibrate_recording(
    path: Path,
    config: Config,
    *,
    calibration: Path | None = None,
    cloud_topic: str | None = None,
    joint_topic: str | None = None,
    progress: Progress = no_progress,
    warn: Callable[[str], None] = lambda text: None,
) -> Calibrated:
    """The calibration of a rig, by any cloth that hung still while it was turned.

    Parameters
    ----------
    path : Path
        rosbag2 folder or .mcap file.
    config : Config
    calibration : Path, optional
        Measured roughly, to 10 cm and 10 degrees; by default calibration.yaml beside the recording.
    cloud_topic, joint_topic : str, optional
        Where the recording has several of the type.
    progress : Progress
    warn : callable
        Told what went wrong and could be worked round.

    Raises
    ------
    VFlattenError
        Says what came, what was expected, what to try.
    """
    progress("open", 0.0)
    given = load_calibration(calibration or calibration_beside(path))
    recording = open_recording(path, cloud_topic, joint_topic)
    rig = given
    for _ in range(TIMES):  # an axis that is off may cut the item
        views = gather_views(recording, rig, config, progress).views()
        found = refine_axis(views, config.rotation, progress)
        rig = found.calibration
        if found.moved_m < SETTLED_M and found.leaned_rad < SETTLED_RAD:
            break
    moved_m, leaned_rad = apart(given, rig)
    for text in dict.fromkeys(recording.warnings):
        warn(text)
    axis = replace(found, moved_m=moved_m, leaned_rad=leaned_rad)
    turned = rig.joint_sign * views[0].calibration.joint_sign  # the sign may have been found last
    by_axis = (replace(v, calibration=rig, angle_rad=turned * v.angle_rad) for v in views)
    return Calibrated(axis, given, tuple(by_axis))


def calibration_text(axis: Axis) -> str:
    """calibration.yaml that has this axis, and how far off it was."""
    found = axis.calibration
    values = {
        "frame": found.frame,
        "axis_point": list(found.axis_point),
        "axis_direction": list(found.axis_direction),
        "gripper_tip": list(found.gripper_tip),
        "joint": found.joint,
        "joint_sign": int(found.joint_sign),
        "joint_zero": found.joint_zero_rad,
    }
    return (
        f"# By vflatten calibrate. The axis was {1e3 * axis.moved_m:.1f} mm and "
        f"{np.degrees(axis.leaned_rad):.2f} degrees off.\n"
        f"# {axis.agreement.share:.0%} of the cloth in neighbouring views lies on itself.\n"
        f"{yaml.safe_dump(values, sort_keys=False, default_flow_style=None)}"
    )
