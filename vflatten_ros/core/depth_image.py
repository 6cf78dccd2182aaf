"""Points of one view as a depth image on a grid of viewing rays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vflatten_ros.core.raygrid import RayGrid, camera_rays, parallel_rays
from vflatten_ros.core.values import Bool, Float

WIDEST = 2.5  # the fit's weight in grid steps: finer pixels are put together first
MARGIN = 4  # grid places around the points


def depth_image(
    points: Float,
    toward: Float,
    pixel: NDArray[np.int32] | None,
    shape: tuple[int, int] | None,
    width_m: float,
) -> tuple[RayGrid, Float, Float, Bool]:
    """Rays about as close as the points, and depths along them.

    The camera's own pixels where it has any, else parallel rays. Much finer places than the fit
    can tell apart are put together in blocks.

    Parameters
    ----------
    points : ndarray of shape (n, 3)
    toward : ndarray of shape (n, 3)
        Direction to the viewer.
    pixel : ndarray of shape (n, 2) or None
    shape : (int, int) or None
        Rows and columns of the cloud.
    width_m : float
        Standard deviation of the fit's weight.

    Returns
    -------
    rays : RayGrid
    place : ndarray of shape (n, 2)
        Grid place of every point.
    depth : ndarray of shape (rows, cols)
    seen : ndarray of shape (rows, cols)
    """
    rays = None
    if pixel is not None and shape is not None and np.ptp(pixel, axis=0).min() > 0:
        rays = camera_rays(points, pixel, shape)
    organised = rays is not None
    if rays is None:
        rays = _own_grid(points, toward)
    place, depth = rays.to_grid(points)
    if organised:
        place = np.round(place)
    block = max(1, int(width_m / rays.spacing(float(np.median(depth))) / WIDEST))
    low = np.floor(place.min(axis=0)) - MARGIN * block
    extent = np.ceil(place.max(axis=0)) - low + MARGIN * block + 1
    rays = rays.moved(low, (int(extent[0]), int(extent[1])))
    place = place - low
    if block > 1:
        rays = rays.coarser(block)
        place = (place - (block - 1) / 2) / block
        return rays, place, *_blocks(rays, place, depth)
    image, seen = np.zeros(rays.shape), np.zeros(rays.shape, bool)
    seen[tuple(np.round(place).astype(int).T)] = True
    if organised:
        image[tuple(place.astype(int).T)] = depth
    else:
        near = cKDTree(place).query(np.argwhere(seen), 9)[1]
        image[seen] = _plane_at(np.argwhere(seen).astype(float), place[near], depth[near])
    return rays, place, image, seen


def _blocks(rays: RayGrid, place: Float, depth: Float) -> tuple[Float, Bool]:
    """Mean depth of the points around each place that are on the layer of the least depth."""
    count = rays.shape[0] * rays.shape[1]
    cells = np.round(place).astype(np.int64)
    at = cells[:, 0] * rays.shape[1] + cells[:, 1]
    least = np.full(count, np.inf)
    np.minimum.at(least, at, depth)
    same = depth - least[at] < 6 * rays.spacing(float(np.median(depth)))
    at, offset, depth = at[same], (place - cells)[same], depth[same]
    number = np.bincount(at, minlength=count)
    full = np.maximum(number, 1)
    mean, row, col = (
        (np.bincount(at, values, count) / full).reshape(rays.shape)
        for values in (depth, offset[:, 0], offset[:, 1])
    )
    seen = (number > 0).reshape(rays.shape)
    # the mean belongs to the mean place of the points: move it to the middle along the slope
    known = np.where(seen, mean, np.nan)
    slope = np.gradient(known)
    limit = 3 * rays.spacing(float(np.median(depth)))
    by_row, by_col = (np.where(np.abs(s) < limit, s, 0.0) for s in slope)
    return np.where(seen, mean - by_row * row - by_col * col, 0.0), seen


def _plane_at(places: Float, rc: Float, depth: Float) -> Float:
    """(k,) depth at places from the (k, n) nearest measured ones on one layer, by planes."""
    offset = rc - places[:, None]
    spread = np.abs(depth - depth[:, :1])
    typical = np.median(spread)
    weight = np.exp(-0.5 * (offset**2).sum(axis=-1)) * (spread < 6 * typical + 1e-9) + 1e-9
    basis = np.concatenate([np.ones((*depth.shape, 1)), offset], axis=-1)
    scaled = basis * weight[..., None]
    normal = np.matmul(scaled.swapaxes(1, 2), basis)
    normal += weight.sum(axis=1)[:, None, None] * np.diag([0.0, 1e-2, 1e-2])
    right = np.einsum("kni,kn->ki", scaled, depth - depth[:, :1])
    solved: Float = np.linalg.solve(normal, right[..., None])[:, 0, 0]
    return solved + depth[:, 0]


def _own_grid(points: Float, toward: Float) -> RayGrid:
    """Parallel rays about as far apart as the points."""
    view = toward.mean(axis=0)
    view = view / np.linalg.norm(view)
    e_row = np.cross(view, np.eye(3)[np.argmin(np.abs(view))])
    e_row /= np.linalg.norm(e_row)
    e_col = np.cross(view, e_row)
    flat = np.stack([points @ e_row, points @ e_col], axis=1)
    near, _ = cKDTree(flat).query(flat[:: max(1, len(flat) // 2000)], 5)
    coarse = max(2.0 * float(np.median(near[:, 4])), 1e-6)
    area = len(np.unique(np.floor(flat / coarse), axis=0)) * coarse**2
    step = np.sqrt(area / len(points))
    return parallel_rays(np.zeros(3), e_row * step, e_col * step, (1, 1))
