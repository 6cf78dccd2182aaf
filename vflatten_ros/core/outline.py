"""The outline of what lies flat: where the samples end, and where that is no edge of the cloth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.geometry import loop_normals, thinned_loop, twice_area
from vflatten_ros.core.values import Bool, Float, Int, Outline

HIDDEN_M = 0.012  # samples round a point of the outline that say whether it is an edge
HIDDEN_SHARE = 0.75  # of the edges there that are hidden, above which it is no edge
GOES_ON_SHARE = 0.5  # of the edges round what was not seen of a placed item, for cloth to be there
SPUR_M = 0.012  # half the width of what is too narrow for a garment
SPUR_REACH = 0.8  # how far a corner goes beyond a disc in it, in radii
CUT = 2.0  # spacings between points of one slit
DEEP_M = 0.020  # how deep within the outline a slit lies, by the middle of its points
SLIT_M = 0.03  # widest slit of which one side tells what the other is
WITHIN_M = 0.010  # how far an item may end within an outline that fits it
CELL_M = 0.002  # of the image whose contour is the outline


def outline_of(
    uv: Float,
    sigma_m: Float,
    edge: Int,
    config: RotationConfig,
    cuts: Sequence[Float] = (),
    item: Float | None = None,
    slit: Float | None = None,
) -> Outline:
    """Where the density of the samples falls to a share of that of a single layer.

    A contour round every sample would go round the strays too, and be too large for it.

    Parameters
    ----------
    edge : ndarray of shape (n,)
        0: inside a sheet, 1: at an edge of the cloth, 2: where cloth goes on unseen.
    cuts : sequence of ndarray of shape (m, 2)
        Points along slits, which the outline follows if they lead into the item.
    item : ndarray of shape (c, 2), optional
        Outline within which what was not seen is hidden cloth, if the cloth around goes on there.
    slit : ndarray of shape (m, 2), optional
        Points along a slit that is known to lead into the item, however it looks.
    """
    extent = uv if item is None else np.vstack([uv, item])
    low = extent.min(0) - 10 * config.edge_blur_m
    size = np.ceil((extent.max(0) + 10 * config.edge_blur_m - low) / CELL_M).astype(int)
    if size.max() > 4000:
        raise DisconnectedSurface(f"the flattened item is {size.max() * CELL_M:.1f} m wide")
    column, row = np.rint((uv - low) / CELL_M).astype(int).T
    cell = np.bincount(row * size[0] + column, minlength=size[0] * size[1])
    count = cell.reshape(size[1], size[0]).astype(np.float32)
    single = (CELL_M / config.spacing_m) ** 2  # samples of one layer in a cell
    density = cv2.GaussianBlur(count, (0, 0), config.edge_blur_m / CELL_M)
    inside = (density > config.edge_density * single).astype(np.uint8)
    gap = round(config.close_m / CELL_M)
    inside = cv2.morphologyEx(inside, cv2.MORPH_CLOSE, _disc(gap))
    if item is not None:
        ends = edge > 0
        inside |= _hidden(inside, (item - low) / CELL_M, (uv[ends] - low) / CELL_M, edge[ends] == 2)
    reach = round(CUT * config.spacing_m / CELL_M)
    into = _leading_in(inside, [(cut - low) / CELL_M for cut in cuts])
    if slit is not None:
        into.append(_cells_of((slit - low) / CELL_M, inside))
    inside = _cut(inside, into, reach)
    inside = _without_spurs(inside, round(SPUR_M / CELL_M))
    contours, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        raise DisconnectedSurface("the flattened samples enclose no area; take more views")
    longest = max(contours, key=cv2.contourArea)[:, 0].astype(np.float64)
    contour = low + CELL_M * thinned_loop(longest)
    if twice_area(contour) < 0:
        contour = contour[::-1].copy()  # a view adds up otherwise: a process gets a copy
    near = cKDTree(uv).query(contour)[1]
    inferred = _near(contour, uv[edge == 2]) > HIDDEN_SHARE * _near(contour, uv[edge > 0])
    inferred &= ~_before_an_end(contour, inferred)
    if item is not None:
        inferred |= cKDTree(uv).query(contour)[0] > HIDDEN_M
    return Outline(contour, sigma_m[near], inferred)


def _hidden(
    inside: NDArray[np.uint8], item: Float, ends: Float, goes_on: Bool
) -> NDArray[np.uint8]:
    """Cells within an item's outline (c, 2) that were not seen, where the cloth around goes on.

    Parameters
    ----------
    ends : ndarray of shape (e, 2)
        Where sheets end.
    goes_on : ndarray of shape (e,)
        Whether the cloth does not.
    """
    body, corners = np.zeros_like(inside), np.rint(item).astype(np.int32)
    cv2.fillPoly(body, [corners], (1,))
    cv2.polylines(body, [corners], True, (0,))  # legs may touch
    body = cv2.erode(body, _disc(round(WITHIN_M / CELL_M))) & ~inside & 1
    count, label = cv2.connectedComponents(body.astype(np.uint8))
    col, row = np.rint(ends).astype(int).T
    reach = _disc(round(HIDDEN_M / CELL_M))
    filled = np.zeros_like(inside)
    for k in range(1, count):
        beside = cv2.dilate((label == k).astype(np.uint8), reach)[row, col] > 0
        if goes_on[beside].sum() > GOES_ON_SHARE * beside.sum():
            filled[label == k] = 1
    return filled


def within(uv: Float, outline: Float) -> Bool:
    """Which points lie in a closed outline, to a cell."""
    low = np.minimum(uv.min(axis=0), outline.min(axis=0)) - CELL_M
    corners, (column, row) = (outline - low) / CELL_M, np.rint((uv - low) / CELL_M).astype(int).T
    cols, rows = np.r_[corners.max(axis=0), column.max(), row.max()].reshape(2, 2).max(axis=0)
    image = np.zeros((int(rows) + 2, int(cols) + 2), np.uint8)
    cv2.fillPoly(image, [np.rint(corners).astype(np.int32)], (1,))
    found: Bool = image[row, column] > 0
    return found


def _cells_of(at: Float, inside: NDArray[np.uint8]) -> Int:
    """The cells (m, 2), col and row, nearest to places in an image."""
    cells: Int = np.rint(at).astype(int).clip(0, np.array(inside.shape[::-1]) - 1)
    return cells


def _leading_in(inside: NDArray[np.uint8], cuts: Sequence[Float]) -> list[Int]:
    """Cells of those points (col, row) along slits that lie deep within the item."""
    depth = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_5) * CELL_M
    cells = [_cells_of(cut, inside) for cut in cuts]
    return [cell for cell in cells if np.median(depth[cell[:, 1], cell[:, 0]]) > DEEP_M]


def _cut(inside: NDArray[np.uint8], cuts: Sequence[Int], reach: int) -> NDArray[np.uint8]:
    """Without thin lines through cells (col, row), a few apart, that lead into the item."""
    points = np.vstack([*cuts, np.zeros((0, 2), dtype=np.int64)])
    if not len(points):
        return inside
    drawn = np.zeros_like(inside)
    drawn[points[:, 1], points[:, 0]] = 1
    border = cv2.dilate(inside, np.ones((3, 3), np.uint8)) & ~inside & 1
    outside = np.argwhere(border)[:, ::-1]
    away, nearest = cKDTree(outside).query(points, distance_upper_bound=reach)
    for start, end in zip(points[np.isfinite(away)], outside[nearest[np.isfinite(away)]]):
        cv2.line(drawn, start.tolist(), end.tolist(), (1,))
    drawn = cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, _disc(reach // 2))
    drawn = cv2.dilate(drawn, np.ones((2, 2), np.uint8))
    rest: NDArray[np.uint8] = cv2.bitwise_and(inside, 1 - drawn)
    return rest


def _before_an_end(contour: Float, inferred: Bool) -> Bool:
    """Where the outline is one side of a slit, on the other side of which the cloth ends.

    Between two legs, one leg hangs before the edge of the other; no cloth goes on there.
    """
    normal = loop_normals(contour)
    i, j = cKDTree(contour).query_pairs(SLIT_M, output_type="ndarray").T
    across = contour[j] - contour[i]
    size = np.linalg.norm(across, axis=1)
    facing = ((across * normal[i]).sum(1) > 0.7 * size) & (
        (across * normal[j]).sum(1) < -0.7 * size
    )
    i, j = np.r_[i[facing], j[facing]], np.r_[j[facing], i[facing]]
    ends = np.bincount(i, ~inferred[j], len(contour))
    return ends > 0.5 * np.bincount(i, minlength=len(contour))


def _without_spurs(inside: NDArray[np.uint8], radius: int) -> NDArray[np.uint8]:
    """Without what is too narrow for a garment; corners, which a disc does not fill, stay."""
    wide = cv2.morphologyEx(inside, cv2.MORPH_OPEN, _disc(radius))
    count, label = cv2.connectedComponents(inside & ~wide & 1, connectivity=4)
    away = cv2.distanceTransform(1 - wide, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    reach = np.zeros(count)
    np.maximum.at(reach, label.ravel(), away.ravel())
    corner = reach < SPUR_REACH * radius
    corner[0] = False
    kept: NDArray[np.uint8] = wide | corner[label].astype(np.uint8)
    return kept


def _near(contour: Float, uv: Float) -> Int:
    """How many points lie round each point of the outline."""
    if not len(uv):
        return np.zeros(len(contour), dtype=np.int64)
    count: Int = cKDTree(uv).query_ball_point(contour, HIDDEN_M, return_length=True)
    return count


def _disc(radius: int) -> NDArray[np.uint8]:
    disc: NDArray[np.uint8] = cv2.getStructuringElement(
        cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)
    )
    return disc
