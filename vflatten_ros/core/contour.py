"""Flattened surface to its outline: the union of what both views show, as one closed line."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from vflatten_ros.core.arrays import as_points
from vflatten_ros.core.config import ContourConfig
from vflatten_ros.core.errors import InvalidInput
from vflatten_ros.core.values import Bool, FlatSurface, Float, Outline

MOST_ENDS = 0.3  # of a gap's rim may be ends of the item, for the gap to be filled


def trace_outline(
    surface: FlatSurface, sigma_m: float, margin_m: float, config: ContourConfig
) -> Outline:
    """Outline of the union of flattened cells.

    Parameters
    ----------
    surface : FlatSurface
    sigma_m : float
        Standard deviation of its points.
    margin_m : float
        How far the surface reaches beyond its outermost points: half a pixel.
    config : ContourConfig

    Returns
    -------
    Outline
        Closed, simple, counter-clockwise; of the largest part if there are several.

    Raises
    ------
    InvalidInput
        Points that are not finite, or no area.
    """
    uv, edge = as_points(surface.uv, "uv", 2), surface.edge
    if not len(surface.cells):
        raise InvalidInput("outline: no surface between the flattened points")
    reach = max(config.close_m, config.bridge_m) + margin_m + 4 * config.cell_m
    low = uv.min(axis=0) - reach
    shape = tuple(np.ceil((uv.max(axis=0) + reach - low) / config.cell_m).astype(int)[::-1] + 1)
    image = _filled(uv[surface.cells], low, shape, config.cell_m)
    col, row = np.rint((uv - low) / config.cell_m).astype(int).T
    image[row, col] = True  # points beside holes, that have no square of their own
    image = _closed(image, config.close_m / config.cell_m)
    image = _bridged(image, uv, edge, low, config)
    contour = _largest(image)
    line = contour * config.cell_m + low
    line = _evenly(line, config.spacing_m)
    line = _smoothed(line, config.smooth_m / config.spacing_m)
    # pixels' centres are traced on the raster half a cell inside of its edge
    line = _grown(line, margin_m + 0.5 * config.cell_m)
    distance, nearest = cKDTree(uv).query(line, k=min(4, len(uv)))
    nearest = nearest.reshape(len(line), -1)
    seen = (distance.reshape(len(line), -1)[:, 0] < config.seen_m + margin_m) & edge[nearest].any(
        axis=1
    )
    sigma = np.full(len(line), np.hypot(sigma_m, 0.5 * config.cell_m))
    return Outline(line, np.where(seen, sigma, np.maximum(sigma, 0.03)), ~seen)


def outline_of_polygons(
    polygons: Sequence[Float], sigma_m: float, config: ContourConfig
) -> Outline:
    """Outline of the union of polygons, (k, 2) metres each; of its largest part."""
    low = np.vstack(polygons).min(axis=0) - config.close_m - 4 * config.cell_m
    high = np.vstack(polygons).max(axis=0) + config.close_m + 4 * config.cell_m
    shape = tuple(np.ceil((high - low) / config.cell_m).astype(int)[::-1] + 1)
    image = np.zeros(shape, dtype=np.uint8)
    for polygon in polygons:
        one = np.zeros(shape, dtype=np.uint8)
        cv2.fillPoly(one, [np.rint((polygon - low) / config.cell_m).astype(np.int32)], 1)
        image |= one
    line = _largest(_closed(image > 0, config.close_m / config.cell_m)) * config.cell_m + low
    line = _smoothed(_evenly(line, config.spacing_m), config.smooth_m / config.spacing_m)
    return Outline(line, np.full(len(line), sigma_m), np.zeros(len(line), dtype=bool))


def _filled(quads: Float, low: Float, shape: tuple[int, int], cell_m: float) -> Bool:
    """Raster of all quadrilaterals, by points spread over each, denser than the cells."""
    longest = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2).max(axis=1)
    image = np.zeros(shape, dtype=bool)
    steps = np.ceil(longest / (0.7 * cell_m)).astype(int) + 1
    for count in np.unique(np.minimum(steps, 40)):
        some = quads[np.minimum(steps, 40) == count]
        t = np.linspace(0.0, 1.0, count)
        s, t = (x.reshape(-1) for x in np.meshgrid(t, t))
        share = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t])  # (4, count^2)
        inside = (np.swapaxes(some, 1, 2).reshape(-1, 4) @ share).reshape(len(some), 2, -1)
        col, row = np.rint((inside - low[:, None]) / cell_m).astype(int).swapaxes(0, 1)
        image[row, col] = True
    return image


def _closed(image: Bool, radius: float) -> Bool:
    """Gaps narrower than twice the radius filled (Euclidean dilation and erosion), holes too."""
    away = cv2.distanceTransform((~image).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    wide = (away <= radius).astype(np.uint8)
    inner = cv2.distanceTransform(np.pad(wide, 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    result: Bool = (inner > radius) | image
    return result


def _bridged(image: Bool, uv: Float, edge: Bool, low: Float, config: ContourConfig) -> Bool:
    """Wider gaps filled if nearly all around was unseen: a fold's gap goes, a leg's gap stays."""
    gap = _closed(image, config.bridge_m / config.cell_m) & ~image
    count, label = cv2.connectedComponents(gap.astype(np.uint8), connectivity=4)
    rim = image & (cv2.dilate(gap.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    at = np.argwhere(rim)
    if not len(at):
        return image
    k = min(8, len(uv))
    near = cKDTree(uv).query(at[:, ::-1] * config.cell_m + low, k=k)[1].reshape(len(at), k)
    ends = edge[near].mean(axis=1) > 0.5
    beside = cv2.dilate(label.astype(np.float32), np.ones((3, 3), np.uint8))[tuple(at.T)].astype(
        int
    )
    share = np.bincount(beside, ends, count) / np.maximum(np.bincount(beside, minlength=count), 1)
    fill = share < MOST_ENDS
    fill[0] = False
    result: Bool = image | fill[label]
    return result


def _largest(image: Bool) -> Float:
    found, _ = cv2.findContours(image.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(found, key=lambda c: (cv2.contourArea(c), len(c)), default=np.zeros((0, 1, 2)))
    if len(largest) < 8:
        raise InvalidInput("outline: the flattened surface has no area")
    line = largest[:, 0].astype(np.float64)
    after = np.roll(line, -1, axis=0)
    area = (line[:, 0] * after[:, 1] - line[:, 1] * after[:, 0]).sum()
    return line if area > 0 else line[::-1]


def _evenly(line: Float, spacing: float) -> Float:
    closed = np.vstack([line, line[:1]])
    at = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))]
    count = max(8, round(float(at[-1]) / spacing))
    wanted = np.arange(count) * (at[-1] / count)
    return np.column_stack([np.interp(wanted, at, column) for column in closed.T])


def _smoothed(line: Float, sigma: float) -> Float:
    if sigma <= 0:
        return line
    out: Float = gaussian_filter1d(line, sigma, axis=0, mode="wrap")
    return out


def _grown(line: Float, by: float) -> Float:
    """Move every point outwards; counter-clockwise lines have the outside to their right."""
    along = np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return line + by * np.column_stack([along[:, 1], -along[:, 0]])
