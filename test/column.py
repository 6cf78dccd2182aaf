"""Views of a crumpled column that turns: what it looks like is known from everywhere."""

from __future__ import annotations

import numpy as np

from vflatten_ros.core.geometry import rotation_about, transform_points
from vflatten_ros.core.values import Calibration, View

CALIBRATION = Calibration(
    "rig", (0.0, -0.4, 1.3), (0.0, -1.0, 0.0), (0.0, -0.4, 1.3), "wrist", 1.0, 0.0
)
UP = np.array([0.0, 0.0, 1.0])


def body():
    """A crumpled column round the axis in the hanger frame: points and outward normals."""
    height, angle = np.mgrid[-0.5:-0.05:0.004, 0 : 2 * np.pi : 0.05]
    height, angle = height.ravel(), angle.ravel()
    radius = 0.08 + 0.02 * np.cos(3 * angle + 8 * height) + 0.01 * np.sin(25 * height)
    xyz = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    return xyz, np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])


def views_of(motions, noise_m=0.0, calibration=CALIBRATION, assumed=CALIBRATION, shared_m=0.0):
    """Views at even angles of the body, moved before it turns by (shift_m, lag_rad).

    Neighbouring points of a view have noise of shared_m in common, along the line of sight.
    """
    xyz, normal = body()
    views, rng = [], np.random.default_rng(7)
    for k, (shift, lag) in enumerate(motions):
        angle = 2 * np.pi * k / len(motions)
        turn = rotation_about(UP, lag)
        T = calibration.T_rig_hanger(angle)
        moved = transform_points(T, xyz @ turn.T + shift)
        facing = ((normal @ turn.T @ T[:3, :3].T) * -moved).sum(1) > 0.3 * np.linalg.norm(
            moved, axis=1
        )
        points = moved[facing] + rng.normal(0, noise_m, (int(facing.sum()), 3))
        if shared_m:
            points = points * (1.0 + shared_m * bumps(points, rng) / points[:, 2:])
        pixel = np.zeros((len(points), 2), dtype=np.int32)
        views.append(View(k, k, angle, points, pixel, None, (480, 360), assumed))
    return views


def bumps(points, rng, width_m=0.015):
    """(n, 1) noise of standard deviation 1 that points nearer than width_m have in common."""
    wave = rng.normal(0, 1 / width_m, (64, 3))
    phase = rng.uniform(0, 2 * np.pi, 64)
    return np.cos(points @ wave.T + phase).sum(1, keepdims=True) / np.sqrt(32)
