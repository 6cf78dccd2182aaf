"""The paper's method: two views and a few corresponding points (Kita & Kita 2019, section 3).

With evidence 'boundary' it is the paper's: boundary points, geodesic lines between points of
similar height, the straight distance to the next and second-next boundary point, and nothing else.
With 'surface' the cloth between the boundaries counts too: samples of every smooth patch are
related to their neighbours, and the views are joined by all cloth that both show.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.boundary import (
    Boundary,
    boundary_points,
    level_pairs,
    ring_pairs,
    with_corresponding,
)
from vflatten_ros.core.config import Config
from vflatten_ros.core.contour import outline_of_polygons, trace_outline
from vflatten_ros.core.correspondences import rejected
from vflatten_ros.core.errors import (
    DisconnectedSurface,
    InvalidCorrespondence,
    NotEnoughViews,
)
from vflatten_ros.core.flattening import flatten
from vflatten_ros.core.geodesics import BENT, Geodesics, geodesic_lines
from vflatten_ros.core.integration import (
    Joint,
    SurfaceSamples,
    align,
    consistent_pairs,
    join,
    merged,
    misses,
    network_of,
    start_places,
    unknowns,
)
from vflatten_ros.core.observation import Observation, edges, locate, observe, quads
from vflatten_ros.core.sampling import thinned
from vflatten_ros.core.unrolling import Complex, Relations, carry, frames_of, unroll
from vflatten_ros.core.values import (
    Bool,
    Correspondence,
    DistanceNetwork,
    FlatPiece,
    FlatPoints,
    FlatSurface,
    Flattened,
    Float,
    GeodesicLines,
    Int,
    Notice,
    Outline,
    Progress,
    View,
    no_progress,
)

LINES_PER_POINT = 1  # geodesic lines that start at a boundary point
POINT_SIGMA_M = 0.002  # of a flattened point, whatever its stress
MISFIT_M = 0.003  # of neighbours, beyond which they lose their say when unrolled
SMALLEST = 0.05  # share of the main piece's samples that makes a piece worth placing
FEWEST_PAIRS = 2  # that fix one view's place in the plane of the other
JUDGES = 3  # points given that agree need no others to tell whether they are right
MOSTLY_LOOSE = 0.55  # share of the samples outside the main piece beyond which sizes are a guess


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two observations and the points that correspond between them."""

    a: Observation
    b: Observation
    at_a: Int  # (k,) rows of the points of each
    at_b: Int
    used: tuple[Correspondence, ...]
    notices: tuple[Notice, ...]


def flatten_two_views(
    views: Sequence[View],
    correspondences: Sequence[Correspondence],
    config: Config,
    progress: Progress = no_progress,
    found: Sequence[Correspondence] = (),
) -> Flattened:
    """Flatten the side of an item that two views show.

    Parameters
    ----------
    views : sequence of View
        The two views, or more, of which the correspondences name two.
    correspondences : sequence of Correspondence
        Points of the cloth seen in both, given by a person; two or more if none were found.
    config : Config
    progress : Progress
    found : sequence of Correspondence
        Others of the same views, as in flatten_pair.

    Raises
    ------
    NotEnoughViews
        Not two views, or correspondences of views that are not there.
    InvalidCorrespondence
        Fewer than two, outside the item, or contradicting one another.
    DisconnectedSurface
        Nothing joins the two views.
    """
    if len(views) > 1 and len(correspondences) + len(found) < FEWEST_PAIRS:
        raise InvalidCorrespondence(
            "the two-view method needs two corresponding points or more (the paper: three to "
            f"five), got {len(correspondences)}; give them with --protocol or by the service "
            "add_correspondences"
        )
    first, second = named_views(views, [*correspondences, *found])
    a, b = observed([first, second], config, progress)
    return flatten_pair(a, b, correspondences, found, config, progress)


def observed(views: Sequence[View], config: Config, progress: Progress) -> list[Observation]:
    """What two views show, or one, or none."""
    if not views:
        return []
    with ThreadPoolExecutor(1) as other:  # numpy leaves the interpreter free for the second core
        waiting = [other.submit(observe, view, config, no_progress) for view in views[1:]]
        return [observe(views[0], config, progress), *(w.result() for w in waiting)]


def flatten_pair(
    a: Observation,
    b: Observation,
    given: Sequence[Correspondence],
    found: Sequence[Correspondence],
    config: Config,
    progress: Progress = no_progress,
) -> Flattened:
    """The same from what the two views show.

    Parameters
    ----------
    a, b : Observation
    given : sequence of Correspondence
        Points that a person gave; those that agree are all used.
    found : sequence of Correspondence
        Others, the best first. They fill up where fewer than two that agree were given, and tell
        which is wrong where less than three were given or those contradict one another.
    config : Config

    Raises
    ------
    InvalidCorrespondence
    DisconnectedSurface
    """
    pair = _corresponding(a, b, given, found, config)
    method = _from_boundaries if config.integration.evidence == "boundary" else _from_surfaces
    return method(pair, config, progress)


def _corresponding(
    a: Observation,
    b: Observation,
    given: Sequence[Correspondence],
    found: Sequence[Correspondence],
    config: Config,
) -> _Pair:
    own = _located(a, b, given, config)
    keep = consistent_pairs(own.points_a, own.points_b, config.integration)
    if found and (len(keep) < JUDGES or not keep.all()):
        more = _located(a, b, found, config)
        more = more.part(np.flatnonzero(more.on_patches)[: config.correspondences.count])
        own = own.with_more(more)
        keep = consistent_pairs(own.points_a, own.points_b, config.integration)
        if keep[: len(given)].sum() >= FEWEST_PAIRS:  # the others have judged, and are not needed
            own, keep = own.part(np.arange(len(given))), keep[: len(given)]
    if keep.sum() < FEWEST_PAIRS:
        raise InvalidCorrespondence(
            f"the {len(keep)} corresponding points contradict one another: at most {keep.sum()} "
            "can be points of one item that hangs still; check them"
        )
    off = misses(own.points_a, own.points_b, keep)
    notices = tuple(
        rejected(pair, off[k]) for k, pair in enumerate(own.pairs) if pair.manual and not keep[k]
    )
    used = tuple(pair for pair, kept in zip(own.pairs, keep, strict=True) if kept)
    return _Pair(a, b, own.at_a[keep], own.at_b[keep], used, notices)


@dataclass(frozen=True, eq=False)
class _Located:
    """Corresponding points and the rows of both views' points that they are."""

    a: Observation
    b: Observation
    pairs: tuple[Correspondence, ...]
    at_a: Int  # (k,)
    at_b: Int

    @property
    def points_a(self) -> Float:
        points: Float = self.a.surface.points[self.at_a]
        return points

    @property
    def points_b(self) -> Float:
        points: Float = self.b.surface.points[self.at_b]
        return points

    @property
    def on_patches(self) -> Bool:
        on: Bool = (self.a.patch[self.at_a] >= 0) & (self.b.patch[self.at_b] >= 0)
        return on

    def part(self, rows: Int) -> _Located:
        pairs = tuple(self.pairs[k] for k in rows)
        return _Located(self.a, self.b, pairs, self.at_a[rows], self.at_b[rows])

    def with_more(self, other: _Located) -> _Located:
        at = np.r_[self.at_a, other.at_a], np.r_[self.at_b, other.at_b]
        return _Located(self.a, self.b, self.pairs + other.pairs, *at)


def _located(
    a: Observation, b: Observation, pairs: Sequence[Correspondence], config: Config
) -> _Located:
    turned = [
        (p.pixel_a, p.pixel_b) if p.view_a == a.view.view_id else (p.pixel_b, p.pixel_a)
        for p in pairs
    ]
    reach = config.integration.pair_reach_px
    at_a = np.array([locate(a, p, reach) for p, _ in turned], dtype=np.int64)
    at_b = np.array([locate(b, q, reach) for _, q in turned], dtype=np.int64)
    return _Located(a, b, tuple(pairs), at_a, at_b)


def named_views(views: Sequence[View], given: Sequence[Correspondence]) -> tuple[View, View]:
    """The two views, in their order, that corresponding points name.

    Raises
    ------
    NotEnoughViews
        Fewer than two views, or one that is not there.
    InvalidCorrespondence
        Another number of views is named.
    """
    if len(views) < 2:
        raise NotEnoughViews(f"the two-view method needs two views, got {len(views)}")
    named = sorted({c.view_a for c in given} | {c.view_b for c in given})
    by_id = {view.view_id: view for view in views}
    unknown = [i for i in named if i not in by_id]
    if unknown:
        known = ", ".join(str(i) for i in by_id)
        raise NotEnoughViews(f"correspondences name view {unknown[0]}; there are views {known}")
    if len(named) != 2:
        raise InvalidCorrespondence(
            f"the two-view method joins two views, the correspondences name {len(named)}: {named}"
        )
    first, second = (v for v in views if v.view_id in named)
    return first, second


# --- evidence 'surface' -------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Sampled:
    """Samples of one view: corresponding points, boundary points, then the surface between."""

    samples: SurfaceSamples
    source: Int  # (n,) rows of the view's points
    boundary: int  # samples of these that are corresponding or boundary points


def _from_surfaces(pair: _Pair, config: Config, progress: Progress) -> Flattened:
    a, b = (_sample(o, at, config) for o, at in ((pair.a, pair.at_a), (pair.b, pair.at_b)))
    surface_a, surface_b = pair.a.surface, pair.b.surface
    motion = align(
        a.samples,
        b.samples,
        surface_a.points[pair.at_a],
        surface_b.points[pair.at_b],
        config.integration,
    )
    progress("integration", 0.0)
    joint = join(a.samples, b.samples, np.arange(len(pair.at_a)), motion, config.integration)
    lines, measured = _surface_lines(pair, (a, b), config, progress)
    network = merged([network_of(joint, config.integration), measured])
    pieces = tuple(
        _piece(pair, (a, b), joint, network, number, motion, config, progress)
        for number in _pieces_to_place(joint, len(a.source), len(pair.at_a))
    )
    progress("outline", 0.0)
    outline = trace_outline(pieces[0].surface, POINT_SIGMA_M, _half_pixel(pair), config.contour)
    notices = pair.notices + creases(joint, pieces)
    return Flattened(
        pieces[0].points, pieces[0].start_uv, lines, outline, pair.used, notices, pieces
    )


def _half_pixel(pair: _Pair) -> float:
    return 0.5 * min(pair.a.surface.spacing_m, pair.b.surface.spacing_m)


def _pieces_to_place(joint: Joint, count_a: int, pairs: int) -> list[int]:
    """The largest piece, which must hold cloth of both views, and others with corresponding points.

    Corresponding points are on the side of the item that is to be flattened; a piece without any
    may be of the other side, or the inside.
    """
    main = joint.piece == 0
    if not (main[:count_a].any() and main[count_a:].any()):
        raise DisconnectedSurface(
            "nothing joins the surfaces of the two views: give corresponding points on parts that "
            "both views show, or views nearer in angle"
        )
    marked = np.r_[joint.piece[:pairs], joint.piece[count_a : count_a + pairs]]
    size = np.bincount(joint.piece)
    return [0, *(int(p) for p in np.unique(marked) if p > 0 and size[p] >= SMALLEST * size[0])]


def _piece(
    pair: _Pair,
    sampled: tuple[_Sampled, _Sampled],
    joint: Joint,
    network: DistanceNetwork,
    number: int,
    motion: Float,
    config: Config,
    progress: Progress,
) -> FlatPiece:
    """Flatten one connected piece of the surface."""
    rows = np.flatnonzero(joint.piece == number)
    renumber = np.full(len(joint.piece), -1, dtype=np.int64)
    renumber[rows] = np.arange(len(rows))
    inside = np.flatnonzero(renumber[joint.relations.i] >= 0)
    relations, weight = _renumbered(joint.relations.part(inside), renumber), joint.weight[inside]
    start, frame, _ = unroll(len(rows), relations, weight, MISFIT_M)
    uv, stress = flatten(_part(network, renumber), start, config.flattening, progress)
    frame = frames_of(relations, uv, frame, weight)
    points = _flat_points(pair, sampled, rows, uv, stress)
    surface = _dense(pair, joint, len(sampled[0].source), rows, uv, frame, motion, config)
    return FlatPiece(points, start, surface)


def _sample(observation: Observation, corresponding: Int, config: Config) -> _Sampled:
    surface, patch = observation.surface, observation.patch
    ring = boundary_points(observation.place, surface.spacing_m, config.boundary).source
    ring = np.setdiff1d(ring[patch[ring] >= 0], corresponding)
    usable = np.flatnonzero(patch >= 0)
    inner = usable[thinned(surface.points[usable], patch[usable], config.integration.spacing_m)]
    inner = np.setdiff1d(inner, np.r_[corresponding, ring])
    source = np.r_[corresponding, ring, inner]
    samples = SurfaceSamples(surface.points[source], surface.normals[source], patch[source])
    return _Sampled(samples, source, len(corresponding) + len(ring))


def _surface_lines(
    pair: _Pair, sampled: tuple[_Sampled, _Sampled], config: Config, progress: Progress
) -> tuple[GeodesicLines, DistanceNetwork]:
    """Geodesic lines between boundary samples of one patch, and what they measure."""
    found, ends = [], []
    for side, (observation, samples) in enumerate(zip((pair.a, pair.b), sampled, strict=True)):
        points = samples.samples.points[: samples.boundary]
        i, j = level_pairs(
            points[:, 2],
            samples.samples.patch[: samples.boundary],
            config.geodesics.height_window_m,
            LINES_PER_POINT,
        )
        far = np.linalg.norm(points[i] - points[j], axis=1) > 2 * config.integration.spacing_m
        i, j = i[far], j[far]
        found.append(
            geodesic_lines(observation.surface, points[i], points[j], config.geodesics, progress)
        )
        ends.append(np.stack([i, j]) + side * len(sampled[0].source))
    return _lines(pair, found), _distances(found, ends)


def _lines(pair: _Pair, found: Sequence[Geodesics]) -> GeodesicLines:
    ids = [
        np.full(len(f.length_m), o.view.view_id)
        for f, o in zip(found, (pair.a, pair.b), strict=True)
    ]
    return GeodesicLines(
        np.concatenate([f.nodes for f in found]),
        np.concatenate(ids),
        np.concatenate([f.length_m for f in found]),
        np.concatenate([f.sigma_m for f in found]),
        np.concatenate([f.flagged for f in found]),
    )


def _distances(found: Sequence[Geodesics], ends: Sequence[Int]) -> DistanceNetwork:
    """Lines that stay on observed cloth; a bent one bounds the distance from above."""
    i, j = np.concatenate(ends, axis=1)
    length = np.concatenate([f.length_m for f in found])
    sigma = np.concatenate([f.sigma_m for f in found])
    bent = np.concatenate([f.reason == BENT for f in found])
    flagged = np.concatenate([f.flagged for f in found])
    keep = ~flagged | bent
    return DistanceNetwork(i[keep], j[keep], length[keep], sigma[keep] + 0.001, bent[keep])


def _renumbered(relations: Relations, number: Int) -> Relations:
    return Relations(
        number[relations.i], number[relations.j], relations.ahead, relations.back, relations.turn
    )


def _part(network: DistanceNetwork, number: Int) -> DistanceNetwork:
    """Distances between points that keep a number."""
    i, j = number[network.i], number[network.j]
    k = (i >= 0) & (j >= 0)
    return DistanceNetwork(i[k], j[k], network.distance_m[k], network.sigma_m[k], network.bound[k])


def _flat_points(
    pair: _Pair, sampled: Sequence[_Sampled], rows: Int, uv: Float, stress: Float
) -> FlatPoints:
    count = len(sampled[0].source)
    of_b = rows >= count
    source = np.concatenate([s.source for s in sampled])[rows]
    xyz = np.concatenate([s.samples.points for s in sampled])[rows]
    pixel = np.empty((len(rows), 2), dtype=np.int64)
    pixel[~of_b] = pair.a.view.pixel[source[~of_b]]
    pixel[of_b] = pair.b.view.pixel[source[of_b]]
    view_id = np.where(of_b, pair.b.view.view_id, pair.a.view.view_id)
    sigma = np.hypot(POINT_SIGMA_M, stress)
    return FlatPoints(uv, xyz, view_id, pixel, sigma, stress, np.zeros(len(rows), dtype=bool))


def _dense(
    pair: _Pair,
    joint: Joint,
    count_a: int,
    rows: Int,
    uv: Float,
    frame: Complex,
    motion: Float,
    config: Config,
) -> FlatSurface:
    """All pixels near the samples of one piece, carried to the plane by the samples around them."""
    parts: list[FlatSurface] = []
    shift = 0
    for side, observation in enumerate((pair.a, pair.b)):
        mine = (rows >= count_a) == bool(side)
        if not mine.any():
            continue
        points = observation.surface.points
        moved = points @ motion[:3, :3].T + motion[:3, 3] if side else points
        samples = joint.points[rows[mine]]
        distance, near = cKDTree(samples).query(moved, k=3)
        reach = 1.5 * config.integration.spacing_m
        keep = (distance[:, 0] < reach) & (observation.fringe >= 0)
        keep &= np.isin(observation.fringe, joint.own_patch[rows[mine]])
        distance = np.where(distance < reach, distance, np.inf)[keep]
        near = np.where(np.isfinite(distance), near[keep], 0)
        placed = carry(
            moved[keep], samples, joint.normals[rows[mine]], uv[mine], frame[mine], near, distance
        )
        number = np.full(len(points), -1, dtype=np.int64)
        number[keep] = shift + np.arange(keep.sum())
        cells = number[quads(observation, keep)]
        flat = np.full((len(points), 2), np.nan)
        flat[keep] = placed
        edge = edges(observation, flat, config.patches.step_m)[keep]
        parts.append(FlatSurface(placed, points[keep], edge, cells))
        shift += int(keep.sum())
    return FlatSurface(
        np.concatenate([p.uv for p in parts]),
        np.concatenate([p.xyz_hanger for p in parts]),
        np.concatenate([p.edge for p in parts]),
        np.concatenate([p.cells for p in parts]),
    )


def creases(joint: Joint, pieces: tuple[FlatPiece, ...]) -> tuple[Notice, ...]:
    """What lies loose beside the main piece, and whether that is too much to go by."""
    share = 1.0 - len(pieces[0].points.uv) / len(joint.piece)
    if share < 0.05:
        return ()
    text = f"{100 * share:.0f} % of what the views show is joined to the rest only behind creases"
    notice = Notice("hidden_crease", text)
    if share < MOSTLY_LOOSE:
        return (notice,)
    return notice, Notice("untrusted", "most of what the views show has no certain place")


# --- evidence 'boundary' ------------------------------------------------------------------------


def _from_boundaries(pair: _Pair, config: Config, progress: Progress) -> Flattened:
    """The paper's section 3, step by step."""
    views = (pair.a, pair.b)
    loops, at = [], []
    for observation, points in zip(views, (pair.at_a, pair.at_b), strict=True):
        spacing = observation.surface.spacing_m
        ring = boundary_points(observation.place, spacing, config.boundary)
        ring, where = with_corresponding(ring, observation.place, points, spacing, config.boundary)
        loops.append(ring)
        at.append(where)
    progress("geodesics", 0.0)
    measured, networks, shift = [], [], 0
    count = [len(ring.source) for ring in loops]
    for observation, ring in zip(views, loops, strict=True):
        lines, network = _paper_distances(observation, ring, shift, config, progress)
        measured.append(lines)
        networks.append(network)
        shift += len(ring.source)
    unknown = unknowns(count[0], count[1], at[0], at[1])
    network = _on_unknowns(merged(networks), unknown)
    xy = [o.view.points_view[ring.source][:, :2] for o, ring in zip(views, loops, strict=True)]
    placed = np.vstack(start_places(xy[0], xy[1], at[0], at[1]))
    start = np.zeros((unknown.max() + 1, 2))
    start[unknown[::-1]] = placed[::-1]  # the first view's place counts
    uv, stress = flatten(network, start, config.flattening, progress)
    uv, stress = uv[unknown], stress[unknown]
    progress("outline", 0.0)
    return Flattened(
        _boundary_flat_points(pair, loops, uv, stress),
        placed,
        _lines(pair, measured),
        _boundary_outline(loops, uv, config),
        pair.used,
        pair.notices,
    )


def _paper_distances(
    observation: Observation, ring: Boundary, shift: int, config: Config, progress: Progress
) -> tuple[Geodesics, DistanceNetwork]:
    points = observation.surface.points[ring.source]
    i, j = level_pairs(
        points[:, 2],
        np.zeros(len(points), dtype=np.int64),
        config.geodesics.height_window_m,
        LINES_PER_POINT,
    )
    lines = geodesic_lines(observation.surface, points[i], points[j], config.geodesics, progress)
    ri, rj = ring_pairs(ring.loop)
    bent = lines.reason == BENT
    # lines over what was not observed measure nothing, and the paper's springs know no bounds
    keep = ~lines.flagged | (bent & (config.flattening.solver != "springs"))
    alone = ring.loop < 0  # points inside, which nothing else holds
    alone[np.r_[i[keep], j[keep]]] = False
    keep |= alone[i] | alone[j]
    i, j = np.r_[i[keep], ri] + shift, np.r_[j[keep], rj] + shift
    length = np.r_[lines.length_m[keep], np.linalg.norm(points[ri] - points[rj], axis=1)]
    sigma = np.r_[lines.sigma_m[keep] + 0.001, np.full(len(ri), 0.002)]
    bound = np.r_[bent[keep], np.zeros(len(ri), dtype=bool)]
    return lines, DistanceNetwork(i, j, length, sigma, bound)


def _on_unknowns(network: DistanceNetwork, unknown: Int) -> DistanceNetwork:
    i, j = unknown[network.i], unknown[network.j]
    k = i != j
    return DistanceNetwork(i[k], j[k], network.distance_m[k], network.sigma_m[k], network.bound[k])


def _boundary_flat_points(
    pair: _Pair, loops: Sequence[Boundary], uv: Float, stress: Float
) -> FlatPoints:
    views = (pair.a, pair.b)
    pixel = [o.view.pixel[ring.source] for o, ring in zip(views, loops, strict=True)]
    xyz = [o.surface.points[ring.source] for o, ring in zip(views, loops, strict=True)]
    ids = [np.full(len(ring.source), o.view.view_id) for o, ring in zip(views, loops, strict=True)]
    return FlatPoints(
        uv,
        np.concatenate(xyz),
        np.concatenate(ids),
        np.concatenate(pixel).astype(np.int64),
        np.hypot(POINT_SIGMA_M, stress),
        stress,
        np.zeros(len(uv), dtype=bool),
    )


def _boundary_outline(loops: Sequence[Boundary], uv: Float, config: Config) -> Outline:
    """Union of the polygons of both views' loops."""
    polygons, shift = [], 0
    for ring in loops:
        for number in range(int(ring.loop.max()) + 1):
            polygons.append(uv[shift + np.flatnonzero(ring.loop == number)])
        shift += len(ring.source)
    return outline_of_polygons(polygons, POINT_SIGMA_M, config.contour)
