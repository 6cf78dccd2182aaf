"""Views of much finer images than the method needs, with the rows and columns that it needs.

Points that are nearer each other tell little more of layers that are some millimetres thick, and
each costs as much as any.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vflatten_ros.core.arrays import frozen
from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.values import Int, View

APART = 8  # points of a row by which their pitch is measured: noise hardly counts
FACING = 0.25  # share of the points, at least, that face the camera
FINER = 0.75  # of the pitch that the method is for, at most, from one that is left to the next
LEAST_M = 1e-5  # pitch


def thinned(view: View, config: RotationConfig) -> tuple[View, Int]:
    """The view as an image of every k-th row and column would give it.

    Parameters
    ----------
    view : View
        Of an unorganised cloud all points are needed.
    config : RotationConfig
        The pitch that its lengths are for.

    Returns
    -------
    View, ndarray of shape (n,)
        With pixels of the smaller image; and the rows of the given view's points.
    """
    step = _step_px(view, config)
    if step == 1:
        return view, np.arange(len(view.pixel))
    rows = np.flatnonzero((view.pixel % step == 0).all(axis=1))
    smaller = replace(
        view,
        points_rig=frozen(view.points_rig[rows]),
        pixel=frozen(view.pixel[rows] // step),
        rgb=None if view.rgb is None else frozen(view.rgb[rows]),
        shape=(-(-view.shape[0] // step), -(-view.shape[1] // step)),
    )
    return smaller, rows


def _step_px(view: View, config: RotationConfig) -> int:
    """Every how manieth row and column is needed."""
    points, pixel = view.points_rig, view.pixel
    across = pixel[APART:] - pixel[:-APART]
    in_row = (across[:, 0] == 0) & (across[:, 1] > 0)
    if view.shape[0] == 1 or not in_row.any():
        return 1
    away = int(across[in_row, 1].min())
    if away >= 2 * APART:  # some rows and columns are all that is left
        there = away // APART
        return there if (pixel % there == 0).all() else 1
    together = in_row & (across[:, 1] == away)
    apart_m = np.linalg.norm(points[APART:] - points[:-APART], axis=1)[together]
    pitch_m = max(float(np.quantile(apart_m, FACING)) / away, LEAST_M)
    return max(1, int(FINER * config.pitch_m / pitch_m))
