"""Which points of a cloud belong to the hanging item.

The item hangs below the gripper tip, near the wrist axis. So: take what lies in a cylinder about
the axis below the tip; take away planes that come in from outside of it (wall, table) and points
without neighbours at their depth (flying pixels); then keep the pieces that hang from the tip with
no wider gap than one part of an item leaves when it hides another, unless they reach out of the
cylinder or stand on a table.

All lengths are metric: the image's resolution enters only by the spacing measured in the cloud.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vflatten_ros.core.arrays import frozen
from vflatten_ros.core.config import SegmentationConfig
from vflatten_ros.core.edges import farther_around
from vflatten_ros.core.errors import EmptyView
from vflatten_ros.core.pieces import centres, dominant_plane, pieces, plane_distance
from vflatten_ros.core.values import Bool, Calibration, Cloud, Float, Int, View

Points = NDArray[np.float32]
Pixels = NDArray[np.int32]
SAMPLE = 1500  # points from which spacing and planes are estimated
WALLS = 3  # most planes taken away
LEVEL = 0.7  # least cosine between the axis and the normal of a table or floor
MANY = 10  # pieces beside the largest, more than which are noise
SPECKS = 2.0  # times the area of the last of so many, up to which all are
SIDE = 0.1  # share of the image at either side in which no item is expected


def make_view(
    view_id: int,
    cloud: Cloud,
    calibration: Calibration,
    angle_rad: float,
    config: SegmentationConfig,
) -> View:
    """The item's points of a cloud as a view at an item angle; raises EmptyView as segment does."""
    pixel = segment(cloud, calibration, config)
    return view_at(view_id, cloud, pixel, calibration, angle_rad)


def view_at(
    view_id: int, cloud: Cloud, pixel: Pixels, calibration: Calibration, angle_rad: float
) -> View:
    """A view of given pixels (n, 2) of a cloud; nothing of the cloud is held on to."""
    row, col = pixel[:, 0], pixel[:, 1]
    points = frozen(cloud.xyz[row, col].astype(np.float64))
    rgb = None if cloud.rgb is None else frozen(np.ascontiguousarray(cloud.rgb[row, col]))
    shape = (int(cloud.xyz.shape[0]), int(cloud.xyz.shape[1]))
    return View(view_id, cloud.stamp_ns, angle_rad, points, frozen(pixel), rgb, shape, calibration)


def segment(cloud: Cloud, calibration: Calibration, config: SegmentationConfig) -> Pixels:
    """Pixels of the item in a cloud.

    Parameters
    ----------
    cloud : Cloud
        Organised or not, rig frame.
    calibration : Calibration
        Axis and gripper tip in the same frame.
    config : SegmentationConfig
        Lengths in metres.

    Returns
    -------
    ndarray of shape (n, 2), int32
        Row and column, row-major.

    Raises
    ------
    EmptyView
        No item is seen below the gripper tip.
    """
    flat = cloud.xyz.reshape(-1, 3)
    side = _image_sides(cloud, calibration)
    index, foreign, around = _near_axis(flat, side, calibration, config)
    _check_count(len(index), config)
    spacing = point_spacing(cloud, index)
    link = max(config.link_m, 3.0 * spacing)

    up = np.array(calibration.axis_direction)
    outside = foreign | side[index]
    wall, on_table = _planes(flat, index, outside, around, spacing, up, config)
    index, foreign = index[~wall], (foreign | on_table)[~wall]
    _check_count(len(index), config)
    kept = has_support(cloud, index, spacing, up, config)
    index, foreign = index[kept], foreign[kept]
    _check_count(len(index), config)
    held = _held(flat[index], foreign, spacing, link, calibration, config)
    index = index[held & ~foreign]
    _check_count(len(index), config)
    pixel: Pixels = np.stack(np.divmod(index, cloud.xyz.shape[1]), axis=1).astype(np.int32)
    if config.trim_px:
        pixel = pixel[_within_edges(cloud, pixel, max(config.support_m, 3.0 * spacing), config)]
        _check_count(len(pixel), config)
    return pixel


def _within_edges(
    cloud: Cloud, pixel: Pixels, tolerance: float, config: SegmentationConfig
) -> Bool:
    """Which of the item's points are not at its border, nor before what it hides of itself.

    Stereo matches blocks, and so gives pixels beside an edge the depth of what is in front.
    """
    if not cloud.organised:
        return np.ones(len(pixel), dtype=bool)
    depth = cloud.xyz[pixel[:, 0], pixel[:, 1], 2]
    kept: Bool = farther_around(pixel, depth, config.trim_px)[-1] <= tolerance
    return kept


def _check_count(count: int, config: SegmentationConfig) -> None:
    if count < config.min_points:
        raise EmptyView(
            f"{count} item points below the gripper tip, segmentation.min_points asks for "
            f"{config.min_points}; is an item held, and the calibration right?"
        )


def _image_sides(cloud: Cloud, calibration: Calibration) -> Bool:
    """(rows * cols,) pixels near the borders to the left and right of the item.

    What fills a narrow view from side to side is background, though it lies in the cylinder.
    """
    side = np.zeros(cloud.xyz.shape[:2], bool)
    x, y, _ = np.abs(calibration.axis_direction)
    across = side if y >= x else side.T
    width = round(SIDE * across.shape[1])
    if cloud.organised and width:
        across[:, :width] = across[:, -width:] = True
    return side.reshape(-1)


def _near_axis(
    flat: Points, side: Bool, calibration: Calibration, config: SegmentationConfig
) -> tuple[Int, Bool, Int]:
    """Points below the tip and near the axis.

    Returns
    -------
    index : indices of the points in the cylinder and one link beyond it
    foreign : which of them are beyond it
    around : indices of the points in a wider cylinder about it, or at the image's sides
    """
    up = np.array(calibration.axis_direction)
    point, tip = np.array(calibration.axis_point), np.array(calibration.gripper_tip)
    bottom = tip - config.length_m * up
    reach = 1.5 * config.radius_m
    depth = flat[:, 2]
    near = (depth > min(tip[2], bottom[2]) - reach) & (depth < max(tip[2], bottom[2]) + reach)
    index = np.flatnonzero(near)
    offset = [flat[:, k][index] - np.float32(point[k]) for k in range(3)]
    height = np.zeros(len(index), np.float32)
    square = np.zeros(len(index), np.float32)
    for k in range(3):
        height += offset[k] * np.float32(up[k])
        square += offset[k] * offset[k]
    square -= height * height
    low = np.float32((tip - point) @ up)
    below = (height < low - config.tip_clearance_m) & (height > low - config.length_m)
    inside = below & (square < (config.radius_m + config.link_m) ** 2)
    around = below & ((square > config.radius_m**2) | side[index]) & (square < reach**2)
    return index[inside], square[inside] > config.radius_m**2, index[around]


def point_spacing(cloud: Cloud, index: Int) -> float:
    """Typical distance between neighbouring points of those with the (n,) flat indices, m."""
    flat = cloud.xyz.reshape(-1, 3)
    if cloud.organised:
        beside = index[:-1][np.diff(index) == 1]
        beside = beside[:: max(len(beside) // SAMPLE, 1)]
        if len(beside):
            return float(np.median(np.linalg.norm(flat[beside + 1] - flat[beside], axis=1)))
    points = flat[index]
    some = points[:: max(len(points) // SAMPLE, 1)]
    near, _ = cKDTree(points).query(some, k=2)
    return float(np.median(near[:, 1]))


def _planes(
    flat: Points,
    index: Int,
    outside: Bool,
    around: Int,
    spacing: float,
    up: Float,
    config: SegmentationConfig,
) -> tuple[Bool, Bool]:
    """Points on planes that come in from outside (wall, table), and what stands on tables.

    The planes are found in the points `around`, and only what hangs together in a plane with points
    from `outside` is taken away: no flat item is taken for a wall, nor cut by a wall elsewhere.
    """
    on_any, on_table = np.zeros(len(index), bool), np.zeros(len(index), bool)
    thinning = max(len(around) // SAMPLE, 1)
    evidence = flat[around[::thinning]]
    enough = max(config.wall_area_m2 / (spacing**2 * thinning), 3)
    if len(evidence) < enough:
        return on_any, on_table
    points = flat[index]
    for _ in range(WALLS):
        if len(evidence) < enough:
            break
        plane, on = dominant_plane(evidence, config.wall_m)
        if on.sum() < enough:
            break
        evidence = evidence[~on]
        distance = plane_distance(points, plane)
        candidates = np.flatnonzero(distance < config.wall_m)
        if not outside[candidates].any():
            continue
        voxel, label = pieces(points[candidates], max(2.0 * config.link_m, 3.0 * spacing))
        reaches_out = np.bincount(label[voxel], weights=outside[candidates]) > 0
        on_any[candidates[reaches_out[label[voxel]]]] = True
        if abs(plane[:3] @ up) > LEVEL:
            on_table |= distance < config.wall_m + config.link_m
    return on_any, on_table


def has_support(
    cloud: Cloud, index: Int, spacing: float, up: Float, config: SegmentationConfig
) -> Bool:
    """Which points have enough neighbours at their depth; flying pixels between layers have none.

    Parameters
    ----------
    cloud : Cloud
    index : ndarray of shape (n,)
        Flat indices of the points, ascending; the others do not count as neighbours.
    spacing : float
        Distance between neighbouring points, m.
    up : ndarray of shape (3,)
        Upward direction, rig frame.
    config : SegmentationConfig

    Returns
    -------
    ndarray of shape (n,), bool
    """
    tolerance = max(config.support_m, 3.0 * spacing)
    if not cloud.organised:
        points = cloud.xyz.reshape(-1, 3)[index]
        far, _ = cKDTree(points).query(points, k=[config.support_points + 1])
        near: Bool = far[:, 0] < tolerance
        return near
    row, col = np.divmod(index, cloud.xyz.shape[1])
    # Four times as long along the axis as across: cloth seen edge-on is a narrow upright strip.
    step = max(1, round(0.25 * config.support_m / spacing))
    high, wide = (4 * step, step) if abs(up[1]) >= abs(up[0]) else (step, 4 * step)
    row, col = row - (row.min() - high), col - (col.min() - wide)
    depth = np.full((row.max() + high + 1, col.max() + wide + 1), np.nan, np.float32)
    depth[row, col] = cloud.xyz.reshape(-1, 3)[index, 2]
    count = _similar_neighbours(depth, high, wide, step, tolerance)
    enough: Bool = count[row, col] >= config.support_points
    return enough


def _similar_neighbours(
    depth: Points, high: int, wide: int, step: int, tolerance: float
) -> NDArray[np.uint8]:
    """Number of neighbours of similar depth in a window of every step-th pixel, (rows, cols)."""
    count = np.zeros(depth.shape, np.uint8)
    for down in range(0, high + 1, step):
        for right in range(-wide if down else step, wide + 1, step):
            here = _shifted(depth.shape, down, right)
            there = _shifted(depth.shape, -down, -right)
            similar = np.abs(depth[here] - depth[there]) < tolerance
            count[here] += similar
            count[there] += similar
    return count


def _shifted(shape: tuple[int, ...], down: int, right: int) -> tuple[slice, slice]:
    """The part of an image that, moved by (down, right), stays inside."""
    rows, cols = shape
    return (
        slice(max(0, -down), min(rows, rows - down)),
        slice(max(0, -right), min(cols, cols - right)),
    )


def _held(
    points: Points,
    foreign: Bool,
    spacing: float,
    link: float,
    calibration: Calibration,
    config: SegmentationConfig,
) -> Bool:
    """Points of the pieces that hang from the tip.

    A piece with a foreign point is background, unless it is the nearest to the tip: then item and
    background touch.
    """
    voxel, label = pieces(points, link)
    piece = label[voxel]
    area = np.bincount(piece) * spacing**2
    large = area > max(config.piece_area_m2, _specks_m2(area))
    own = np.bincount(piece, weights=foreign) == 0
    places = _squeezed(centres(points, voxel), calibration)
    distance = np.linalg.norm(places, axis=1)
    distance[~large[label]] = np.inf
    own[label[distance.argmin()]] = True
    held: Bool = _reached(places, label, large & own, config.gap_m + link)[piece]
    return held


def _specks_m2(area: Float) -> float:
    """Up to which area pieces, of areas (n,) in m2, are noise by their number: an item has few.

    Where stereo has nothing to match, it finds depths by chance, for patches of some size.
    """
    if len(area) <= MANY:
        return 0.0
    return SPECKS * float(np.sort(area)[-1 - MANY])


def _squeezed(points: Points, calibration: Calibration) -> Points:
    """Places seen from the tip, heights divided by 3.

    Cloth that hangs edge-on is not measured, which leaves tall gaps between pieces of one item.
    """
    up = np.array(calibration.axis_direction, np.float32)
    offset = points - np.array(calibration.gripper_tip, np.float32)
    squeezed: Points = offset - np.outer(offset @ up, up * np.float32(2.0 / 3.0))
    return squeezed


def _reached(places: Points, label: Int, joinable: Bool, gap_m: float) -> Bool:
    """Pieces that are reached from the origin by steps no longer than a gap."""
    members = np.zeros(len(joinable), bool)
    seeds = np.zeros((1, 3), np.float32)
    while len(seeds):
        candidates = np.flatnonzero((joinable & ~members)[label])
        near, _ = cKDTree(seeds).query(places[candidates], distance_upper_bound=gap_m)
        reached = np.zeros(len(joinable), bool)
        reached[label[candidates[np.isfinite(near)]]] = True
        members |= reached
        seeds = places[reached[label]]
    return members
