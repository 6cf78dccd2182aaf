"""The surface in pieces that are certain, put together as far as their edges tell how.

The stages are those of the whole surface; what joins the pieces is decided here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.distances import largest_pieces, surface_distances
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.puzzle import CELL_M as PUZZLE_CELL_M
from vflatten_ros.core.puzzle import Motion, Ties, put_together
from vflatten_ros.core.rotation import (
    Part,
    Surface,
    Unfolded,
    laid_flat,
    passable_at,
    together,
    unfolded_from,
)
from vflatten_ros.core.sheets import Links
from vflatten_ros.core.unfolding import SOFTLY, SPREAD, orientation, settle
from vflatten_ros.core.values import Bool, Float, Int, Progress, no_progress

SMALLEST = 0.01  # share of the samples that makes a piece
SMALL_GROUP, SMALL_LANDMARKS = 0.15, 150
RIM_SLACK_M = 0.004  # between the two sides of a rim
RIM_STEP_M = 0.012  # rims nearer than this are of one stretch
RIM_SHARE = 0.2  # of a stretch of rim that agrees, for all of it to be believed


@dataclass(frozen=True, eq=False)
class Grouped:
    """The surface in pieces that were put together as far as their edges tell how."""

    surface: Surface
    links: Links  # on the sheets, and round the rims that join pieces
    masks: tuple[Bool, ...]  # (n,) samples of each group, largest first
    places: Float  # (n, 2) as the pieces were put together; NaN in none


def group_pieces(
    surface: Surface, doubt: float, config: RotationConfig, progress: Progress = no_progress
) -> Grouped:
    """What hangs together on sheets, and is joined by rims that agree.

    Parameters
    ----------
    surface : Surface
    doubt : float
        What is more doubtful than this joins nothing.

    Raises
    ------
    DisconnectedSurface
        No piece is worth a look.
    """
    samples, links = surface.samples, surface.links
    passable, sheet = passable_at(surface, doubt), links.part(~links.rim)
    found = largest_pieces(sheet, passable, int(SMALLEST * len(samples.xyz)))
    if not found:
        raise _in_shreds(len(samples.xyz))
    flat = each_flat(surface, sheet, found, config, progress)
    sides = []
    for uv, piece in zip(flat, found, strict=True):
        own = piece[sheet.a] & piece[sheet.b]
        a, b = sheet.a[own], sheet.b[own]
        sides.append(orientation(np.nan_to_num(uv), samples.xyz, samples.normal, a, b))
    number = np.full(len(samples.xyz), -1)
    for k, piece in enumerate(found):
        number[piece] = k
    a, b = number[links.a], number[links.b]
    between = np.flatnonzero(links.rim & (a >= 0) & (b >= 0) & (a != b))
    ties = Ties(links.a[between], links.b[between], np.full(len(between), RIM_SLACK_M))
    puzzle = put_together(found, flat, sides, ties, round(config.rim_length_m / PUZZLE_CELL_M))
    believed = np.zeros(len(a), dtype=bool)
    believed[between] = _along_agreeing(samples.xyz, ties, a[between], b[between], puzzle.met)
    size = np.bincount(puzzle.group[puzzle.group >= 0])
    order = [k for k in np.argsort(-size, kind="stable") if size[k] > SMALLEST * len(number)]
    if not order:
        raise _in_shreds(len(number))
    masks = tuple(puzzle.group == k for k in order)
    return Grouped(
        surface,
        links.part(~links.rim | believed),
        masks,
        np.column_stack([puzzle.z.real, puzzle.z.imag]),
    )


def each_flat(
    surface: Surface,
    links: Links,
    parts: Sequence[Bool],
    config: RotationConfig,
    progress: Progress,
) -> list[Float]:
    """Places (n, 2) of the samples of each part, roughly and in a plane of its own; NaN elsewhere.

    Parameters
    ----------
    surface : Surface
    links : Links
        That are believed.
    parts : sequence of ndarray of shape (n,)
        Which samples each has.
    """
    flat = []
    for k, part in enumerate(parts):

        def flattening(_: str, fraction: float, done: int = k) -> None:
            progress("pieces", (done + fraction) / len(parts))

        flat.append(laid_flat(surface, links, part, config, flattening))
    return flat


def _in_shreds(count: int) -> DisconnectedSurface:
    return DisconnectedSurface(
        f"no piece of the surface has more than {SMALLEST:.0%} of its {count} samples; take more "
        "views or raise rotation.link_m"
    )


def _along_agreeing(xyz: Float, ties: Ties, a: Int, b: Int, met: Bool) -> Bool:
    """Ties of two pieces along the same stretch of rim as those that agree.

    A tube does not lie quite flat until both its rims are joined, so many right ones do not agree.
    """
    if not len(met):
        return met
    middle = (xyz[ties.one] + xyz[ties.other]) / 2
    i, j = cKDTree(middle).query_pairs(RIM_STEP_M, output_type="ndarray").T
    pair = np.minimum(a, b) * (a.max() + b.max() + 1) + np.maximum(a, b)
    alike = pair[i] == pair[j]
    ones = np.ones(int(alike.sum()), dtype=bool)
    graph = csr_matrix((ones, (i[alike], j[alike])), shape=(len(met), len(met)))
    stretch = connected_components(graph, directed=False)[1]
    share = np.bincount(stretch, met) / np.bincount(stretch)
    believed: Bool = share[stretch] > RIM_SHARE
    return believed


def unfold_group(
    grouped: Grouped,
    which: int,
    config: RotationConfig,
    progress: Progress = no_progress,
) -> Unfolded:
    """Flatten one group.

    Parameters
    ----------
    grouped : Grouped
    which : int
        The group.

    Raises
    ------
    DisconnectedSurface
    """
    surface, mask = grouped.surface, grouped.masks[which]
    samples = surface.samples
    if mask.mean() < SMALL_GROUP:
        config = replace(config, landmarks=min(config.landmarks, SMALL_LANDMARKS))
    distances = surface_distances(
        samples.xyz, samples.normal, grouped.links, mask, config, progress, surface.steps
    )
    bound, near = distances.bound_m, distances.same_sheet
    plane = _begun(grouped.places, samples.xyz, mask, distances.chosen)
    plane = settle(plane, bound, near, config, SPREAD[-1], SOFTLY)
    progress("outline", 0.0)
    return unfolded_from(surface, Part(distances, plane), config)


def _begun(places: Float, xyz: Float, mask: Bool, chosen: Int) -> Float:
    """Places (k, 2) of some samples of a group; where one has none, that of the nearest that has.

    Raises
    ------
    DisconnectedSurface
        None has.
    """
    plane = places[chosen]
    lost = ~np.isfinite(plane).all(axis=1)
    if lost.any():
        known = np.flatnonzero(mask & np.isfinite(places).all(axis=1))
        if not len(known):
            raise DisconnectedSurface("no sample of a part of the surface can be laid flat")
        near = cKDTree(xyz[known]).query(xyz[chosen[lost]])[1]
        plane[lost] = places[known[near]]
    return plane


def put_beside(
    groups: Sequence[Unfolded],
    motions: Sequence[Motion],
    item: Float,
    sigma_m: float,
    turned: Sequence[Motion | None],
    config: RotationConfig,
) -> Unfolded:
    """Several groups in one plane.

    Parameters
    ----------
    groups : sequence of Unfolded
    motions : sequence of Motion
        Of their planes.
    item : ndarray of shape (c, 2)
        Outline of the item by which they were placed.
    sigma_m : float
        How far the places of all but the first may be off.
    turned : sequence of Motion or None
        Result of turned_over for them.
    """
    parts, points, sides = [], [], []
    some = any(other is not None for other in turned)
    for k, (group, motion) in enumerate(zip(groups, motions, strict=True)):
        moved = [Part(part.distances, _moved(part.plane, motion)) for part in group.parts]
        parts.extend(moved)
        sigma = np.hypot(group.points.sigma_m, sigma_m if k else 0.0)
        uv = _moved(group.points.uv, motion)
        astray = _astray_m(group, uv, turned[k]) if some else None
        points.append(replace(group.points, uv=uv, sigma_m=sigma, astray_m=astray))
        sides.append(-group.side if motion.mirrored else group.side)
    return together(groups, tuple(parts), points, sides, config, item)


def _astray_m(group: Unfolded, uv: Float, other: Motion | None) -> Float:
    """(n,) distance, as they hang, to what would lie where the points of a group lie."""
    points = group.points
    if other is None:
        return np.zeros(len(uv))
    there = cKDTree(_moved(points.uv, other)).query(uv)[1]
    away: Float = np.linalg.norm(points.xyz_hanger - points.xyz_hanger[there], axis=1)
    return away


def _moved(uv: Float, motion: Motion) -> Float:
    z = motion(uv @ np.array([1, 1j]))
    return np.column_stack([z.real, z.imag])
