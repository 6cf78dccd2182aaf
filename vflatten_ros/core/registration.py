"""Views of one rotation, brought into one frame: the wrist angle first, then their shared surface.

The item sways by millimetres and lags behind the wrist by a fraction of a degree, and the axis
calibration may be off. As it comes, a view is placed by those before it. In the end every view gets
a small rigid correction, and all views together one correction of the axis. All are found at once
from point-to-plane distances between overlapping views (Chen & Medioni 1992), the first and the
last ones included, and held by a prior: without it smooth legs slide along themselves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import takewhile

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.errors import NotEnoughViews
from vflatten_ros.core.features import NO_FEATURES, Features, features_of
from vflatten_ros.core.geometry import Float, inverse, transform_directions, transform_points
from vflatten_ros.core.grain import Grain, grain_of, suited, typical
from vflatten_ros.core.motions import (
    AXIS,
    axis_error,
    axis_information,
    effect,
    own_information,
    parameters,
    stepped,
)
from vflatten_ros.core.parallel import mapped
from vflatten_ros.core.sight import Sight, sight_of
from vflatten_ros.core.thinning import thinned
from vflatten_ros.core.turntable import TURN
from vflatten_ros.core.values import Int, Progress, View, no_progress

MIN_POINTS = 100  # a view with fewer item points shows nothing that could be placed
LEAST_PLANES = 20  # points of a view with a plane through their neighbours
PAIR_POINTS = 300.0  # noise is alike in neighbouring pixels: more pairs than this say no more
MOST_PARTNERS = 4  # on either side of a view
FOLD_ROUNDS = 3  # of placing one view by those before it
SETTLED = 2e-5  # step, metres and radians, far below the noise
NORMAL_MAD = 1.4826  # standard deviation of a normal distribution, in median deviations
FEWEST_PAIRS, FAR_DEG = 3, 50.0  # of neighbouring views, for them to tell whether they fit
NEAR_DEG, LEAST_NEAR, LEAST_FAR = 31.0, 0.7, 0.5  # share on itself of views apart up to so much,
# and up to FAR_DEG; the least seen was 0.73 and 0.58, the most of views wrongly turned 0.60, 0.32
SAME = 3.0  # standard deviations of the noise, within which points lie on a surface
HOPELESS = 0.6  # of the least; errors of depth that neighbouring points share halve what agrees
PLAINLY = 1.5  # times as much lies on itself one way, for it not to be the other
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
    grain: Grain  # of the points, or as other views tell
    sight: Sight | None = None  # in the hanger frame; None if the cloud is not that of a camera
    features: Features = NO_FEATURES  # of the smooth surface, hanger frame


def view_surface(
    view: View, config: RotationConfig, prints: bool = False, noise_m: float = 0.0
) -> ViewSurface:
    """Local planes of one view's points. Needs no other view: do it as the view arrives.

    Points with too few neighbours for a plane (flying pixels, shreds) are left out, and whole rows
    and columns of an image that is finer than the config is for.

    Parameters
    ----------
    view : View
    config : RotationConfig
    prints : bool
        Look for features of the colour image, too.
    noise_m : float
        Least noise of the points: other views may tell of more than shows in this one.

    Raises
    ------
    NotEnoughViews
        The view has hardly any points on the item, or they are too far apart for planes.
    """
    T_hanger_rig = inverse(view.calibration.T_rig_hanger(view.angle_rad))
    view, needed = thinned(view, config)
    points = transform_points(T_hanger_rig, view.points_rig)
    if len(points) < MIN_POINTS:
        raise NotEnoughViews(
            f"view {view.view_id}: {len(points)} points on the item, expected {MIN_POINTS}; "
            "widen segmentation.radius_m if that cuts the item off"
        )
    camera = T_hanger_rig[:3, 3]
    grain = grain_of(points)
    grain = replace(grain, noise_m=max(grain.noise_m, noise_m))
    smooth, normals, count = _planes(points, suited(config, grain).view_fit_m)
    normals = normals * np.where(((camera - points) * normals).sum(1) < 0, -1.0, 1.0)[:, None]
    row = np.flatnonzero(count >= LEAST)
    if len(row) < LEAST_PLANES:
        raise NotEnoughViews(
            f"view {view.view_id}: {len(row)} of {len(points)} points have {LEAST} others around "
            f"them to lay a plane through, expected {LEAST_PLANES}: they are "
            f"{1e3 * grain.pitch_m:.1f} mm apart; give denser clouds, or raise rotation.view_fit_m"
        )
    smooth = smooth[row]
    return ViewSurface(
        view.view_id,
        view.angle_rad,
        points[row],
        smooth,
        normals[row],
        needed[row],
        camera,
        cKDTree(smooth),
        grain,
        sight_of(points, view.pixel, view.shape),
        features_of(view, smooth, row) if prints else NO_FEATURES,
    )


def turned(surface: ViewSurface, T_new_old: Float, angle_rad: float) -> ViewSurface:
    """The same surface, had the view been taken at another angle or about another axis.

    Parameters
    ----------
    surface : ViewSurface
    T_new_old : ndarray of shape (4, 4)
        Takes its hanger coordinates to those that the other angle and axis give.
    angle_rad : float
        The other angle.

    Returns
    -------
    ViewSurface
        Without sight, which no registration asks for.
    """
    smooth = transform_points(T_new_old, surface.smooth)
    return replace(
        surface,
        angle_rad=angle_rad,
        points=transform_points(T_new_old, surface.points),
        smooth=smooth,
        normals=transform_directions(T_new_old, surface.normals),
        camera=transform_points(T_new_old, surface.camera),
        tree=cKDTree(smooth),
        sight=None,
        features=surface.features.turned(T_new_old),
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


@dataclass(frozen=True, eq=False)
class Folded:
    """Views in the order in which they came, each placed by those before it."""

    surfaces: tuple[ViewSurface, ...]
    poses: tuple[Float, ...]  # (4, 4) each: takes its hanger coordinates to the common ones
    config: RotationConfig


def fold_in(
    surfaces: Sequence[ViewSurface], config: RotationConfig, so_far: Folded | None = None
) -> Folded:
    """Place every view by those before it: what can be done before the last one comes.

    Parameters
    ----------
    surfaces : sequence of ViewSurface
        In the order in which they came.
    config : RotationConfig
    so_far : Folded, optional
        An earlier result. What it has of the first views is kept; the result is the same without.
    """
    poses: list[Float] = []
    if so_far is not None and so_far.config == config:
        known = zip(surfaces, so_far.surfaces, so_far.poses, strict=False)
        poses += [pose for _, _, pose in takewhile(lambda found: found[0] is found[1], known)]
    for k in range(len(poses), len(surfaces)):
        poses.append(_placed_by(surfaces[:k], poses, surfaces[k], config))
    return Folded(tuple(surfaces), tuple(poses), config)


def _placed_by(
    before: Sequence[ViewSurface], poses: Sequence[Float], new: ViewSurface, config: RotationConfig
) -> Float:
    """Pose of a view by those before it, which stay: the axis as they have it, then the surface."""
    config = suited(config, new.grain)
    guess = effect(new.angle_rad) @ axis_error([s.angle_rad for s in before], poses, config)
    pose = stepped(np.eye(4), guess)
    everyone = [*before, new]
    pairs = _overlapping([s.angle_rad for s in everyone], config.overlap_deg)
    partners = [i for i, j in pairs if j == len(before)]
    moved = {
        i: _seen_from(before[i], _thinned(before[i], config.register_points), poses[i])
        for i in partners
    }
    own = own_information(config)
    for _ in range(FOLD_ROUNDS):
        off = parameters([pose])
        normal, gradient = np.diag(own), own * (off - guess)
        for _, block, slope in _equations(moved, config, (partners, new, pose)):
            normal, gradient = normal + block, gradient - slope
        step = -np.linalg.solve(normal, gradient)
        pose = stepped(pose, step)
        if np.abs(step).max() < SETTLED:
            break
    return pose


def register_views(
    surfaces: Sequence[ViewSurface],
    config: RotationConfig,
    progress: Progress = no_progress,
    so_far: Folded | None = None,
) -> list[Float]:
    """Correction of every view, so that views that see the same cloth agree.

    Parameters
    ----------
    surfaces : sequence of ViewSurface
        At least two, in the order in which they came.
    config : RotationConfig
        Its lengths are suited to the views here.
    progress : Progress
    so_far : Folded, optional
        Result of fold_in for some of the views, with the same config, made as they came.

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
    poses = list(fold_in(surfaces, config, so_far).poses)
    config = suited(config, typical([surface.grain for surface in surfaces]))
    partners = _partners(surfaces, config)
    thin = [_thinned(s, config.register_points) for s in surfaces]
    prior = _prior(surfaces, config)
    for done in range(config.register_rounds):
        progress("register", done / config.register_rounds)
        placed = zip(surfaces, thin, poses, strict=True)
        moved = {i: _seen_from(*each) for i, each in enumerate(placed)}
        off = np.r_[parameters(poses), np.zeros(AXIS)]  # the axis error is solved anew
        normal, gradient = prior.copy(), prior @ off
        equations = partial(_equations, moved, config)
        for j, found in enumerate(mapped(equations, zip(partners, surfaces, poses, strict=True))):
            for i, block, slope in found:
                _add_pair(normal, gradient, i, j, block, slope)
        step = -np.linalg.solve(normal, gradient)[: 6 * len(poses)].reshape(-1, 6)
        poses = [stepped(pose, change) for pose, change in zip(poses, step, strict=True)]
        if np.abs(step).max() < SETTLED:
            break
    return poses


def disagreement_m(
    surfaces: Sequence[ViewSurface], poses: Sequence[Float], config: RotationConfig
) -> float:
    """How far the surfaces of overlapping views are apart: a robust standard deviation.

    Where neighbouring points of a view have little of their noise in common, it is about as
    large as their noise; errors that they have in common (of matching blocks, or of an item that
    does not hang still) make it larger.

    Parameters
    ----------
    surfaces : sequence of ViewSurface
    poses : sequence of ndarray of shape (4, 4)
        Result of register_views for them.
    config : RotationConfig

    Returns
    -------
    float
        Zero if no views overlap.
    """
    config = suited(config, typical([surface.grain for surface in surfaces]))
    partners = _partners(surfaces, config)
    placed = zip(surfaces, poses, strict=True)
    moved = {
        i: _seen_from(surface, _thinned(surface, config.register_points), pose)
        for i, (surface, pose) in enumerate(placed)
    }

    def errors(of_view: tuple[Sequence[int], ViewSurface, Float]) -> Float:
        return _residuals(moved, config, of_view).error

    found = np.concatenate(list(mapped(errors, zip(partners, surfaces, poses, strict=True))))
    return float(NORMAL_MAD * np.median(np.abs(found))) if len(found) else 0.0


@dataclass(frozen=True)
class Agreement:
    """How much of the cloth that neighbouring views show lies on itself."""

    share: float  # 0-1, of one view's points; those that the next one does not show included
    least: float  # of views that were placed rightly

    @property
    def enough(self) -> bool:
        """Whether the views fit together beyond doubt."""
        return self.share >= self.least

    @property
    def hopeless(self) -> bool:
        """Whether they do not, however noisy they are."""
        return self.share < HOPELESS * self.least

    def plainly_more_than(self, other: Agreement) -> bool:
        """Whether this is how the views are to be placed, and not the other way."""
        return not self.hopeless and self.share > PLAINLY * other.share


def agreement(
    surfaces: Sequence[ViewSurface], poses: Sequence[Float], config: RotationConfig
) -> Agreement:
    """Whether registered views fit together.

    Parameters
    ----------
    surfaces : sequence of ViewSurface
    poses : sequence of ndarray of shape (4, 4)
        Of these.
    config : RotationConfig

    Returns
    -------
    Agreement
        Enough if hardly any two views are near enough in angle to tell.
    """
    config = suited(config, typical([surface.grain for surface in surfaces]))
    angles = np.array([surface.angle_rad for surface in surfaces])
    order = np.argsort(angles % TURN, kind="stable")
    after = np.roll(order, -1)
    steps = (angles[after] - angles[order]) % TURN
    shares = []
    for i, j in zip(order[steps <= np.radians(FAR_DEG)], after[steps <= np.radians(FAR_DEG)]):
        rows = _thinned(surfaces[i], config.register_points)
        seen = {int(i): _seen_from(surfaces[i], rows, poses[i])}
        found = _residuals(seen, config, ([int(i)], surfaces[j], poses[j]))
        shares.append((np.abs(found.error) < SAME * config.noise_m).sum() / len(rows))
    if len(shares) < FEWEST_PAIRS:
        return Agreement(1.0, 0.0)
    near = np.median(steps[steps <= np.radians(FAR_DEG)]) <= np.radians(NEAR_DEG)
    return Agreement(float(np.mean(shares)), LEAST_NEAR if near else LEAST_FAR)


def _partners(surfaces: Sequence[ViewSurface], config: RotationConfig) -> list[list[int]]:
    """Of each view, those that see the same cloth."""
    pairs = _overlapping([s.angle_rad for s in surfaces], config.overlap_deg)
    return [[i for i, j in pairs if j == to] for to in range(len(surfaces))]


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
    """Information of the views' motions (6 each) and of the shared error of the axis.

    Each view's own motion is what is left after that.
    """
    n, own = len(surfaces), own_information(config)
    information = np.zeros((6 * n + AXIS, 6 * n + AXIS))
    information[6 * n :, 6 * n :] = np.diag(axis_information(config))
    for k, surface in enumerate(surfaces):
        row = np.zeros((6, len(information)))
        row[:, 6 * k : 6 * k + 6], row[:, 6 * n :] = np.eye(6), -effect(surface.angle_rad)
        information += row.T @ (own[:, None] * row)
    return information


def _seen_from(surface: ViewSurface, rows: Int, pose: Float) -> tuple[Float, Float]:
    """Some points and normals of a view in the common frame."""
    return transform_points(pose, surface.smooth[rows]), surface.normals[rows] @ pose[:3, :3].T


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Distances of other views' points from a view's surface."""

    owner: Int  # (n,) view that each point is of
    at: Float  # (n, 3) the points, common frame
    normal: Float  # (n, 3) of the surface there
    error: Float  # (n,) m


def _residuals(
    moved: Mapping[int, tuple[Float, Float]],
    config: RotationConfig,
    of_view: tuple[Sequence[int], ViewSurface, Float],
) -> _Residuals:
    """Of the points that lie near the view's surface; as _equations."""
    partners, surface, pose = of_view
    if not partners:
        none = np.zeros((0, 3))
        return _Residuals(np.zeros(0, dtype=np.int64), none, none, none[:, 0])
    owner = np.repeat(partners, [len(moved[i][0]) for i in partners])
    a = np.vstack([moved[i][0] for i in partners])
    normals_i = np.vstack([moved[i][1] for i in partners])
    inside_j = transform_points(inverse(pose), a)
    distance, near = surface.tree.query(inside_j, distance_upper_bound=config.register_reach_m)
    found = np.flatnonzero(np.isfinite(distance))
    n = surface.normals[near[found]] @ pose[:3, :3].T
    alike = (normals_i[found] * n).sum(1) > 0.8
    found, n = found[alike], n[alike]
    a, owner = a[found], owner[found]
    b = transform_points(pose, surface.smooth[near[found]])
    return _Residuals(owner, a, n, ((a - b) * n).sum(1))


def _equations(
    moved: Mapping[int, tuple[Float, Float]],
    config: RotationConfig,
    of_view: tuple[Sequence[int], ViewSurface, Float],
) -> list[tuple[int, Float, Float]]:
    """Normal equations of the distances of its partners' points from a view's surface.

    Parameters
    ----------
    moved : mapping of int to (ndarray of shape (n, 3), ndarray of shape (n, 3))
        Some points of each view, and their normals, in the common frame.
    config : RotationConfig
    of_view : (sequence of int, ViewSurface, ndarray of shape (4, 4))
        Partners, surface and pose.

    Returns
    -------
    list of (int, ndarray of shape (6, 6), ndarray of shape (6,))
        Partner, information, gradient.
    """
    found = _residuals(moved, config, of_view)
    error = found.error
    robust = config.noise_m**-2 / (1 + (error / (config.noise_m * 2)) ** 2)
    jacobian = np.hstack([np.cross(found.at, found.normal), found.normal])
    equations = []
    for i in of_view[0]:
        mine = found.owner == i
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
