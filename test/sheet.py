"""A bent sheet of known flat places as a depth camera sees it, with a print if wanted."""

from __future__ import annotations

import cv2
import numpy as np
from garments import BELOW_TIP_M, CALIBRATION

from vflatten_ros.core.geometry import transform_points
from vflatten_ros.core.values import Correspondence, View

RADIUS_M, WIDTH_M, HEIGHT_M = 0.1, 0.26, 0.25  # 149 degrees of a cylinder
ANGLES_RAD = (-0.7, 0.7)  # the sheet's sides turn more than 90 degrees away


def seen_from(
    view_id: int,
    angle_rad: float,
    rows=480,
    cols=360,
    focal=520.0,
    colour=None,
    noise=0.0,
    size=(RADIUS_M, WIDTH_M, HEIGHT_M),
):
    """The sheet where the rays of the camera meet it, and its flat places.

    `size`: radius, width and height, m. `colour` takes (n, 2) flat places to (n,) grey values.
    """
    radius_m, width_m, height_m = size
    T_rig_hanger = CALIBRATION.T_rig_hanger(angle_rad)
    row, col = (v.ravel() for v in np.mgrid[0:rows, 0:cols])
    ray = np.c_[(col - (cols - 1) / 2) / focal, (row - (rows - 1) / 2) / focal, np.ones(len(row))]
    eye = -T_rig_hanger[:3, :3].T @ T_rig_hanger[:3, 3]
    way = ray @ T_rig_hanger[:3, :3]
    a, b = (way[:, :2] ** 2).sum(1), way[:, :2] @ eye[:2]
    root = b**2 - a * (eye[:2] @ eye[:2] - radius_m**2)
    met = root > 0
    depth = (-b[met] - np.sqrt(root[met])) / a[met]
    at = eye + depth[:, None] * way[met]
    u, v = radius_m * np.arctan2(at[:, 1], at[:, 0]), at[:, 2] + BELOW_TIP_M
    inside = (np.abs(u) < width_m / 2) & (v < 0) & (v > -height_m)
    pixel = np.c_[row[met], col[met]][inside].astype(np.int32)
    points = transform_points(T_rig_hanger, at[inside])
    flat = np.c_[u, v][inside]
    if noise:
        points = points * (1 + np.random.default_rng(view_id).normal(0, noise, (len(points), 1)))
    rgb = None
    if colour is not None:
        grey = np.clip(colour(flat), 0, 255).astype(np.uint8)
        rgb = np.repeat(grey[:, None], 3, axis=1)
    view = View(view_id, 0, angle_rad, points, pixel, rgb, (rows, cols), CALIBRATION)
    return view, flat


def a_print(flat):
    """Grey values of blobs of every size, which do not repeat."""
    image = np.random.default_rng(5).uniform(0, 255, (120, 120)).astype(np.float32)
    image = cv2.GaussianBlur(image, (0, 0), 1.5)
    image = (image - image.mean()) / image.std() * 45 + 128
    cell = ((flat + np.array([WIDTH_M / 2, HEIGHT_M])) / 0.0026).astype(np.float32)
    inside = cv2.remap(image, cell[:, :1], cell[:, 1:], cv2.INTER_LINEAR)
    return inside[:, 0].astype(float)


def plain(flat):
    """One grey value and the noise of a camera."""
    return 120 + np.random.default_rng(6).normal(0, 1.5, len(flat))


def stripes(flat):
    """Level stripes that repeat every 16 mm."""
    return 128 + 60 * np.sign(np.sin(2 * np.pi * flat[:, 1] / 0.016))


def pair_at(views, flats, u: float, v: float, slip_m: float = 0.0) -> Correspondence:
    """The pixels nearest to a place of the cloth; `slip_m` to the side of it in the second view."""
    near = [
        int(np.linalg.norm(flat - place, axis=1).argmin())
        for flat, place in zip(flats, ([u, v], [u + slip_m, v]), strict=True)
    ]
    a, b = (tuple(view.pixel[i].tolist()) for view, i in zip(views, near, strict=True))
    return Correspondence(views[0].view_id, views[1].view_id, a, b)
