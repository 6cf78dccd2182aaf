"""The cloth's surface near every observed point, from noisy points of one view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d
from scipy.spatial import cKDTree

from vflatten_ros.core.arrays import as_points
from vflatten_ros.core.config import SurfaceConfig
from vflatten_ros.core.errors import InvalidInput
from vflatten_ros.core.raygrid import RayGrid, camera_rays, parallel_rays
from vflatten_ros.core.values import Bool, Float, Int, Progress, no_progress


@dataclass(frozen=True, eq=False)
class Surface:
    """Smoothed surface of one view."""

    points: Float  # (n, 3) input points moved along their rays onto the surface
    normals: Float  # (n, 3) unit, towards the viewer
    sigma_m: Float  # (n,) one standard deviation of points along the ray
    raw: Float  # (n, 3) input points
    rays: RayGrid
    depth: Float  # (rows, cols, 6) depth, its row and col slopes, and half second derivatives
    valid: Bool  # (rows, cols)
    layer: NDArray[np.int32]  # (rows, cols) part of the surface, 0: none
    sigma_grid_m: Float  # (rows, cols) standard deviation of depth along the ray
    spacing_m: float  # typical distance of grid neighbours
    toward: Float  # (3,) mean direction to the viewer
    config: SurfaceConfig


def fit_surface(
    points: Float,
    config: SurfaceConfig,
    toward: Float,
    pixel: NDArray[np.int32] | None = None,
    shape: tuple[int, int] | None = None,
    progress: Progress = no_progress,
) -> Surface:
    """Smooth the points of one view and find the surface between them.

    Parameters
    ----------
    points : ndarray of shape (n, 3)
        Observed points, metres, any frame.
    config : SurfaceConfig
        Fit and radius.
    toward : ndarray of shape (3,) or (n, 3)
        Direction from the points to the viewer.
    pixel : ndarray of shape (n, 2), optional
        Row and column of each point, for organised clouds.
    shape : (int, int), optional
        Rows and columns of the cloud.

    Returns
    -------
    Surface

    Raises
    ------
    InvalidInput
        Wrong shapes, values that are not finite, or fewer than 6 points.
    """
    points = as_points(points, "points")
    if len(points) < 6:
        raise InvalidInput(f"points: expected at least 6 to fit a surface, got {len(points)}")
    toward = np.broadcast_to(np.asarray(toward, float), points.shape)
    mean_toward = toward.mean(axis=0) / np.linalg.norm(toward.mean(axis=0))
    rays, rc = _grid(points, mean_toward, pixel, shape)
    progress("surface", 0.2)
    depth_of_points = rays.to_grid(points)[1]
    spacing = _spacing(points)
    radius = config.radius_m / _cell(rays, depth_of_points)
    cells = np.round(rc).astype(int)
    count = np.zeros(rays.shape)
    np.add.at(count, tuple(cells.T), 1.0)
    total = np.zeros(rays.shape)
    np.add.at(total, tuple(cells.T), depth_of_points)
    seen = count > 0
    image = np.where(seen, total / np.maximum(count, 1), 0.0)
    coefficients, gain = _quadratic_image(image, seen, radius / 1.75)
    progress("surface", 0.8)
    at = coefficients[tuple(cells.T)]
    offset = rc - cells
    depth = _evaluate(at, offset)
    slope = _slope(at, offset)
    smoothed = rays.to_points(rc, depth)
    by_row, by_col = rays.tangents(rc, depth, slope)
    normals = np.cross(by_row, by_col)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= np.sign(np.einsum("ij,ij->i", normals, toward))[:, None]
    noise = 1.4826 * np.median(np.abs(depth_of_points - depth))
    sigma = noise * np.sqrt(gain)
    return Surface(
        smoothed, normals, sigma[tuple(cells.T)], points, rays, coefficients, seen,
        _layers(image, seen), sigma, spacing, mean_toward, config,
    )  # fmt: skip


def _layers(image: Float, seen: Bool) -> NDArray[np.int32]:
    return seen.astype(np.int32)


def _spacing(points: Float) -> float:
    tree = cKDTree(points)
    near, _ = tree.query(points[:: max(1, len(points) // 500)], 2)
    return float(np.median(near[:, 1]))


def _cell(rays: RayGrid, depth: Float) -> float:
    """Metres across the rays from one grid line to the next."""
    middle = np.array([[rays.shape[0] / 2, rays.shape[1] / 2]])
    size = rays.e_row + np.median(depth) * rays.ray_row
    del middle
    return float(np.linalg.norm(size))


def _grid(
    points: Float,
    toward: Float,
    pixel: NDArray[np.int32] | None,
    shape: tuple[int, int] | None,
) -> tuple[RayGrid, Float]:
    """Rays and the place of every point on their grid, cropped to the points."""
    rays = None
    if pixel is not None and shape is not None and np.ptp(pixel[:, 0]) > 0:
        rays = camera_rays(points, pixel, shape)
    if rays is None:
        side = np.eye(3)[np.argmin(np.abs(toward))]
        e_row = np.cross(toward, side)
        e_row /= np.linalg.norm(e_row)
        e_col = np.cross(toward, e_row)
        flat = np.stack([points @ e_row, points @ e_col], axis=1)
        near, _ = cKDTree(flat).query(flat[:: max(1, len(flat) // 2000)], 2)
        step = max(float(np.median(near[:, 1])) * 1.5, 1e-6)
        rays = parallel_rays(np.zeros(3), e_row * step, e_col * step, (1, 1))
    place = rays.to_grid(points)[0]
    low = np.floor(place.min(axis=0)) - 4
    extent = np.ceil(place.max(axis=0)) - low + 5
    return rays.moved(low, (int(extent[0]), int(extent[1]))), place - low


def _quadratic_image(image: Float, seen: Bool, width: float) -> tuple[Float, Float]:
    """Weighted quadratic at every pixel; (rows, cols, 6) and the variance gain (rows, cols)."""
    reach = int(np.ceil(2.5 * width))
    t = np.arange(-reach, reach + 1) / width
    weight = np.exp(-t * t / 2)

    def moment(values: Float, a: int, b: int) -> Float:
        by_row = correlate1d(values, weight * t**a, axis=0, mode="constant")
        out: Float = correlate1d(by_row, weight * t**b, axis=1, mode="constant")
        return out

    powers = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
    mass = seen.astype(float)
    moments = {q: moment(mass, *q)[seen] for q in {(a + c, b + d) for a, b in powers for c, d in powers}}
    level = image[seen].mean()
    lifted = np.where(seen, image - level, 0.0)
    right = np.stack([moment(lifted, a, b)[seen] for a, b in powers], axis=-1)
    normal = np.stack(
        [np.stack([moments[a + c, b + d] for c, d in powers], axis=-1) for a, b in powers], axis=-2
    )
    ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(6)
    inverse = np.linalg.inv(normal + ridge)
    solved = np.einsum("nij,nj->ni", inverse, right)
    solved /= np.array([1, width, width, width**2, width**2, width**2])
    solved[:, 0] += level
    out = np.zeros((*seen.shape, 6))
    out[seen] = solved
    gain = np.zeros(seen.shape)
    gain[seen] = inverse[:, 0, 0]
    return out, gain


def _evaluate(c: Float, d: Float) -> Float:
    r, s = d[..., 0], d[..., 1]
    out: Float = (
        c[..., 0] + c[..., 1] * r + c[..., 2] * s
        + c[..., 3] * r * r + c[..., 4] * r * s + c[..., 5] * s * s
    )  # fmt: skip
    return out


def _slope(c: Float, d: Float) -> Float:
    r, s = d[..., 0], d[..., 1]
    return np.stack(
        [
            c[..., 1] + 2 * c[..., 3] * r + c[..., 4] * s,
            c[..., 2] + c[..., 4] * r + 2 * c[..., 5] * s,
        ],
        axis=-1,
    )


def depth_at(surface: Surface, rc: Float) -> tuple[Float, Float, Bool]:
    """Depth and slope of the surface between grid places, and whether it is observed there.

    The quadratics of the four grid places around blend with smooth weights.

    Parameters
    ----------
    rc : ndarray of shape (k, 2)
        Grid places.

    Returns
    -------
    depth (k,), slope (k, 2), supported (k,)
    """
    rows, cols = surface.valid.shape
    base = np.clip(np.floor(rc), 0, (rows - 2, cols - 2))
    f = np.clip(rc - base, 0.0, 1.0)
    smooth, rate = f * f * (3 - 2 * f), 6 * f * (1 - f)
    index = base.astype(np.int64)
    top = np.zeros(len(rc))
    d_top = np.zeros((len(rc), 2))
    mass = np.zeros(len(rc))
    d_mass = np.zeros((len(rc), 2))
    flat_valid = surface.valid.ravel()
    flat_depth = surface.depth.reshape(-1, 6)
    for i in (0, 1):
        for j in (0, 1):
            at: Int = (index[:, 0] + i) * cols + index[:, 1] + j
            wr = smooth[:, 0] if i else 1 - smooth[:, 0]
            wc = smooth[:, 1] if j else 1 - smooth[:, 1]
            ok = flat_valid[at]
            w = wr * wc * ok
            dw = np.stack(
                [(rate[:, 0] if i else -rate[:, 0]) * wc, wr * (rate[:, 1] if j else -rate[:, 1])],
                axis=1,
            ) * ok[:, None]
            c = flat_depth[at]
            offset = rc - base - (i, j)
            value, slope = _evaluate(c, offset), _slope(c, offset)
            top += w * value
            d_top += dw * value[:, None] + w[:, None] * slope
            mass += w
            d_mass += dw
    supported = mass > 1e-6
    safe = np.where(supported, mass, 1.0)
    depth = top / safe
    slope = (d_top - depth[:, None] * d_mass) / safe[:, None]
    return depth, slope, supported
