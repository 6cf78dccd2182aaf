"""Which points of a cloud belong to the hanging item.

The item hangs below the gripper tip, near the wrist axis, and is held at the tip. So: keep what
lies in a cylinder about the axis below the tip; take away planes that come in from outside of it
(wall, table), points without neighbours at their depth (flying pixels), and pieces that reach the
cylinder's wall; then take the piece at the tip and, from there, every piece within a gap that one
part of an item can hide of another.

All lengths are metric: the image's resolution enters only by the spacing measured in the cloud.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from vflatten_ros.core.arrays import frozen
from vflatten_ros.core.config import SegmentationConfig
from vflatten_ros.core.errors import EmptyView
from vflatten_ros.core.values import Bool, Calibration, Cloud, Int, View

Points = NDArray[np.float32]
# Half of the 26 neighbours of a voxel; the other half are their opposites.
HALF_NEIGHBOURS = [(0, 0, 1)] + [(0, 1, k) for k in (-1, 0, 1)]
HALF_NEIGHBOURS += [(1, j, k) for j in (-1, 0, 1) for k in (-1, 0, 1)]


def make_view(
    view_id: int,
    cloud: Cloud,
    calibration: Calibration,
    angle_rad: float,
    config: SegmentationConfig,
) -> View:
    """The item's points of a cloud as a view at a wrist angle.

    Raises
    ------
    EmptyView
        No item is seen below the gripper tip; says what was found instead.
    """
    pixel = segment(cloud, calibration, config)
    return view_at(view_id, cloud, pixel, calibration, angle_rad)


def view_at(
    view_id: int, cloud: Cloud, pixel: NDArray[np.int32], calibration: Calibration, angle_rad: float
) -> View:
    """A view of given pixels (n, 2) of a cloud; nothing of the cloud is held on to."""
    row, col = pixel[:, 0], pixel[:, 1]
    points = cloud.xyz[row, col].astype(np.float64)
    rgb = None if cloud.rgb is None else frozen(np.ascontiguousarray(cloud.rgb[row, col]))
    shape = (int(cloud.xyz.shape[0]), int(cloud.xyz.shape[1]))
    return View(
        view_id, cloud.stamp_ns, angle_rad, frozen(points), frozen(pixel), rgb, shape, calibration
    )


def segment(
    cloud: Cloud, calibration: Calibration, config: SegmentationConfig
) -> NDArray[np.int32]:
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
    cols = cloud.xyz.shape[1]
    flat = cloud.xyz.reshape(-1, 3)
    index = _near_in_depth(flat, calibration, config)
    below, radius = _cylinder(flat[index], calibration)
    kept = below > config.tip_clearance_m
    index, radius = index[kept], radius[kept]
    if len(index) < config.min_points:
        raise EmptyView(
            f"{len(index)} points below the gripper tip, fewer than segmentation.min_points "
            f"({config.min_points}); is an item held, and the calibration right?"
        )
    spacing = _spacing(cloud, index)
    kept = ~_on_planes(flat[index], radius, spacing, config)
    kept &= radius < config.radius_m + config.link_m
    index, radius = index[kept], radius[kept]
    kept = _supported(cloud, index, spacing, config)
    index, radius = index[kept], radius[kept]
    kept = _held(flat[index], radius, spacing, calibration, config)
    index = index[kept]
    pixel: NDArray[np.int32] = np.stack([index // cols, index % cols], axis=1).astype(np.int32)
    return pixel


def _near_in_depth(flat: Points, calibration: Calibration, config: SegmentationConfig) -> Int:
    """Indices of the points whose depth the cylinder can reach: one cheap pass over the image."""
    tip = np.array(calibration.gripper_tip)
    bottom = tip - config.length_m * np.array(calibration.axis_direction)
    low = min(tip[2], bottom[2]) - config.radius_m - config.link_m
    high = max(tip[2], bottom[2]) + config.radius_m + config.link_m
    depth = flat[:, 2]
    return np.flatnonzero((depth > low) & (depth < high))


def _cylinder(points: Points, calibration: Calibration) -> tuple[Points, Points]:
    """Depth below the tip along the axis, and distance from the axis, of (n, 3) points."""
    up = np.array(calibration.axis_direction, np.float32)
    offset = points - np.array(calibration.axis_point, np.float32)
    height = offset @ up
    tip = (np.array(calibration.gripper_tip) - calibration.axis_point) @ up
    square = np.einsum("ij,ij->i", offset, offset) - height * height
    return np.float32(tip) - height, np.sqrt(np.maximum(square, 0.0))


def _spacing(cloud: Cloud, index: Int) -> float:
    """Typical distance between neighbouring points, m."""
    flat = cloud.xyz.reshape(-1, 3)
    if cloud.organised:
        beside = index[:-1][(np.diff(index) == 1)]
        if len(beside) > 10:
            return float(np.median(np.linalg.norm(flat[beside + 1] - flat[beside], axis=1)))
    points = flat[index]
    some = points[:: max(len(points) // 500, 1)]
    near, _ = cKDTree(points).query(some, k=2)
    return float(np.median(near[:, 1]))


def _on_planes(points: Points, radius: Points, spacing: float, config: SegmentationConfig) -> Bool:
    """Points on a wall, table or other plane that comes into the cylinder from outside.

    The planes are found in the points outside of the cylinder, so no flat item is taken for one.
    """
    found = np.zeros(len(points), bool)
    outside = np.flatnonzero(radius > config.radius_m)
    enough = config.wall_area_m2 / spacing**2
    for _ in range(3):
        if len(outside) < enough:
            break
        plane = _dominant_plane(points[outside[:: max(len(outside) // 1500, 1)]], config.wall_m)
        on = np.abs(points @ plane[:3] + plane[3]) < config.wall_m
        if on[outside].sum() < enough:
            break
        found |= on
        outside = outside[~on[outside]]
    return found


def _dominant_plane(points: Points, tolerance_m: float) -> Points:
    """Plane (a, b, c, d) with most points within a tolerance: RANSAC with a fixed seed, refined."""
    chance = np.random.default_rng(0)
    corners = points[chance.integers(0, len(points), (100, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + np.float32(1e-12)
    offsets = -np.einsum("ij,ij->i", normals, corners[:, 0])
    near = np.abs(points @ normals.T + offsets) < tolerance_m  # (points, trials)
    inliers = points[near[:, near.sum(axis=0).argmax()]]
    centre = inliers.mean(axis=0)
    normal = np.linalg.svd(inliers - centre, full_matrices=False)[2][2]
    plane: Points = np.append(normal, -normal @ centre).astype(np.float32)
    return plane


def _supported(cloud: Cloud, index: Int, spacing: float, config: SegmentationConfig) -> Bool:
    """Points with enough neighbours at their depth; flying pixels between two layers have none."""
    tolerance = max(config.support_m, 3.0 * spacing)
    if not cloud.organised:
        points = cloud.xyz.reshape(-1, 3)[index]
        far, _ = cKDTree(points).query(points, k=[config.support_points + 1])
        near: Bool = far[:, 0] < tolerance
        return near
    cols = cloud.xyz.shape[1]
    row, col = index // cols, index % cols
    step = max(1, round(0.25 * config.support_m / spacing))
    border = 2 * step
    top, left = row.min() - border, col.min() - border
    shape = (row.max() - top + border + 1, col.max() - left + border + 1)
    depth = np.full(shape, np.nan, np.float32)
    row, col = row - top, col - left
    depth[row, col] = cloud.xyz.reshape(-1, 3)[index, 2]
    count = np.zeros(shape, np.uint8)
    for down in range(3):
        for right in range(-2 if down else 1, 3):
            here = _shifted(shape, down * step, right * step)
            there = _shifted(shape, -down * step, -right * step)
            near = np.abs(depth[here] - depth[there]) < tolerance
            count[here] += near
            count[there] += near
    enough: Bool = count[row, col] >= config.support_points
    return enough


def _shifted(shape: tuple[int, int], down: int, right: int) -> tuple[slice, slice]:
    """The part of an image that, moved by (down, right), stays inside."""
    rows, cols = shape
    return (
        slice(max(0, -down), min(rows, rows - down)),
        slice(max(0, -right), min(cols, cols - right)),
    )


def _held(
    points: Points,
    radius: Points,
    spacing: float,
    calibration: Calibration,
    config: SegmentationConfig,
) -> Bool:
    """Points of the piece at the tip and of the pieces that belong to it."""
    if len(points) < config.min_points:
        raise EmptyView(f"{len(points)} points left below the gripper tip without wall and noise")
    link = max(config.link_m, 3.0 * spacing)
    voxel, centres, label = _pieces(points, link)
    count = np.bincount(label[voxel])
    outer = np.bincount(label[voxel], weights=radius > config.radius_m) > 0
    large = count * spacing**2 > config.piece_area_m2
    tip = np.array(calibration.gripper_tip, np.float32)
    distance = np.linalg.norm(centres - tip, axis=1)
    distance[~large[label]] = np.inf
    start = int(distance.argmin())
    if distance[start] > config.hold_m:
        raise EmptyView(
            f"nothing within segmentation.hold_m ({config.hold_m} m) of the gripper tip; "
            "is an item held, and the calibration right?"
        )
    members = _grow(centres, label, label[start], large & ~outer, config.gap_m + link)
    kept: Bool = members[label[voxel]] & (radius <= config.radius_m)
    if kept.sum() < config.min_points:
        raise EmptyView(f"the piece at the gripper tip has only {kept.sum()} points")
    return kept


def _pieces(points: Points, size: float) -> tuple[Int, Points, Int]:
    """Voxels of a size, and which of them hang together by sides, edges or corners.

    Returns
    -------
    voxel : (n,) voxel of each point
    centres : (voxels, 3) m
    label : (voxels,) piece of each voxel
    """
    cell = np.floor(points / np.float32(size)).astype(np.int64)
    cell -= cell.min(axis=0) - 1
    ny, nz = int(cell[:, 1].max()) + 2, int(cell[:, 2].max()) + 2
    key, voxel = np.unique((cell[:, 0] * ny + cell[:, 1]) * nz + cell[:, 2], return_inverse=True)
    pairs: list[Any] = []
    for i, j, k in HALF_NEIGHBOURS:
        wanted = key + (i * ny + j) * nz + k
        place = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        first = np.flatnonzero(key[place] == wanted)
        pairs.append(np.stack([first, place[first]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(len(key), len(key)))
    _, label = connected_components(graph, directed=False)
    count = np.bincount(voxel)
    centres = np.stack([np.bincount(voxel, points[:, k]) / count for k in range(3)], axis=1)
    return voxel, centres.astype(np.float32), label


def _grow(centres: Points, label: Int, start: int, joinable: Bool, gap_m: float) -> Bool:
    """Pieces that are reached from the first by steps no longer than a gap."""
    members = np.zeros(len(joinable), bool)
    members[start] = True
    waiting = joinable & ~members
    reached = np.array([start])
    while waiting.any() and len(reached):
        tree = cKDTree(centres[np.isin(label, reached)])
        candidates = np.flatnonzero(waiting[label])
        near, _ = tree.query(centres[candidates], distance_upper_bound=gap_m)
        reached = np.unique(label[candidates[np.isfinite(near)]])
        members[reached] = True
        waiting[reached] = False
    return members
