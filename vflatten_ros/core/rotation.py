"""The automatic method: the fused views of a rotation to the flattened surface and its outline.

Like the pipeline, this module knows the order of its stages, which do not know each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.distances import Distances, Steps, link_steps, surface_distances
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.faces import evenly_apart
from vflatten_ros.core.fused import Fused
from vflatten_ros.core.fusion import Samples
from vflatten_ros.core.middle_slit import Axis, Banks, banks_of, between, middle_slit
from vflatten_ros.core.outline import outline_of, within
from vflatten_ros.core.puzzle import overlap as lying_on
from vflatten_ros.core.ramps import ramps
from vflatten_ros.core.sheets import Links, link_samples, outward, sheet_edges
from vflatten_ros.core.sight import PlacedSight, goes_on
from vflatten_ros.core.slits import slits
from vflatten_ros.core.unfolding import (
    SOFTLY,
    carry,
    orientation,
    overlap,
    place_samples,
    relaxed,
    settle,
    unfold,
)
from vflatten_ros.core.values import (
    Bool,
    FlatPoints,
    Float,
    Int,
    Notice,
    Outline,
    Progress,
    no_progress,
)

FIRM = 3  # distances along the sheet that place a sample firmly
FIRM_SHARE = 0.8  # of the samples, for the others to be left out of the outline
ROUGH, ROUGH_ROUNDS = 120, 4  # landmarks and reweightings where pieces are laid flat by themselves
FEWEST, ROUGH_SPACING = 50, 40  # landmarks of a small piece, and samples for each
MOST_DOUBTFUL = 0.1  # of the samples, at a doubt of 1
TOLD_M = 1e-4  # length of a link between samples that are said to be one point of the cloth
TOLD_AMONG = 8  # samples nearest to such a point, of which the nearest that faces its way is it
WITHIN = 0.5  # share of a group's points in the outline, below which it lies apart
LEAST_LINKS = 1  # along a sheet, for each sample: a square net has two
RIM_LAID_M = 0.015  # between the two sides of a rim that lies flat as one


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
    even: float = 0.0  # 0-1, see evenly_apart


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
    inside = [float(within(p.uv, outline.uv).mean()) for p in points]
    if min(inside) < WITHIN:
        apart = count[int(np.argmin(inside))] / count.sum()
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
    steps = surface.steps.among(piece)
    distances = surface_distances(xyz, normal, alone, everywhere, rough, progress, steps)
    plane = unfold(distances.bound_m, distances.same_sheet, rough, progress, SOFTLY)
    uv = place_samples(distances.around, distances.around_m, distances.around_sheet, plane)[0]
    places = np.full((len(piece), 2), np.nan)
    places[rows[distances.inside]] = uv[distances.inside]
    return places


def turn_parts(
    unfolded: Unfolded, swung: Float, rest: Float, config: RotationConfig, relax: bool = False
) -> Unfolded:
    """The same surface with its loose parts (legs, sleeves) turned as a template says.

    Parameters
    ----------
    swung, rest : ndarray of shape (k, 2)
        The template's outline as it fits the item, and with its parts at rest.
    relax : bool
        Let the parts go from there to where the cloth's own distances have them.
    """
    parts = []
    for part in unfolded.parts:
        plane = carry(part.plane, swung, rest)
        plane = settle(plane, part.distances.bound_m, part.distances.same_sheet, config)
        if relax:
            plane = relaxed(plane, part.distances.bound_m, part.distances.same_sheet)
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


def parted(
    unfolded: Unfolded, axes: Sequence[Axis], config: RotationConfig
) -> tuple[Unfolded, float] | None:
    """The same surface with a slit that leads up its middle; None: it hardly has one.

    Parameters
    ----------
    unfolded : Unfolded
    axes : sequence of Axis
        Of the category that it looks like.
    config : RotationConfig

    Returns
    -------
    (Unfolded, float) or None
        Its outline goes in and out of the slit, and will when it is laid out anew; and the
        probability that there is one.
    """
    surface, row, points, side = unfolded.surface, unfolded.row, unfolded.points, unfolded.side
    edge, links = as_laid(surface, row, points.uv)
    slit = middle_slit(points.uv, side, edge, links, axes, config)
    if slit is None:
        return None
    laid, count = banks_of(points.uv, slit.line, config), len(surface.edge)
    banks = Banks(np.zeros(count, dtype=np.int64), np.zeros(count))
    banks.side[row], banks.along_m[row] = laid.side, laid.along_m
    surface = replace(surface, banks=banks)
    outline = _outline(surface, row, points, side, unfolded.firm, config)
    return replace(unfolded, surface=surface, outline=outline), slit.probability


def link_surface(fused: Fused, config: RotationConfig, progress: Progress = no_progress) -> Surface:
    """Link the samples, and find where their sheets end.

    Raises
    ------
    DisconnectedSurface
        Hardly any hang together.
    """
    progress("link", 0.0)
    samples = fused.samples
    links = link_samples(samples.xyz, samples.normal, config)
    count, joined = len(samples.xyz), int((~links.rim).sum())
    if joined < LEAST_LINKS * count:
        raise DisconnectedSurface(
            f"{count} samples of the surface have {joined} links along it, expected "
            f"{LEAST_LINKS * count} or more: points too far apart or too noisy to show a surface; "
            "hold the item nearer to the rig, or see rotation.spacing_m, link_m and step_m"
        )
    progress("link", 0.7)
    links = links.with_links(*_told(fused, config), TOLD_M)
    edge = _edges(samples, links, fused.sights, config)
    doubt = np.zeros(len(samples.xyz))
    steps = link_steps(samples.xyz, samples.normal, links)
    even = evenly_apart(samples.xyz, samples.normal, config)
    return Surface(samples, links, steps, edge, doubt, fused.view_id, fused.pixel, even=even)


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
    edge, links = as_laid(surface, row, points.uv)
    cuts = slits(points.uv, side, edge, links, config)
    slit = None
    if surface.banks is not None:
        slit = between(points.uv, surface.banks.of(row), config)
    return outline_of(points.uv[firm], points.sigma_m[firm], edge[firm], config, cuts, item, slit)


def as_laid(surface: Surface, row: Int, uv: Float) -> tuple[Int, Links]:
    """Edges of the samples `row` as they lie at `uv` (see edges_laid), and links between them."""
    laid = np.zeros(len(surface.edge), dtype=bool)
    laid[row] = True
    order = np.argsort(row)
    links = surface.links.among(laid)
    links = replace(links, a=order[links.a], b=order[links.b])
    return edges_laid(surface, row, uv), links
