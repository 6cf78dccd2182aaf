"""Points of the cloth that two views show, found from their registered surfaces, and their check.

Once every view's surface is in one frame, what lies there at one place and faces one way is the
same cloth. How sure that is depends on how near the two points are, how well the cloth faces both
cameras, and how far it is from where the view's surface ends: there another layer may follow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.config import CorrespondenceConfig, IntegrationConfig, RotationConfig
from vflatten_ros.core.errors import NotEnoughViews
from vflatten_ros.core.features import Features
from vflatten_ros.core.geometry import transform_directions, transform_points
from vflatten_ros.core.registration import ViewSurface, register_views
from vflatten_ros.core.values import Correspondence, Float, Int, Notice, Progress, View, no_progress

ALIKE = 0.9  # least cosine between the normals of one point in two views
FACING = 0.35  # cosine towards a camera at which half is lost: pixels are sheared there
STEP_SIGMA_M = 0.001  # of the heights of two smoothed surfaces of the same cloth, one sigma
RIM_NEIGHBOURS = 24  # of which the mean tells how near a surface's end is
RIM_INSIDE, RIM_END = 0.15, 0.45  # offset of that mean, in their reach: inside, at a straight end
MOST_CANDIDATES = 4000  # of a pair of views, evenly chosen
LEAST_CONFIDENCE = 0.2  # of the best, that a candidate for spreading needs


@dataclass(frozen=True, eq=False)
class PlacedView:
    """One view's surface in the frame that all views share."""

    view: View
    points: Float  # (n, 3) on the fitted surface, common frame
    normals: Float  # (n, 3) unit, outwards
    row: Int  # (n,) row of the view's points
    facing: Float  # (n,) cosine of the angle between the normal and the direction to the camera
    features: Features  # common frame

    @cached_property
    def tree(self) -> cKDTree:
        """Of the points."""
        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)


@dataclass(frozen=True, eq=False)
class Matches:
    """Points of one view and the same cloth in another."""

    a: Int  # (m,) rows of the first PlacedView
    b: Int  # (m,) rows of the second
    confidence: Float  # (m,) 0-1

    def part(self, keep: Int) -> Matches:
        """Some of the matches."""
        return Matches(self.a[keep], self.b[keep], self.confidence[keep])


def place_views(
    views: Sequence[View],
    surfaces: Sequence[ViewSurface],
    config: RotationConfig,
    progress: Progress = no_progress,
) -> list[PlacedView]:
    """Register the views and bring their surfaces to one frame; by the wrist angle if only one."""
    several = len(surfaces) > 1
    poses = register_views(surfaces, config, progress) if several else [np.eye(4)]
    found = zip(views, surfaces, poses, strict=True)
    return [place_view(view, surface, pose) for view, surface, pose in found]


def place_view(view: View, surface: ViewSurface, pose: Float) -> PlacedView:
    """One view's surface in the frame that `pose` (4, 4) takes its hanger coordinates to."""
    toward = surface.camera - surface.smooth
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    return PlacedView(
        view=view,
        points=transform_points(pose, surface.smooth),
        normals=transform_directions(pose, surface.normals),
        row=surface.index,
        facing=(toward * surface.normals).sum(1),
        features=surface.features.turned(pose),
    )


def common_cloth(a: PlacedView, b: PlacedView, config: CorrespondenceConfig) -> Matches:
    """Every place that both views show, by their registered surfaces.

    Parameters
    ----------
    a, b : PlacedView
        Of the same registration.
    config : CorrespondenceConfig

    Returns
    -------
    Matches
        Mutually nearest points; at most MOST_CANDIDATES.
    """
    step = max(1, len(a.points) // MOST_CANDIDATES)
    i = np.arange(0, len(a.points), step)
    distance, j = b.tree.query(a.points[i], distance_upper_bound=config.reach_m)
    found = np.isfinite(distance)
    i, j = i[found], j[found]
    alike = (a.normals[i] * b.normals[j]).sum(1)
    same = alike > ALIKE
    i, j, alike = i[same], j[same], alike[same]
    mutual = np.linalg.norm(a.points[a.tree.query(b.points[j])[1]] - a.points[i], axis=1)
    near = mutual < config.reach_m
    i, j, alike = i[near], j[near], alike[near]
    middle = a.normals[i] + b.normals[j]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    apart = b.points[j] - a.points[i]
    step_m = (apart * middle).sum(1)
    along_m = np.linalg.norm(apart - step_m[:, None] * middle, axis=1)
    confidence = (
        np.exp(-0.5 * (step_m / STEP_SIGMA_M) ** 2 - 0.5 * (along_m / config.reach_m) ** 2)
        * ((alike - ALIKE) / (1 - ALIKE)).clip(0, 1) ** 0.5
        * _seen(a.facing[i])
        * _seen(b.facing[j])
        * _inside(a, i)
        * _inside(b, j)
    )
    return Matches(i, j.astype(np.int64), confidence)


def _seen(facing: Float) -> Float:
    """1 where cloth faces the camera, 0 where it is seen from the side."""
    squared = facing.clip(0.0) ** 2
    share: Float = squared / (squared + FACING**2) * (1 + FACING**2)
    return share


def _inside(view: PlacedView, rows: Int) -> Float:
    """1 inside a view's surface, 0 at its end, where the neighbours lie to one side."""
    count = min(RIM_NEIGHBOURS, len(view.points))
    distance, near = view.tree.query(view.points[rows], k=count)
    offset = np.linalg.norm(view.points[near].mean(axis=1) - view.points[rows], axis=1)
    share = offset / np.maximum(distance[:, -1], 1e-9)
    inside: Float = ((RIM_END - share) / (RIM_END - RIM_INSIDE)).clip(0.0, 1.0)
    return inside


def spread(points: Float, confidence: Float, count: int) -> Int:
    """Rows of points that are sure and far from one another, the surest first.

    Farthest point next, its distance weighed by its confidence.

    Parameters
    ----------
    points : ndarray of shape (n, 3)
    confidence : ndarray of shape (n,)
    count : int
        Most rows.
    """
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    usable = confidence >= LEAST_CONFIDENCE * confidence.max()
    away = np.full(len(points), np.inf)
    picked = [int(confidence.argmax())]
    while len(picked) < min(count, int(usable.sum())):
        away = np.minimum(away, np.linalg.norm(points - points[picked[-1]], axis=1))
        value = np.where(usable, away * confidence, -1.0)
        best = int(value.argmax())
        if value[best] <= 0.0:
            break
        picked.append(best)
    return np.array(picked, dtype=np.int64)


def as_pairs(a: PlacedView, b: PlacedView, matches: Matches) -> tuple[Correspondence, ...]:
    """The matches by view and pixel."""
    pixel_a = a.view.pixel[a.row[matches.a]].tolist()
    pixel_b = b.view.pixel[b.row[matches.b]].tolist()
    ids = a.view.view_id, b.view.view_id
    return tuple(
        Correspondence(*ids, (p[0], p[1]), (q[0], q[1]), manual=False, confidence=float(sure))
        for p, q, sure in zip(pixel_a, pixel_b, matches.confidence, strict=True)
    )


@dataclass(frozen=True, eq=False)
class Judged:
    """Corresponding points that the registered surfaces bear out."""

    used: tuple[Correspondence, ...]
    points_a: Float  # (k, 3) of the first view of each, common frame
    points_b: Float
    normals_a: Float  # (k, 3)
    normals_b: Float
    notices: tuple[Notice, ...]  # of the others


NONE = np.zeros((0, 3))
NOTHING_GIVEN = Judged((), NONE, NONE, NONE, NONE, ())


def judged(
    given: Sequence[Correspondence], placed: Mapping[int, PlacedView], config: IntegrationConfig
) -> Judged:
    """Check corresponding points against the registration of all views.

    Parameters
    ----------
    given : sequence of Correspondence
        By a person.
    placed : mapping of int to PlacedView
        By view_id, the views that are named at least.
    config : IntegrationConfig
        reject_m: how far apart the registration may put one point.

    Raises
    ------
    NotEnoughViews
        A view is named that is not there.
    """
    used, rows, notices = [], [], []
    for pair in given:
        unknown = [i for i in (pair.view_a, pair.view_b) if i not in placed]
        if unknown:
            raise NotEnoughViews(f"correspondences name view {unknown[0]}, which is not used")
        a, b = placed[pair.view_a], placed[pair.view_b]
        i, j = _at(a, pair.pixel_a), _at(b, pair.pixel_b)
        off = float(np.linalg.norm(a.points[i] - b.points[j]))
        if off > config.reject_m:
            notices.append(rejected(pair, off, "the registration of all views is"))
            continue
        used.append(pair)
        rows.append((a.points[i], b.points[j], a.normals[i], b.normals[j]))
    if not used:
        return replace(NOTHING_GIVEN, notices=tuple(notices))
    at = np.array(rows)  # (k, 4, 3)
    return Judged(tuple(used), at[:, 0], at[:, 1], at[:, 2], at[:, 3], tuple(notices))


def _at(placed: PlacedView, pixel: tuple[int, int]) -> int:
    """The point of the surface at a pixel, or the nearest one."""
    away = placed.view.pixel[placed.row] - np.asarray(pixel)
    return int((away**2).sum(axis=1).argmin())


def rejected(pair: Correspondence, off_m: float, judge: str = "the others are") -> Notice:
    """Says that a corresponding point contradicts the others, and by how much."""
    text = (
        f"view {pair.view_a} pixel {pair.pixel_a} and view {pair.view_b} pixel {pair.pixel_b} are "
        f"{100 * off_m:.1f} cm apart on the item, if {judge} right; left out"
    )
    return Notice("correspondence_rejected", text)
