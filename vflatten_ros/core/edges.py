"""Where an item ends or hides itself in a view, in pixels."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.values import Float, Int, View

HOLE_PX = 5  # width of the gaps in the item that are no borders of it
STEP_M = 0.010  # least step of depth that is an edge
STEP_PITCHES = 3.0  # or so many distances of neighbouring points
MOST_PX = 6  # from an edge, that are told apart
FEWEST = 100  # points that are left of a view

Pixels = NDArray[np.int32]


def farther_around(pixel: Pixels, depth: Float, most_px: int) -> Float:
    """How much farther than each pixel of an item the farthest around it is.

    Parameters
    ----------
    pixel : ndarray of shape (n, 2)
        Row and column.
    depth : ndarray of shape (n,)
        Of each, m.
    most_px : int
        Up to so many pixels away, as a block.

    Returns
    -------
    ndarray of shape (most_px, n)
        Within 1, 2, ... pixels, m; infinite beside the border of the item. Its holes are none.
    """
    low = pixel.min(axis=0) - most_px - HOLE_PX
    row, col = (pixel - low).T
    item = np.zeros(pixel.max(axis=0) - low + 1 + most_px + HOLE_PX, np.uint8)
    item[row, col] = 1
    closed = cv2.morphologyEx(item, cv2.MORPH_CLOSE, np.ones((HOLE_PX, HOLE_PX), np.uint8))
    farthest = np.where(closed > 0, -np.inf, np.inf).astype(np.float32)
    farthest[row, col] = depth
    here = farthest[row, col]
    found = np.empty((most_px, len(pixel)))
    for k in range(most_px):
        farthest = np.asarray(cv2.dilate(farthest, np.ones((3, 3), np.uint8)))
        found[k] = farthest[row, col] - here
    return found


def pixels_to_edge(view: View, pitch_m: float) -> Int:
    """Pixels (n,) from each point of a view to where the item ends or hides itself: from 1.

    More than MOST_PX where no edge is so near. Neighbouring points are pitch_m apart.
    """
    depth = np.linalg.norm(view.points_rig, axis=1)
    step = max(STEP_M, STEP_PITCHES * pitch_m)
    beside = farther_around(view.pixel, depth, MOST_PX) > step
    near: Int = np.where(beside.any(axis=0), 1 + beside.argmax(axis=0), MOST_PX + 1)
    return near


def inside_edges(view: View, to_edge: Int, px: int) -> Int:
    """Rows of a view's points without `px` pixels at its edges; all, if hardly any were left."""
    rows = np.flatnonzero(to_edge > px)
    return rows if len(rows) >= FEWEST else np.arange(len(view.points_rig))


def with_rows(view: View, rows: Int) -> View:
    """Some points of a view."""
    rgb = None if view.rgb is None else view.rgb[rows]
    return replace(view, points_rig=view.points_rig[rows], pixel=view.pixel[rows], rgb=rgb)
