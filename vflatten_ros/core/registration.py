"""Views of one rotation, brought into one frame: the wrist angle first, then their shared surface.

The item sways by millimetres and lags behind the wrist by a fraction of a degree, and the axis
calibration may be off. Every view gets a small rigid correction, and all views together one
correction of the axis. All are found at once from point-to-plane distances between overlapping
views (Chen & Medioni 1992), the first and the last ones included, and held by a prior: without it
smooth legs slide along themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.errors import NotEnoughViews
from vflatten_ros.core.geometry import Float, inverse, rigid, rotation_about, transform_points
from vflatten_ros.core.grain import Grain, grain_of, suited
from vflatten_ros.core.parallel import mapped
from vflatten_ros.core.sight import Sight, sight_of
from vflatten_ros.core.values import Int, Progress, View, no_progress

MIN_POINTS = 100  # a view with fewer item points shows nothing that could be placed
PAIR_POINTS = 300.0  # noise is alike in neighbouring pixels: more pairs than this say no more
MOST_PARTNERS = 4  # on either side of a view
NEIGHBOURS, RADIUS_M, LEAST = 24, 0.012, 8  # most points of a plane of this radius, and fewest


@dataclass(frozen=True, eq=False)
class ViewSurface:
    """Where one view sees the cloth, by the wrist angle alone."""

    view_id: int
    angle_rad: float
    points: Float  # (n, 3) measured, hanger frame
    smooth: Float  # (n, 3) on the locally fitted surface, hanger frame
    normals: Float  # (n, 3) unit, towards the camera: outwards
    index: Int  # (n,) row of the view's points
    camera: Float  # (3,) hanger frame
    tree: cKDTree  # of smooth
    grain: Grain  # of the points
    sight: Sight | None = None  # in the hanger frame; None if the cloud is not that of a camera


def view_surface(view: View, config: RotationConfig) -> ViewSurface:
    """Local planes of one view's points. Needs no other view: do it as the view arrives.

    Points with too few neighbours for a plane (flying pixels, shreds) are left out.

    Raises
    ------
    NotEnoughViews
        The view has hardly any points on the item.
    """
    T_hanger_rig = inverse(view.calibration.T_rig_hanger(view.angle_rad))
    points = transform_points(T_hanger_rig, view.points_rig)
    if len(points) < MIN_POINTS:
        raise NotEnoughViews(
            f"view {view.view_id}: {len(points)} points on the item, expected {MIN_POINTS}; "
            "leave the view out or widen segmentation.radius_m"
        )
    camera = T_hanger_rig[:3, 3]
    grain = grain_of(points)
    smooth, normals, count = _planes(points, suited(config, grain).view_fit_m)
    normals = normals * np.where(((camera - points) * normals).sum(1) < 0, -1.0, 1.0)[:, None]
    good = count >= LEAST
    return ViewSurface(
        view.view_id,
        view.angle_rad,
        points[good],
        smooth[good],
        normals[good],
        np.flatnonzero(good),
        camera,
        cKDTree(smooth[good]),
        grain,
        sight_of(points, view.pixel, view.shape),
    )


def _planes(points: Float, radius_m: float) -> tuple[Float, Float, Int]:
    """Plane through the neighbours of each point: nearest point on it, normal, neighbours used."""
    most = max(LEAST, round(NEIGHBOURS * (radius_m / RADIUS_M) ** 2))
    distance, near = cKDTree(points).query(points, k=most, distance_upper_bound=radius_m)
    found = np.isfinite(distance)
    weight = np.where(found, (1 - (distance / radius_m).clip(0, 1) ** 2) ** 2, 0.0)
    offset = points[np.where(found, near, 0)] - points[:, None]
    total = weight.sum(1)[:, None]
    mean = np.einsum("nk,nki->ni", weight, offset) / total
    offset = (offset - mean[:, None]) * np.sqrt(weight)[..., None]
    normals = np.linalg.eigh(offset.transpose(0, 2, 1) @ offset)[1][:, :, 0]
    smooth = points + (mean * normals).sum(1, keepdims=True) * normals
    return smooth, normals, found.sum(1)


def register_views(
    surfaces: Sequence[ViewSurface], config: RotationConfig, progress: Progress = no_progress
) -> list[Float]:
    """Correction of every view, so that views that see the same cloth agree.

    Parameters
    ----------
    surfaces : sequence of ViewSurface
        At least two, in any order.
    config : RotationConfig
    progress : Progress

    Returns
    -------
    list of ndarray of shape (4, 4)
        Takes each view's hanger coordinates to the common ones.

    Raises
    ------
    NotEnoughViews
        Fewer than two views.
    """
    if len(surfaces) < 2:
        raise NotEnoughViews(f"registration: got {len(surfaces)} views, expected 2 or more")
    pairs = _overlapping([s.angle_rad for s in surfaces], config.overlap_deg)
    partners = [[i for i, j in pairs if j == to] for to in range(len(surfaces))]
    thin = [_thinned(s, config.register_points) for s in surfaces]
    poses = [np.eye(4) for _ in surfaces]
    prior = _prior(surfaces, config)
    for done in range(config.register_rounds):
        progress("register", done / config.register_rounds)
        moved = [_seen_from(s, rows, p) for s, rows, p in zip(surfaces, thin, poses, strict=True)]
        normal, gradient = prior.copy(), prior @ _parameters(poses, len(prior))
        work = partial(_equations, moved, partners, surfaces, poses, config)
        for j, equations in enumerate(mapped(work, range(len(surfaces)))):
            for i, block, slope in equations:
                _add_pair(normal, gradient, i, j, block, slope)
        step = -np.linalg.solve(normal, gradient)[: 6 * len(poses)].reshape(-1, 6)
        poses = [_moved(pose, change) for pose, change in zip(poses, step, strict=True)]
        if np.abs(step).max() < 2e-5:  # 20 micrometres: far below the noise
            break
    return poses


def _overlapping(angles: Sequence[float], reach_deg: float) -> list[tuple[int, int]]:
    """Ordered pairs of views near enough in angle, round the full turn, to see the same cloth.

    A view has at most MOST_PARTNERS on either side, evenly chosen, the nearest and the farthest
    among them: the cost grows with the views, not with their square.
    """
    turn = np.asarray(angles)[None] - np.asarray(angles)[:, None]
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    near = (np.abs(turn) <= np.radians(reach_deg) + 1e-6) & ~np.eye(len(turn), dtype=bool)
    pairs = []
    for i in range(len(turn)):
        for side in (near[i] & (turn[i] < 0), near[i] & (turn[i] >= 0)):
            there = np.flatnonzero(side)
            there = there[np.argsort(np.abs(turn[i, there]), kind="stable")]
            picked = np.linspace(0, len(there) - 1, min(len(there), MOST_PARTNERS)).astype(int)
            pairs += [(i, int(j)) for j in np.sort(there[picked])]
    return pairs


def _thinned(surface: ViewSurface, count: int) -> Int:
    """Rows of a surface, evenly spread in the order of its pixels."""
    step = max(1, len(surface.points) // count)
    return np.arange(0, len(surface.points), step)


def _prior(surfaces: Sequence[ViewSurface], config: RotationConfig) -> Float:
    """Information of the views' motions (6 each) and of the shared error of the axis (4).

    An axis that is off by (e, d) at angle 0 moves the points of a view at angle a by the rotated
    -a of it; each view's own motion is what is left after that.
    """
    n = len(surfaces)
    own = 1 / np.array([np.radians(config.lag_deg)] * 3 + [config.sway_m] * 3) ** 2
    shared = 1 / np.array([np.radians(config.axis_deg)] * 2 + [config.axis_m] * 2) ** 2
    information = np.zeros((6 * n + 4, 6 * n + 4))
    information[6 * n :, 6 * n :] = np.diag(shared)
    for k, surface in enumerate(surfaces):
        back = rotation_about(np.array([0.0, 0.0, 1.0]), -surface.angle_rad)[:, :2]
        effect = np.zeros((6, 4))
        effect[:3, :2], effect[3:, 2:] = back, back
        row = np.zeros((6, len(information)))
        row[:, 6 * k : 6 * k + 6], row[:, 6 * n :] = np.eye(6), -effect
        information += row.T @ (own[:, None] * row)
    return information


def _parameters(poses: Sequence[Float], size: int) -> Float:
    """Rotation vector and shift of each pose, and the axis error that fits them: solved anew."""
    flat = np.zeros(size)
    for k, pose in enumerate(poses):
        skew = (pose[:3, :3] - pose[:3, :3].T) / 2  # corrections are a degree or two at most
        flat[6 * k : 6 * k + 3] = skew[2, 1], skew[0, 2], skew[1, 0]
        flat[6 * k + 3 : 6 * k + 6] = pose[:3, 3]
    return flat


def _seen_from(surface: ViewSurface, rows: Int, pose: Float) -> tuple[Float, Float]:
    """Some points and normals of a view in the common frame."""
    return transform_points(pose, surface.smooth[rows]), surface.normals[rows] @ pose[:3, :3].T


def _equations(
    moved: Sequence[tuple[Float, Float]],
    partners: Sequence[Sequence[int]],
    surfaces: Sequence[ViewSurface],
    poses: Sequence[Float],
    config: RotationConfig,
    j: int,
) -> list[tuple[int, Float, Float]]:
    """Normal equations of the distances of its partners' points from view j's surface.

    Returns
    -------
    list of (int, ndarray of shape (6, 6), ndarray of shape (6,))
        Partner, information, gradient.
    """
    if not partners[j]:
        return []
    owner = np.repeat(partners[j], [len(moved[i][0]) for i in partners[j]])
    a = np.vstack([moved[i][0] for i in partners[j]])
    normals_i = np.vstack([moved[i][1] for i in partners[j]])
    surface, pose = surfaces[j], poses[j]
    inside_j = transform_points(inverse(pose), a)
    distance, near = surface.tree.query(inside_j, distance_upper_bound=config.register_reach_m)
    found = np.flatnonzero(np.isfinite(distance))
    n = surface.normals[near[found]] @ pose[:3, :3].T
    alike = (normals_i[found] * n).sum(1) > 0.8
    found, n = found[alike], n[alike]
    a, owner = a[found], owner[found]
    b = transform_points(pose, surface.smooth[near[found]])
    error = ((a - b) * n).sum(1)
    robust = config.noise_m**-2 / (1 + (error / (config.noise_m * 2)) ** 2)
    jacobian = np.hstack([np.cross(a, n), n])
    equations = []
    for i in partners[j]:
        mine = owner == i
        count = int(mine.sum())
        if count < 10:
            continue
        rows = jacobian[mine]
        weight = robust[mine] * min(1.0, PAIR_POINTS / count)
        equations.append((i, rows.T @ (weight[:, None] * rows), rows.T @ (weight * error[mine])))
    return equations


def _add_pair(normal: Float, gradient: Float, i: int, j: int, block: Float, slope: Float) -> None:
    at_i, at_j = slice(6 * i, 6 * i + 6), slice(6 * j, 6 * j + 6)
    normal[at_i, at_i] += block
    normal[at_j, at_j] += block
    normal[at_i, at_j] -= block
    normal[at_j, at_i] -= block
    gradient[at_i] += slope
    gradient[at_j] -= slope


def _moved(pose: Float, change: Float) -> Float:
    """A pose followed by a small rotation and shift."""
    angle = float(np.linalg.norm(change[:3]))
    axis = change[:3] / angle if angle > 1e-12 else np.array([0.0, 0.0, 1.0])
    return rigid(rotation_about(axis, angle), change[3:]) @ pose
