"""Small motions of views in the hanger frame, and the error of the calibrated axis behind them.

The item sways and lags: every view has a motion of its own. Where the axis is off, all views share
the motion that takes the calibrated axis to the true one, each turned back by its angle.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.geometry import Float, rigid, rotation_about

AXIS = 4  # numbers of the axis error: two of its lean, rad, two of its place, m
UP = np.array([0.0, 0.0, 1.0])


def parameters(poses: Sequence[Float]) -> Float:
    """(6n,) rotation vector, rad, and shift, m, of each pose (4, 4).

    To a hundredth up to 14 degrees.
    """
    flat = np.zeros(6 * len(poses))
    for k, pose in enumerate(poses):
        skew = (pose[:3, :3] - pose[:3, :3].T) / 2
        flat[6 * k : 6 * k + 3] = skew[2, 1], skew[0, 2], skew[1, 0]
        flat[6 * k + 3 : 6 * k + 6] = pose[:3, 3]
    return flat


def stepped(pose: Float, change: Float) -> Float:
    """A pose (4, 4) followed by a rotation vector and shift (6,)."""
    angle = float(np.linalg.norm(change[:3]))
    axis = change[:3] / angle if angle > 1e-12 else UP
    return rigid(rotation_about(axis, angle), change[3:]) @ pose


def own_information(config: RotationConfig) -> Float:
    """(6,) of a view's own motion: the inverse of its variances."""
    return 1 / np.array([np.radians(config.lag_deg)] * 3 + [config.sway_m] * 3) ** 2


def axis_information(config: RotationConfig) -> Float:
    """(4,) of the axis error."""
    return 1 / np.array([np.radians(config.axis_deg)] * 2 + [config.axis_m] * 2) ** 2


def effect(angle_rad: float) -> Float:
    """(6, 4) motion of a view by the axis error: one at angle a sees it turned by -a."""
    back = rotation_about(UP, -angle_rad)[:, :2]
    turned = np.zeros((6, AXIS))
    turned[:3, :2], turned[3:, 2:] = back, back
    return turned


def axis_error(
    angles_rad: Sequence[float], poses: Sequence[Float], config: RotationConfig
) -> Float:
    """Error of the calibrated axis that the views' poses tell of.

    Parameters
    ----------
    angles_rad : sequence of float
        Of the views.
    poses : sequence of ndarray of shape (4, 4)
        Of the views, each takes its hanger coordinates to the common ones.
    config : RotationConfig
        What is usual: of sway, lag and the axis.

    Returns
    -------
    ndarray of shape (4,)
        x and y of a rotation vector, rad, and of a shift, m, in the hanger frame at angle 0; the
        motion that they make takes the true axis to the calibrated one.
    """
    own, right = own_information(config), np.zeros(AXIS)
    normal = np.diag(axis_information(config))
    for angle_rad, pose in zip(angles_rad, poses, strict=True):
        turned = effect(angle_rad)
        normal += turned.T @ (own[:, None] * turned)
        right += turned.T @ (own * parameters([pose]))
    error: Float = np.linalg.solve(normal, right)
    return error
