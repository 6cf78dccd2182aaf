"""The viewing rays of one observation as a regular grid, so that a view's surface is a depth image.

A point is (row, col, depth): P = origin + row * e_row + col * e_col + depth * ray(row, col), with
ray = ray0 + row * ray_row + col * ray_col. A pinhole camera has e_row = e_col = 0, parallel
viewing has ray_row = ray_col = 0. Noise is along the rays: smoothing works on depths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.geometry import Float


@dataclass(frozen=True, eq=False)
class RayGrid:
    """Grid of rays; see the module."""

    origin: Float  # (3,)
    e_row: Float  # (3,) metres a row, zero for a pinhole
    e_col: Float
    ray0: Float  # (3,)
    ray_row: Float  # (3,) zero for parallel rays
    ray_col: Float
    matrix: Float  # (3, 4) homogeneous points to (row, col, 1) * scale
    shape: tuple[int, int]

    @property
    def parallel(self) -> bool:
        """Whether all rays have one direction."""
        return not self.ray_row.any()

    def spacing(self, depth: float) -> float:
        """Metres across the rays from one grid line to the next."""
        row, col = self.e_row + depth * self.ray_row, self.e_col + depth * self.ray_col
        return float(np.sqrt(np.linalg.norm(row) * np.linalg.norm(col)))

    def rays(self, rc: Float) -> Float:
        """(..., 3) ray (not of unit length) at (..., 2) grid places."""
        ray: Float = self.ray0 + rc[..., :1] * self.ray_row + rc[..., 1:] * self.ray_col
        return ray

    def to_points(self, rc: Float, depth: Float) -> Float:
        """(..., 3) points at (..., 2) grid places and (...) depths."""
        base = self.origin + rc[..., :1] * self.e_row + rc[..., 1:] * self.e_col
        points: Float = base + depth[..., None] * self.rays(rc)
        return points

    def to_grid(self, points: Float) -> tuple[Float, Float]:
        """(..., 2) grid places and (...) depths of (..., 3) points."""
        x = points @ self.matrix[:, :3].T + self.matrix[:, 3]
        if self.parallel:
            return x[..., :2], (points - self.origin) @ self.ray0
        return x[..., :2] / x[..., 2:], x[..., 2]

    def tangents(self, rc: Float, depth: Float, slope: Float) -> tuple[Float, Float]:
        """(..., 3) change of the point a row and a column; slope (..., 2) is depth's change."""
        ray = self.rays(rc)
        by_row = self.e_row + depth[..., None] * self.ray_row + slope[..., :1] * ray
        by_col = self.e_col + depth[..., None] * self.ray_col + slope[..., 1:] * ray
        return by_row, by_col

    def moved(self, rc_offset: Float, shape: tuple[int, int]) -> RayGrid:
        """The same rays counted from another row and column."""
        shift = np.eye(3)
        shift[:2, 2] = -rc_offset
        row, col = rc_offset
        return RayGrid(
            self.origin + row * self.e_row + col * self.e_col, self.e_row, self.e_col,
            self.rays(np.asarray(rc_offset, float)), self.ray_row, self.ray_col,
            shift @ self.matrix, shape,
        )  # fmt: skip

    def coarser(self, block: int) -> RayGrid:
        """Every place the middle of `block` by `block` of the places before."""
        middle = self.moved(np.full(2, (block - 1) / 2), self.shape)
        rows, cols = (-(-n // block) for n in self.shape)
        scale = np.diag([1 / block, 1 / block, 1.0])
        return RayGrid(
            middle.origin, block * self.e_row, block * self.e_col, middle.ray0,
            block * self.ray_row, block * self.ray_col, scale @ middle.matrix, (rows, cols),
        )  # fmt: skip


def parallel_rays(origin: Float, e_row: Float, e_col: Float, shape: tuple[int, int]) -> RayGrid:
    """Rays along e_row x e_col through a grid of places."""
    ray = np.cross(e_row, e_col)
    ray /= np.linalg.norm(ray)
    rows = np.linalg.inv(np.stack([e_row, e_col, ray], axis=1))
    matrix = np.zeros((3, 4))
    matrix[:2, :3] = rows[:2]
    matrix[:2, 3] = -rows[:2] @ origin
    matrix[2, 3] = 1.0
    zero = np.zeros(3)
    return RayGrid(origin, e_row, e_col, ray, zero, zero, matrix, shape)


def camera_rays(points: Float, pixel: NDArray[np.int32], shape: tuple[int, int]) -> RayGrid | None:
    """The rays that see each point at its pixel; None if no parallel or pinhole camera does.

    Noise along the rays leaves each point at its pixel, so the fit is exact but for rounding.
    """
    step = max(1, len(points) // 4000)
    sample, rc = points[::step], pixel[::step].astype(float)
    if np.ptp(rc, axis=0).min() < 1.0:
        return None  # one row or column: many cameras fit
    scale = max(float(np.ptp(rc)), 1.0)
    ones = np.concatenate([sample, np.ones((len(sample), 1))], axis=1)
    fit, *_ = np.linalg.lstsq(ones, rc, rcond=None)
    if np.abs(ones @ fit - rc).max() < 0.02:
        to_place = np.linalg.pinv(fit[:3].T)  # columns e_row, e_col, square to the rays
        e_row, e_col = to_place.T.copy()
        origin = -to_place @ fit[3]
        return parallel_rays(origin, e_row, e_col, shape)
    middle, size = sample.mean(axis=0), sample.std()
    p = np.concatenate([(sample - middle) / size, np.ones((len(sample), 1))], axis=1)
    x = (rc - rc.mean(axis=0)) / scale
    zero = np.zeros_like(p)
    system = np.concatenate(
        [
            np.concatenate([p, zero, -x[:, :1] * p], axis=1),
            np.concatenate([zero, p, -x[:, 1:] * p], axis=1),
        ]
    )
    _, values, vectors = np.linalg.svd(system.T @ system)
    if values[-2] < 1e-9 * values[0]:
        return None  # points on one plane: many cameras fit
    matrix = vectors[-1].reshape(3, 4)
    into = np.eye(4)
    into[:3, :3] /= size
    into[:3, 3] = -middle / size
    out = np.diag([scale, scale, 1.0])
    out[:2, 2] = rc.mean(axis=0)
    matrix = out @ matrix @ into
    matrix /= np.linalg.norm(matrix[2, :3]) * np.sign((ones @ matrix[2]).mean())
    seen = ones @ matrix.T
    if np.abs(seen[:, :2] / seen[:, 2:] - rc).max() > 0.05:
        return None
    inverse = np.linalg.inv(matrix[:, :3])
    ray_row, ray_col, ray0 = inverse.T.copy()  # no views, which add up otherwise than their copies
    zero = np.zeros(3)
    return RayGrid(
        -inverse @ matrix[:, 3], zero, zero, ray0, ray_row, ray_col, matrix, shape
    )  # fmt: skip
