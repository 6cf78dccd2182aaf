"""An upright column on the wrist's axis, as a camera sees it whose edges may be fat."""

from __future__ import annotations

import cv2
import numpy as np

from vflatten_ros.core.values import Calibration, View

CALIBRATION = Calibration(
    "rig", (0.0, -0.4, 1.3), (0.0, -1.0, 0.0), (0.0, -0.4, 1.3), "wrist", 1.0, 0.0
)
FOCAL_PX, ROWS, COLS = 520.0, 90, 140
RADIUS_M = 0.1
PITCH_M = 1.3 / FOCAL_PX
VIEWS = 24


def column(angle_rad, fat, noise_m=0.0005, seed=0):
    """A view of an upright column on the wrist's axis, its edges fat by some pixels."""
    row, col = np.indices((ROWS, COLS))
    x, y = (col - (COLS - 1) / 2) / FOCAL_PX, (row - 20.0) / FOCAL_PX
    # |(x z, z) - (0, 1.3)| = RADIUS_M
    half = 1.3**2 - (1.3**2 - RADIUS_M**2) * (1 + x**2)
    nothing = 9.0
    depth = np.where(half > 0, (1.3 - np.sqrt(np.maximum(half, 0))) / (1 + x**2), nothing)
    near = cv2.erode(depth, np.ones((2 * fat + 1, 2 * fat + 1), np.uint8))
    depth = np.where(depth - near > 0.01, near, depth)
    depth[depth > 2.0] = np.nan
    depth += np.random.default_rng([seed, round(100 * angle_rad)]).normal(0, noise_m, depth.shape)
    pixel = np.argwhere(np.isfinite(depth)).astype(np.int32)
    at = tuple(pixel.T)
    points = np.column_stack([x[at] * depth[at], y[at] * depth[at], depth[at]])
    return View(0, 0, angle_rad, points, pixel, None, (ROWS, COLS), CALIBRATION)
