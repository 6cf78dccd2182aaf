"""What each view saw, and so whether the cloth ends where its sheet does or goes on out of sight.

Where a camera looks past the end of a sheet at something farther away, or at nothing, the cloth
ends there. Where no camera that sees the end does, other cloth is in the way, or the sheet turns
into a fold: it goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.geometry import inverse, transform_points
from vflatten_ros.core.raygrid import RayGrid, camera_rays
from vflatten_ros.core.values import Bool, Float, Int

BEYOND_M = 0.012  # from the end of a sheet to where a camera is asked what lies there
MARGIN_M = 0.004  # what is as much farther away lies behind
NEARER_M, FARTHER_M = 0.006, 0.020  # of the depth at a sample's pixel, if that shows the sample
FACING = 0.15  # least cosine between the normal and the direction to the camera
AROUND_PX = 3  # pixels across: all must agree
FREE_SHARE = 0.3  # of the views that see an end, that must look past it

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Sight:
    """Depths of the item in one organised view."""

    grid: RayGrid  # its frame is that of the points it was made of
    low: Int  # (2,) row and column of the first pixel of the image
    depth: Float32  # (rows, cols) least of the pixels around; inf where none shows the item
    shape: tuple[int, int]  # rows and columns of the image

    def behind(self, points: Float) -> Float:
        """How much farther away than points (n, 3) the item is along their rays, m.

        Infinite where the view shows nothing of it, not a number beyond the image.
        """
        place, depth = self.grid.to_grid(points)
        at = np.rint(place).astype(np.int64)
        beyond = ((at < 0) | (at >= self.shape)).any(axis=1)
        row, col = (at - self.low).T
        rows, cols = self.depth.shape
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        there = self.depth[row.clip(0, rows - 1), col.clip(0, cols - 1)]
        behind: Float = np.where(beyond, np.nan, np.where(inside, there, np.inf) - depth)
        return behind


@dataclass(frozen=True, eq=False)
class PlacedSight:
    """A view's depths, and where the view is."""

    sight: Sight
    T_common_view: Float  # (4, 4) takes the frame of the sight to the common one

    def facing(self, xyz: Float, normal: Float, least: float) -> Bool:
        """Whether surfaces (n, 3) with normals (n, 3), common frame, face it by a cosine."""
        grid = self.sight.grid
        if grid.parallel:
            toward = np.broadcast_to(-self.T_common_view[:3, :3] @ grid.ray0, xyz.shape)
        else:
            toward = transform_points(self.T_common_view, grid.origin[None]) - xyz
        facing: Bool = (toward * normal).sum(1) > least * np.linalg.norm(toward, axis=1)
        return facing


def sight_of(points: Float, pixel: NDArray[np.int32], shape: tuple[int, int]) -> Sight | None:
    """Depths of one view's points; None where the cloud is not that of a camera.

    Parameters
    ----------
    points : ndarray of shape (n, 3)
    pixel : ndarray of shape (n, 2)
        Row and column of each.
    shape : (int, int)
        Rows and columns of the cloud.
    """
    grid = camera_rays(points, pixel, shape) if shape[0] > 1 else None
    if grid is None:
        return None
    low = pixel.min(axis=0) - AROUND_PX
    row, col = (pixel - low).T
    depth = np.full(pixel.max(axis=0) - low + AROUND_PX + 1, np.inf, dtype=np.float32)
    depth[row, col] = grid.to_grid(points)[1]
    around = np.ones((AROUND_PX, AROUND_PX), np.uint8)
    return Sight(grid, low.astype(np.int64), np.asarray(cv2.erode(depth, around)), shape)


def goes_on(xyz: Float, normal: Float, outward: Float, sights: Sequence[PlacedSight]) -> Int:
    """Whether cloth goes on out of sight beyond the ends of its sheets.

    Parameters
    ----------
    xyz, normal : ndarray of shape (n, 3)
        Samples at the end of what was seen of their sheets, and their normals, common frame.
    outward : ndarray of shape (n, 3)
        Unit, along the sheet, towards what was not seen.
    sights : sequence of PlacedSight

    Returns
    -------
    ndarray of shape (n,)
        1: it goes on, 0: it ends, -1: no view tells.
    """
    seen, free = np.zeros(len(xyz)), np.zeros(len(xyz))
    for placed in sights:
        T_view_common = inverse(placed.T_common_view)
        behind = placed.sight.behind(transform_points(T_view_common, xyz))
        beyond = transform_points(T_view_common, xyz + BEYOND_M * outward)
        there = placed.sight.behind(beyond)
        here = placed.facing(xyz, normal, FACING) & (behind > -NEARER_M) & (behind < FARTHER_M)
        seen += here
        free += here & (there > MARGIN_M)  # not what lies beyond the image: there may be cloth
    ends = free >= np.maximum(FREE_SHARE * seen, 1.0)
    return np.where(seen > 0, np.where(ends, 0, 1), -1)
