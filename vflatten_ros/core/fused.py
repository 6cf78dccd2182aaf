"""All views of a rotation to one model of the hanging item: registered, then fused to samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from vflatten_ros.core.config import CorrespondenceConfig, IntegrationConfig, RotationConfig
from vflatten_ros.core.correspondences import NOTHING_GIVEN, Judged, judged, place_view
from vflatten_ros.core.edges import inside_edges, pixels_to_edge, with_rows
from vflatten_ros.core.errors import NotEnoughViews
from vflatten_ros.core.fat_edges import fat_px
from vflatten_ros.core.fat_edges import notice_of as fat_notice
from vflatten_ros.core.fusion import Points, Samples, fuse
from vflatten_ros.core.geometry import transform_directions, transform_points
from vflatten_ros.core.grain import Grain, borne_out, notices_of, suited, typical
from vflatten_ros.core.looked_past import kept_rows
from vflatten_ros.core.looked_past import notice_of as past_notice
from vflatten_ros.core.parallel import mapped
from vflatten_ros.core.registration import (
    Folded,
    ViewSurface,
    disagreement_m,
    register_views,
    view_surface,
)
from vflatten_ros.core.sight import PlacedSight
from vflatten_ros.core.slide import neighbours, slide_m
from vflatten_ros.core.slide import notice_of as slide_notice
from vflatten_ros.core.turning import as_they_turn
from vflatten_ros.core.values import (
    Calibration,
    Correspondence,
    Float,
    Int,
    Notice,
    Progress,
    View,
    no_progress,
)

FEWEST_VIEWS = 2  # of a rotation


@dataclass(frozen=True, eq=False)
class Fused:
    """Samples of the whole visible surface."""

    samples: Samples
    points: Points  # that the samples were fitted to
    view_ids: Int  # (v,) of the points' views
    point_pixel: Int  # (m, 2)
    grain: Grain  # of the points, median of the views
    calibration: Calibration | None = None  # of the hanger frame that they are in
    sights: tuple[PlacedSight, ...] = ()  # none: whether cloth goes on is told by the samples
    given: Judged = NOTHING_GIVEN  # corresponding points
    notices: tuple[Notice, ...] = ()

    @property
    def view_id(self) -> Int:
        """(n,) of the measured point nearest to each sample."""
        view: Int = self.points.view[self.samples.source]
        return self.view_ids[view]

    @property
    def pixel(self) -> Int:
        """(n, 2) of that point."""
        return self.point_pixel[self.samples.source]


def fuse_views(
    views: Sequence[View],
    config: RotationConfig,
    progress: Progress = no_progress,
    prepared: Mapping[int, ViewSurface] | None = None,
    given: Sequence[Correspondence] = (),
    limits: IntegrationConfig | None = None,
    prints: CorrespondenceConfig | None = None,
    so_far: Folded | None = None,
) -> Fused:
    """Register and fuse the views.

    Parameters
    ----------
    views : sequence of View
        Of one rotation, two or more.
    config : RotationConfig
    progress : Progress
    prepared : mapping of int to ViewSurface, optional
        Results of view_surface by view_id, made as the views arrived.
    given : sequence of Correspondence
        By a person. Those that the registration bears out join the surface.
    limits : IntegrationConfig, optional
    prints : CorrespondenceConfig, optional
        With it, features of some neighbouring views check the registration.
    so_far : Folded, optional
        Result of fold_in for some of the views, made as they arrived.

    Raises
    ------
    NotEnoughViews
        Fewer than two views show enough to be placed; if some do not, the others are used.
    DisconnectedSurface
        The points are too far apart to show a surface.
    """
    features = prints is not None and prints.features
    registered = _registered(views, config, progress, prepared or {}, features, so_far)
    surfaces, poses = registered.surfaces, registered.poses
    by_id = {view.view_id: view for view in views}
    views = [by_id[surface.view_id] for surface in surfaces]
    grain = typical([surface.grain for surface in surfaces])
    notices = registered.notices + notices_of(config, grain, registered.apart_m)
    config = suited(config, grain)
    looked = []
    if prints is not None and features:
        looked = neighbours({view.view_id: view.angle_rad for view in views}, prints.check_pairs)
    named = {i for pair in given for i in (pair.view_a, pair.view_b)}
    named |= {i for pair in looked for i in pair}
    placed = {
        view.view_id: place_view(view, surface, pose)
        for view, surface, pose in zip(views, surfaces, poses, strict=True)
        if view.view_id in named
    }
    count = [len(surface.points) for surface in surfaces]
    placed_points = zip(poses, surfaces, strict=True)
    placed_normals = zip(poses, surfaces, strict=True)
    points = Points(
        xyz=np.vstack([transform_points(pose, s.points) for pose, s in placed_points]),
        normal=np.vstack([transform_directions(pose, s.normals) for pose, s in placed_normals]),
        view=np.repeat(np.arange(len(surfaces), dtype=np.int32), count),
    )
    view_ids = np.array([view.view_id for view in views], dtype=np.int64)
    point_pixel = np.vstack([v.pixel[s.index] for v, s in zip(views, surfaces, strict=True)])
    samples = fuse(points, config, progress)
    slid = None
    if prints is not None and looked:
        progress("fuse", 0.9)
        slid = slide_m([(placed[i], placed[j]) for i, j in looked], prints)
    if prints is not None and slid is not None and slid > prints.slide_m:
        notices = (*notices, slide_notice(slid))
    given, nowhere = _of_views_left(given, set(by_id) - {view.view_id for view in views})
    checked = judged(given, placed, limits or IntegrationConfig())
    sights = tuple(
        PlacedSight(surface.sight, pose)
        for surface, pose in zip(surfaces, poses, strict=True)
        if surface.sight is not None
    )
    return Fused(
        samples,
        points,
        view_ids,
        point_pixel,
        grain,
        registered.calibration,
        sights,
        checked,
        notices + nowhere,
    )


def _of_views_left(
    given: Sequence[Correspondence], left_out: set[int]
) -> tuple[list[Correspondence], tuple[Notice, ...]]:
    """Corresponding points without those in views that are left out, of which it tells."""
    kept: list[Correspondence] = []
    notices: list[Notice] = []
    for pair in given:
        gone = {pair.view_a, pair.view_b} & left_out
        if gone:
            text = f"a corresponding point in view {min(gone)}, which is left out"
            notices.append(Notice("correspondence_rejected", text))
        else:
            kept.append(pair)
    return kept, tuple(notices)


@dataclass(frozen=True, eq=False)
class _Registered:
    surfaces: Sequence[ViewSurface]
    poses: Sequence[Float]  # (4, 4) each: takes its hanger coordinates to the common ones
    apart_m: float  # of the surfaces of overlapping views
    calibration: Calibration  # that has the axis about which they turn
    notices: tuple[Notice, ...] = ()


def _registered(
    views: Sequence[View],
    config: RotationConfig,
    progress: Progress,
    prepared: Mapping[int, ViewSurface],
    features: bool,
    so_far: Folded | None,
) -> _Registered:
    """Surface and pose of each view, in the hanger frame of the axis about which they turn.

    Anew, where together they tell of fat edges, of points where there is nothing, or of more noise
    than any one of them shows.
    """
    seen = list(views)
    rows: list[Int] = [np.arange(len(view.points_rig)) for view in views]
    bare: dict[int, NotEnoughViews] = {}  # by view_id: what is said of one that shows too little

    def surface(view: View) -> ViewSurface:
        return prepared.get(view.view_id) or view_surface(view, config, features)

    def of_all(surface: Callable[[View], ViewSurface]) -> tuple[list[ViewSurface], list[int]]:
        """Surfaces of the views that have one, and which these are; the others are forgotten."""
        nonlocal seen, rows
        surfaces, kept = [], []
        for k, made in enumerate(_each(surface, seen, progress)):
            if isinstance(made, NotEnoughViews):
                bare[seen[k].view_id] = made
            else:
                surfaces.append(made)
                kept.append(k)
        if bare and len(kept) < FEWEST_VIEWS:
            raise next(iter(bare.values()))
        seen, rows = [seen[k] for k in kept], [rows[k] for k in kept]
        return surfaces, kept

    def anew(noise_m: float) -> tuple[list[ViewSurface], list[Float]]:
        def surface_again(view: View) -> ViewSurface:
            return view_surface(view, config, features, noise_m)

        surfaces, kept = of_all(surface_again)
        placed = Folded(tuple(surfaces), tuple(poses[k] for k in kept), turned.config)
        return surfaces, register_views(surfaces, turned.config, progress, placed)

    surfaces, _ = of_all(surface)
    poses = register_views(surfaces, config, progress, so_far)
    turned = as_they_turn(views[0].calibration, surfaces, poses, config, progress)
    poses = turned.poses
    notices = turned.notices
    grain, apart_m = _told_by_all(surfaces, poses, config)
    for told in (_edges, _looked_past) if config.trim_edges else ():
        notice, kept = told(_Placed(seen, surfaces, poses, grain, apart_m), config)
        if notice is None:
            continue
        notices = (*notices, notice)
        rows = [of_view[k] for of_view, k in zip(rows, kept, strict=True)]
        seen = [with_rows(view, k) for view, k in zip(seen, kept, strict=True)]
        surfaces, poses = anew(0.0)
        grain, apart_m = _told_by_all(surfaces, poses, config)
    noisier = borne_out(grain, apart_m)
    if suited(config, noisier) != suited(config, grain):
        surfaces, poses = anew(noisier.noise_m)
    pairs = zip(surfaces, rows, strict=True)
    surfaces = [replace(surface, index=of_view[surface.index]) for surface, of_view in pairs]
    poses = [turned.T_hanger_common @ pose for pose in poses]
    if bare:
        notices = (*notices, _left_out(bare))
    return _Registered(surfaces, poses, apart_m, turned.calibration, notices)


def _left_out(bare: Mapping[int, NotEnoughViews]) -> Notice:
    """Says which views were not used, and why."""
    ids = ", ".join(str(i) for i in sorted(bare))
    why = "; ".join(str(error) for error in bare.values())
    return Notice("view_left_out", f"without {'views' if len(bare) > 1 else 'view'} {ids}: {why}")


@dataclass(frozen=True, eq=False)
class _Placed:
    """Registered views, and what they tell of their points together."""

    views: Sequence[View]
    surfaces: Sequence[ViewSurface]
    poses: Sequence[Float]  # (4, 4) each: takes its hanger coordinates to the common ones
    grain: Grain
    apart_m: float  # of the surfaces of overlapping views

    @property
    def by_cameras(self) -> bool:
        """Whether all of the clouds are images."""
        return all(surface.sight is not None for surface in self.surfaces)


def _edges(placed: _Placed, config: RotationConfig) -> tuple[Notice | None, list[Int]]:
    """Rows of each view's points without fat edges, and what to say; None: there are none."""
    if not placed.by_cameras:
        return None, []
    pitch_m = placed.grain.pitch_m
    to_edge = list(mapped(partial(pixels_to_edge, pitch_m=pitch_m), placed.views))
    at_points = [near[s.index] for near, s in zip(to_edge, placed.surfaces, strict=True)]
    px = fat_px(placed.surfaces, placed.poses, at_points, config, pitch_m)
    if not px:
        return None, []
    pairs = zip(placed.views, to_edge, strict=True)
    return fat_notice(px), [inside_edges(view, near, px) for view, near in pairs]


def _looked_past(placed: _Placed, config: RotationConfig) -> tuple[Notice | None, list[Int]]:
    """The same without points where there is nothing."""
    if not placed.by_cameras:
        return None, []
    share, kept = kept_rows(placed.surfaces, placed.poses, placed.apart_m)
    return (past_notice(share) if share else None), kept


def _told_by_all(
    surfaces: Sequence[ViewSurface], poses: Sequence[Float], config: RotationConfig
) -> tuple[Grain, float]:
    """Typical grain, and how far surfaces are apart."""
    grain = typical([surface.grain for surface in surfaces])
    return grain, disagreement_m(surfaces, poses, config)


def _each(
    surface: Callable[[View], ViewSurface], views: Sequence[View], progress: Progress
) -> list[ViewSurface | NotEnoughViews]:
    """The surface of each view, or why it has none."""

    def tried(view: View) -> ViewSurface | NotEnoughViews:
        try:
            return surface(view)
        except NotEnoughViews as error:
            return error

    progress("surface", 0.0)
    surfaces: list[ViewSurface | NotEnoughViews] = []
    for each in mapped(tried, views):
        surfaces.append(each)
        progress("surface", len(surfaces) / len(views))
    return surfaces


def drawn_again(fused: Fused, draw: int, config: RotationConfig, progress: Progress) -> Fused:
    """The same points with other samples: where layers touch, what joins them hangs on a hair.

    Parameters
    ----------
    fused : Fused
        Result of fuse_views, which has draw 0.
    draw : int
    """
    return replace(fused, samples=fuse(fused.points, config, progress, draw))
