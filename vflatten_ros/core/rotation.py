"""The automatic method: all views of a rotation to the flattened surface, with no manual input.

Like the pipeline, this module knows the order of its stages, which do not know each other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vflatten_ros.core.config import CorrespondenceConfig, IntegrationConfig, RotationConfig
from vflatten_ros.core.correspondences import NOTHING_GIVEN, Judged, judged, place_view
from vflatten_ros.core.distances import Distances, Steps, link_steps, surface_distances
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.fusion import Points, Samples, fuse
from vflatten_ros.core.geometry import (
    loop_normals,
    thinned_loop,
    transform_directions,
    transform_points,
    twice_area,
)
from vflatten_ros.core.grain import Grain, borne_out, notices_of, suited, typical
from vflatten_ros.core.middle_slit import Axis, Banks, banks_of, between, middle_slit
from vflatten_ros.core.parallel import mapped
from vflatten_ros.core.puzzle import overlap as lying_on
from vflatten_ros.core.ramps import ramps
from vflatten_ros.core.registration import (
    Folded,
    ViewSurface,
    disagreement_m,
    register_views,
    view_surface,
)
from vflatten_ros.core.sheets import Links, link_samples, outward, sheet_edges
from vflatten_ros.core.sight import PlacedSight, goes_on
from vflatten_ros.core.slide import neighbours, slide_m
from vflatten_ros.core.slide import notice_of as slide_notice
from vflatten_ros.core.slits import slits
from vflatten_ros.core.unfolding import (
    carry,
    orientation,
    overlap,
    place_samples,
    settle,
    unfold,
)
from vflatten_ros.core.values import (
    Bool,
    Correspondence,
    FlatPoints,
    Float,
    Int,
    Notice,
    Outline,
    Progress,
    View,
    no_progress,
)

FIRM = 3  # distances along the sheet that place a sample firmly
FIRM_SHARE = 0.8  # of the samples, for the others to be left out of the outline
HIDDEN_M = 0.012  # samples round a point of the outline that say whether it is an edge
HIDDEN_SHARE = 0.75  # of the edges there that are hidden, above which it is no edge
GOES_ON_SHARE = 0.5  # of the edges round what was not seen of a placed item, for cloth to be there
SPUR_M = 0.012  # half the width of what is too narrow for a garment
SPUR_REACH = 0.8  # how far a corner goes beyond a disc in it, in radii
ROUGH, ROUGH_ROUNDS = 120, 4  # landmarks and reweightings where pieces are laid flat by themselves
FEWEST, ROUGH_SPACING = 50, 40  # landmarks of a small piece, and samples for each
MOST_DOUBTFUL = 0.1  # of the samples, at a doubt of 1
TOLD_M = 1e-4  # length of a link between samples that are said to be one point of the cloth
TOLD_AMONG = 8  # samples nearest to such a point, of which the nearest that faces its way is it
CUT = 2.0  # spacings between points of one slit
WITHIN = 0.5  # share of a group's points in the outline, below which it lies apart
DEEP_M = 0.020  # how deep within the outline a slit lies, by the middle of its points
SLIT_M = 0.03  # widest slit of which one side tells what the other is
WITHIN_M = 0.010  # how far an item may end within an outline that fits it
RIM_LAID_M = 0.015  # between the two sides of a rim that lies flat as one
CELL_M = 0.002  # of the image whose contour is the outline


@dataclass(frozen=True, eq=False)
class Fused:
    """Samples of the whole visible surface."""

    samples: Samples
    points: Points  # that the samples were fitted to
    view_ids: Int  # (v,) of the points' views
    point_pixel: Int  # (m, 2)
    grain: Grain  # of the points, median of the views
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


@dataclass(frozen=True, eq=False)
class Surface:
    """Samples of the whole visible surface, linked."""

    samples: Samples
    links: Links
    steps: Steps  # of the links
    edge: Int  # (n,) of sheet_edges, as far as views tell no better
    doubt: Float  # (n,) above 1: may be a ramp between two layers; 0 where nobody looked
    view_id: Int  # (n,) of the measured point nearest to each sample
    pixel: Int  # (n, 2)
    banks: Banks | None = None  # of a slit that leads up the middle


@dataclass(frozen=True, eq=False)
class Part:
    """Landmarks of what hangs together, flattened."""

    distances: Distances
    plane: Float  # (k, 2) places of the distances' landmarks


@dataclass(frozen=True, eq=False)
class Laid:
    """The visible surface or a part of it, flattened."""

    surface: Surface
    parts: tuple[Part, ...]
    points: FlatPoints  # one measured point near each sample
    row: Int  # (n,) of the samples
    side: Float  # (n,) 1 outside up, -1 outside down, 0 unclear
    firm: Bool  # (n,) placed by distances along the sheet
    stress_m: float  # rms excess over the distances
    overlap: float  # 0-1, share of the surface that lies on more of the same side
    notices: tuple[Notice, ...]

    @property
    def share(self) -> float:
        """Share of all samples that were flattened."""
        return sum(float(part.distances.inside.mean()) for part in self.parts)


@dataclass(frozen=True, eq=False)
class Unfolded(Laid):
    """The same with its outline."""

    outline: Outline


def unfold_surface(
    surface: Surface, config: RotationConfig, progress: Progress = no_progress
) -> Unfolded:
    """Flatten all that hangs together, front and back.

    Raises
    ------
    DisconnectedSurface
    """
    samples = surface.samples
    everywhere = np.ones(len(samples.xyz), dtype=bool)
    distances = surface_distances(
        samples.xyz, samples.normal, surface.links, everywhere, config, progress, surface.steps
    )
    plane = unfold(distances.bound_m, distances.same_sheet, config, progress)
    progress("outline", 0.0)
    return unfolded_from(surface, Part(distances, plane), config)


def together(
    groups: Sequence[Laid],
    parts: tuple[Part, ...],
    points: Sequence[FlatPoints],
    sides: Sequence[Float],
    config: RotationConfig,
    item: Float | None = None,
) -> Unfolded:
    """Several groups as one.

    Parameters
    ----------
    groups : sequence of Laid
    parts : tuple of Part
        Theirs, in one plane.
    points : sequence of FlatPoints
        Of each group, in that plane.
    sides : sequence of ndarray of shape (n,)
        Of each group's points, there.
    item : ndarray of shape (c, 2), optional
        Outline of the item by which they were placed: what lies between them is hidden cloth.
    """
    surface = groups[0].surface
    count = np.array([len(p.uv) for p in points])
    z = [p.uv @ np.array([1, 1j]) for p in points]
    folded = float(count @ [g.overlap for g in groups]) / count.sum()
    for j in range(1, len(groups)):
        here, up = np.concatenate(z[:j]), np.concatenate(sides[:j])
        folded += lying_on(here, up, z[j], sides[j]) * count[j] / count.sum()
    astray = [p.astray_m for p in points if p.astray_m is not None]
    all_points = FlatPoints(
        uv=np.vstack([p.uv for p in points]),
        xyz_hanger=np.vstack([p.xyz_hanger for p in points]),
        view_id=np.concatenate([p.view_id for p in points]),
        pixel=np.vstack([p.pixel for p in points]),
        sigma_m=np.concatenate([p.sigma_m for p in points]),
        stress=np.concatenate([p.stress for p in points]),
        inferred=np.concatenate([p.inferred for p in points]),
        astray_m=np.concatenate(astray) if astray else None,
    )
    row = np.concatenate([g.row for g in groups])
    firm = np.concatenate([g.firm for g in groups])
    side = np.concatenate(sides)
    outline = _outline(surface, row, all_points, side, firm, config, item)
    notices = {notice.code: notice for g in groups for notice in g.notices}
    within = [float(_within(p.uv, outline.uv).mean()) for p in points]
    if min(within) < WITHIN:
        apart = count[int(np.argmin(within))] / count.sum()
        text = f"a part, {100 * apart:.0f} % of what was seen, lies apart from the rest"
        notices["untrusted"] = Notice("untrusted", text)
    stress = float(np.sqrt((all_points.stress**2).mean()))
    return Unfolded(
        surface,
        parts,
        all_points,
        row,
        side,
        firm,
        stress,
        folded,
        tuple(notices.values()),
        outline,
    )


def passable_at(surface: Surface, doubt: float) -> Bool:
    """Samples in less doubt; noisy or sparse points look like steps anywhere."""
    most = float(np.quantile(surface.doubt, 1 - MOST_DOUBTFUL / doubt))
    passable: Bool = surface.doubt < max(doubt, most)
    return passable


def laid_flat(
    surface: Surface, links: Links, piece: Bool, config: RotationConfig, progress: Progress
) -> Float:
    """(n, 2) places of the samples of one piece, roughly; NaN elsewhere."""
    rows = np.flatnonzero(piece)
    few = min(ROUGH, max(FEWEST, len(rows) // ROUGH_SPACING))
    rough = replace(config, landmarks=few, unfold_rounds=ROUGH_ROUNDS)
    xyz, normal = surface.samples.xyz[rows], surface.samples.normal[rows]
    alone = links.among(piece)
    everywhere = np.ones(len(rows), dtype=bool)
    distances = surface_distances(xyz, normal, alone, everywhere, rough, progress)
    plane = unfold(distances.bound_m, distances.same_sheet, rough, progress)
    uv = place_samples(distances.around, distances.around_m, distances.around_sheet, plane)[0]
    places = np.full((len(piece), 2), np.nan)
    places[rows[distances.inside]] = uv[distances.inside]
    return places


def turn_parts(unfolded: Unfolded, swung: Float, rest: Float, config: RotationConfig) -> Unfolded:
    """The same surface with its loose parts (legs, sleeves) turned as a template says.

    Parameters
    ----------
    swung, rest : ndarray of shape (k, 2)
        The template's outline as it fits the item, and with its parts at rest.
    """
    parts = []
    for part in unfolded.parts:
        plane = carry(part.plane, swung, rest)
        plane = settle(plane, part.distances.bound_m, part.distances.same_sheet, config)
        parts.append(_laid_from(unfolded.surface, Part(part.distances, plane), config))
    if len(parts) == 1:
        return _outlined(parts[0], config)
    turned, at = [], 0
    for one in parts:  # as uncertain as they were
        was = slice(at, at + len(one.row))
        sigma = np.maximum(one.points.sigma_m, unfolded.points.sigma_m[was])
        astray = None if unfolded.points.astray_m is None else unfolded.points.astray_m[was]
        turned.append(replace(one.points, sigma_m=sigma, astray_m=astray))
        at += len(one.row)
    planes = tuple(part for one in parts for part in one.parts)
    return together(parts, planes, turned, [one.side for one in parts], config, rest)


def parted(unfolded: Unfolded, axes: Sequence[Axis], config: RotationConfig) -> Unfolded | None:
    """The same surface with the slit that leads up its middle; None: it has none.

    Parameters
    ----------
    unfolded : Unfolded
    axes : sequence of Axis
        Of the category that it looks like.
    config : RotationConfig

    Returns
    -------
    Unfolded or None
        Its outline goes in and out of the slit, and will when it is laid out anew.
    """
    surface, row, points, side = unfolded.surface, unfolded.row, unfolded.points, unfolded.side
    edge, links = _as_laid(surface, row, points.uv)
    slit = middle_slit(points.uv, side, edge, links, axes, config)
    if slit is None:
        return None
    laid, count = banks_of(points.uv, slit, config), len(surface.edge)
    banks = Banks(np.zeros(count, dtype=np.int64), np.zeros(count))
    banks.side[row], banks.along_m[row] = laid.side, laid.along_m
    surface = replace(surface, banks=banks)
    outline = _outline(surface, row, points, side, unfolded.firm, config)
    return replace(unfolded, surface=surface, outline=outline)


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
    """
    features = prints is not None and prints.features
    registered = _registered(views, config, progress, prepared or {}, features, so_far)
    surfaces, poses = registered.surfaces, registered.poses
    grain = typical([surface.grain for surface in surfaces])
    notices = notices_of(config, grain, registered.apart_m)
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
    checked = judged(given, placed, limits or IntegrationConfig())
    sights = tuple(
        PlacedSight(surface.sight, pose)
        for surface, pose in zip(surfaces, poses, strict=True)
        if surface.sight is not None
    )
    return Fused(samples, points, view_ids, point_pixel, grain, sights, checked, notices)


@dataclass(frozen=True, eq=False)
class _Registered:
    surfaces: Sequence[ViewSurface]
    poses: Sequence[Float]  # (4, 4) each: takes its hanger coordinates to the common ones
    apart_m: float  # of the surfaces of overlapping views


def _registered(
    views: Sequence[View],
    config: RotationConfig,
    progress: Progress,
    prepared: Mapping[int, ViewSurface],
    features: bool,
    so_far: Folded | None,
) -> _Registered:
    """Surface and pose of each view; anew, where they tell of more noise than any one shows."""

    def surface(view: View) -> ViewSurface:
        return prepared.get(view.view_id) or view_surface(view, config, features)

    def surface_again(view: View) -> ViewSurface:
        return view_surface(view, config, features, noisier.noise_m)

    surfaces = _each(surface, views, progress)
    poses = register_views(surfaces, config, progress, so_far)
    grain = typical([surface.grain for surface in surfaces])
    apart_m = disagreement_m(surfaces, poses, config)
    noisier = borne_out(grain, apart_m)
    if suited(config, noisier) == suited(config, grain):
        return _Registered(surfaces, poses, apart_m)
    surfaces = _each(surface_again, views, progress)
    placed = Folded(tuple(surfaces), tuple(poses), config)
    poses = register_views(surfaces, config, progress, placed)
    return _Registered(surfaces, poses, apart_m)


def _each(
    surface: Callable[[View], ViewSurface], views: Sequence[View], progress: Progress
) -> list[ViewSurface]:
    progress("surface", 0.0)
    surfaces: list[ViewSurface] = []
    for each in mapped(surface, views):
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


def link_surface(fused: Fused, config: RotationConfig, progress: Progress = no_progress) -> Surface:
    """Link the samples, and find where their sheets end."""
    progress("link", 0.0)
    samples = fused.samples
    links = link_samples(samples.xyz, samples.normal, config)
    progress("link", 0.7)
    links = links.with_links(*_told(fused, config), TOLD_M)
    edge = _edges(samples, links, fused.sights, config)
    doubt = np.zeros(len(samples.xyz))
    steps = link_steps(samples.xyz, samples.normal, links)
    return Surface(samples, links, steps, edge, doubt, fused.view_id, fused.pixel)


def _told(fused: Fused, config: RotationConfig) -> tuple[Int, Int]:
    """Samples that are one point of the cloth by the corresponding points given."""
    samples, given = fused.samples, fused.given
    if not given.used:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    tree = cKDTree(samples.xyz)
    ends = []
    for points, normals in ((given.points_a, given.normals_a), (given.points_b, given.normals_b)):
        away, near = tree.query(points, k=TOLD_AMONG, distance_upper_bound=config.link_m)
        alike = np.einsum("kni,ki->kn", samples.normal[near % len(samples.xyz)], normals) > 0.5
        away = np.where(alike, away, np.inf)
        best = away.argmin(axis=1)
        rows = np.arange(len(points))
        ends.append(np.where(np.isfinite(away[rows, best]), near[rows, best], -1))
    one, other = ends
    apart = (one >= 0) & (other >= 0) & (one != other)
    return one[apart], other[apart]


def doubts(fused: Fused, config: RotationConfig, progress: Progress = no_progress) -> Float:
    """How likely each sample (n,) joins two layers: above 1, it may."""
    samples, points = fused.samples, fused.points
    return ramps(samples.xyz, samples.normal, points.xyz, points.normal, config, progress)


def _edges(
    samples: Samples, links: Links, sights: Sequence[PlacedSight], config: RotationConfig
) -> Int:
    sheet = ~links.rim
    a, b = links.a[sheet], links.b[sheet]
    edge = sheet_edges(samples.xyz, samples.normal, a, b, config)
    ends = np.flatnonzero(edge)
    xyz, normal = samples.xyz[ends], samples.normal[ends]
    on = goes_on(xyz, normal, outward(samples.xyz, samples.normal, a, b)[ends], sights)
    edge[ends] = np.where(on < 0, edge[ends], 1 + on)
    return edge


def edges_laid(surface: Surface, row: Int, uv: Float) -> Int:
    """Edges (n,) of samples as they lie flat: 0 none, 1 of the cloth, 2 of what was seen of it.

    Where both sides of a rim lie side by side, the cloth ends, whatever hangs before it.

    Parameters
    ----------
    surface : Surface
    row : ndarray of shape (n,)
        The samples.
    uv : ndarray of shape (n, 2)
        Their places.
    """
    links, edge = surface.links, surface.edge[row]
    at = np.full(len(surface.edge), -1)
    at[row] = np.arange(len(row))
    rim = links.rim & (links.doubt < 1.0)
    a, b = at[links.a[rim]], at[links.b[rim]]
    both = (a >= 0) & (b >= 0)
    a, b = a[both], b[both]
    near = np.linalg.norm(uv[a] - uv[b], axis=1) < RIM_LAID_M
    edge[np.r_[a[near], b[near]]] = 1
    return edge


def unfolded_from(surface: Surface, part: Part, config: RotationConfig) -> Unfolded:
    """All samples of a part whose landmarks were flattened, and their outline."""
    return _outlined(_laid_from(surface, part, config), config)


def _laid_from(surface: Surface, part: Part, config: RotationConfig) -> Laid:
    samples, links, distances = surface.samples, surface.links, part.distances
    uv, misfit = place_samples(
        distances.around, distances.around_m, distances.around_sheet, part.plane
    )
    side = orientation(uv, samples.xyz, samples.normal, links.a, links.b)
    placed = np.isfinite(uv).all(1) & distances.inside
    points = FlatPoints(
        uv=uv[placed],
        xyz_hanger=samples.xyz[placed],
        view_id=surface.view_id[placed],
        pixel=surface.pixel[placed],
        sigma_m=np.hypot(config.uv_sigma_m, misfit[placed]),
        stress=misfit[placed],
        inferred=np.zeros(int(placed.sum()), dtype=bool),
    )
    stress = float(np.sqrt((misfit[placed] ** 2).mean()))
    notices = []
    if stress > config.high_stress_m:
        text = f"distances contradict each other by {1e3 * stress:.0f} mm"
        notices.append(Notice("high_stress", text))
    folded = overlap(part.plane, distances.bound_m, side[distances.chosen])
    if folded > config.untrusted_overlap:
        text = f"{100 * folded:.0f} % of the surface lies on more of its own side: not laid flat"
        notices.append(Notice("untrusted", text))
    # what is placed round rims alone has upper bounds only, and so lies too far out
    firm = (distances.around_sheet.sum(1) >= FIRM)[placed]
    firm |= firm.mean() < FIRM_SHARE  # too few would leave holes
    row, side = np.flatnonzero(placed), side[placed]
    return Laid(surface, (part,), points, row, side, firm, stress, folded, tuple(notices))


def _outlined(laid: Laid, config: RotationConfig) -> Unfolded:
    outline = _outline(laid.surface, laid.row, laid.points, laid.side, laid.firm, config)
    return Unfolded(**{f.name: getattr(laid, f.name) for f in fields(laid)}, outline=outline)


def _outline(
    surface: Surface,
    row: Int,
    points: FlatPoints,
    side: Float,
    firm: Bool,
    config: RotationConfig,
    item: Float | None = None,
) -> Outline:
    """Outline of the samples `row`, which lie where the points are."""
    edge, links = _as_laid(surface, row, points.uv)
    cuts = slits(points.uv, side, edge, links, config)
    slit = None
    if surface.banks is not None:
        slit = between(points.uv, surface.banks.of(row), config)
    return outline_of(points.uv[firm], points.sigma_m[firm], edge[firm], config, cuts, item, slit)


def _as_laid(surface: Surface, row: Int, uv: Float) -> tuple[Int, Links]:
    """Edges of the samples `row`, which lie at `uv`, and the links between them."""
    laid = np.zeros(len(surface.edge), dtype=bool)
    laid[row] = True
    order = np.argsort(row)
    links = surface.links.among(laid)
    links = replace(links, a=order[links.a], b=order[links.b])
    return edges_laid(surface, row, uv), links


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


def _within(uv: Float, outline: Float) -> Bool:
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
