"""A hem, waist or cuff amid what was laid flat: the cloth ends there, and yet goes on.

Where the edge of one part lies flush on another, or the cloth's inside shows beyond its edge, all
is one sheet to the links, and laid end to end: the item comes out too long, and may fit its
category well all the same. But beside the place where it is joined, the edge can be seen to end:
straight, and along the direction that openings of the category have. The surface is cut along it,
across the whole item, and laid flat anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.distances import largest_pieces
from vflatten_ros.core.geometry import twice_area
from vflatten_ros.core.grouping import SMALLEST, Grouped, each_flat
from vflatten_ros.core.rotation import Unfolded, as_laid
from vflatten_ros.core.sheets import outward
from vflatten_ros.core.template_fit import Fit
from vflatten_ros.core.values import Bool, Float, Int, Progress, no_progress

STEP, CELL = 0.6, 2.0  # of depths, and of stretches along an edge, in spacings of the samples
REACH = 1  # steps to either side that are of one depth
BESIDE = 4, 9  # steps from a depth to those that it is compared with
LEAST_M, MOST_M = 0.025, 0.25  # depths inside the category's outline at which it is looked for
SHORTEST_M = 0.07  # opening of which the direction is looked for
STRAIGHT = 0.995  # cosine between edges of one opening
FEWEST = 10  # cells of cloth at a depth
FACING = 0.6  # cosine between the direction in which a sample's sheet ends and that of the opening
PAST = 0.8  # spacings from the last samples before the edge to where it is cut
NEAR = 6.0  # spacings between linked samples that lie as they are linked
# Standard errors, of shares of as many cells as there are, by which more of them end than beside.
# Where about 90 items lay well there were 4.3 at most, and from 4.9 on it was a hem
CLEAR = 4.5


@dataclass(frozen=True, eq=False)
class Hem:
    """A straight edge within the flat surface, in the plane in which that lies."""

    start: Float  # (2,) one end of the category's opening, m
    inward: Float  # (2,) unit, from there into the item
    depth_m: float  # along it, at which the cloth ends
    clear: float  # standard errors


def hem_within(unfolded: Unfolded, fit: Fit, config: RotationConfig) -> Hem | None:
    """The clearest edge of cloth that runs along an opening of the category, inside of it.

    Parameters
    ----------
    unfolded : Unfolded
        How the surface lies flat.
    fit : Fit
        The category that it looks like.
    config : RotationConfig

    Returns
    -------
    Hem or None
        None: there is none that is clear enough.
    """
    uv, side = unfolded.points.uv, unfolded.side
    ends, towards = _ends(unfolded, config)
    step, cell = STEP * config.spacing_m, CELL * config.spacing_m
    count = int((MOST_M + LEAST_M) / step) + 1
    depth_m = -LEAST_M + step * np.arange(count)  # and outside, for comparison
    best: Hem | None = None
    for start, end, inward in _openings(fit):
        length = float(np.linalg.norm(end - start))
        if length < SHORTEST_M:
            continue
        column = np.floor((uv - start) @ (end - start) / length / cell).astype(int)
        row = np.rint(((uv - start) @ inward + LEAST_M) / step).astype(int)
        columns = int(length / cell)
        within = (column >= 0) & (column < columns) & (row >= 0) & (row < count)
        faces = ends & (towards @ inward < -FACING)
        for up in (1.0, -1.0):
            layer = within & (side == up)
            cloth = _cells(row, column, layer, (count, columns))
            ended = _cells(row, column, layer & faces, (count, columns)).sum(axis=1)
            there = cloth.sum(axis=1)
            clear = _excess(ended / np.maximum(there, 1), there > 0) * 2.0 * np.sqrt(there)
            clear[(there < FEWEST) | (depth_m < LEAST_M)] = 0.0
            k = int(clear.argmax())
            if clear[k] > max(CLEAR, best.clear if best else 0.0):
                best = Hem(start, inward, float(depth_m[k]), float(clear[k]))
    return best


def cut_at_hem(
    unfolded: Unfolded,
    hem: Hem,
    anew: bool,
    config: RotationConfig,
    progress: Progress = no_progress,
) -> Grouped | None:
    """The surface without the links that lead across a hem, on either side of the item.

    Parameters
    ----------
    unfolded : Unfolded
    hem : Hem
    anew : bool
        Whether all is laid flat from the start, in place of from how it lay inside of the hem.
    config : RotationConfig
    progress : Progress

    Returns
    -------
    Grouped or None
        None: nothing leads across, or what is left is in shreds.
    """
    surface, row = unfolded.surface, unfolded.row
    links, count = surface.links, len(surface.edge)
    depth_m = np.full(count, np.nan)  # inside of the cut
    cut_m = hem.depth_m - PAST * config.spacing_m
    depth_m[row] = (unfolded.points.uv - hem.start) @ hem.inward - cut_m
    across = depth_m[links.a] * depth_m[links.b] < 0.0
    if not across.any():
        return None
    kept = links.part(~across)
    masks = tuple(largest_pieces(kept, np.ones(count, dtype=bool), int(SMALLEST * count)))
    if not masks:
        return None
    places = np.full((count, 2), np.nan)
    if not anew:  # what lay beyond has no place until it is laid flat again
        places[row] = unfolded.points.uv
        places[~(masks[0] & (depth_m > 0.0))] = np.nan
    loose = masks if anew else masks[1:]
    for mask, uv in zip(loose, each_flat(surface, kept, loose, config, progress), strict=True):
        places[mask] = uv[mask]
    return Grouped(surface, kept, masks, places)


def _openings(fit: Fit) -> Iterator[tuple[Float, Float, Float]]:
    """Straight stretches of the category's outline where its cloth ends.

    Each as its two ends (2,), m, and the unit direction (2,) from it into the item.
    """
    outline = fit.points()[: fit.template.vertices]
    step = np.roll(outline, -1, axis=0) - outline
    step /= np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
    opened = ~np.asarray(fit.template.seam)
    on = opened & np.roll(opened, 1) & ((step * np.roll(step, 1, axis=0)).sum(1) > STRAIGHT)
    count = len(outline)
    for first in np.flatnonzero(opened & ~on):
        last = int(first)
        while on[(last + 1) % count]:
            last += 1
        start, end = outline[first], outline[(last + 1) % count]
        left = np.array([-(end - start)[1], (end - start)[0]])
        inward = left * np.sign(twice_area(outline)) / max(float(np.linalg.norm(left)), 1e-9)
        yield start, end, inward


def _ends(unfolded: Unfolded, config: RotationConfig) -> tuple[Bool, Float]:
    """Samples (n,) at whose places their cloth ends, and (n, 2) unit directions of it."""
    uv = unfolded.points.uv
    edge, links = as_laid(unfolded.surface, unfolded.row, uv)
    sheet = links.part(~links.rim)
    away = uv[sheet.b] - uv[sheet.a]
    near = sheet.part(np.linalg.norm(away, axis=1) < NEAR * config.spacing_m)
    flat = np.column_stack([uv, np.zeros(len(uv))])
    up = np.broadcast_to([0.0, 0.0, 1.0], flat.shape)
    return edge == 1, outward(flat, up, near.a, near.b)[:, :2]


def _cells(row: Int, column: Int, some: Bool, shape: tuple[int, int]) -> Bool:
    """Cells (rows, columns) in which some of (n,) samples lie, or within reach of such in depth."""
    cells = np.zeros((shape[0] + 2 * REACH, shape[1]), dtype=bool)
    for shift in range(2 * REACH + 1):
        cells[row[some] + shift, column[some]] = True
    return cells[REACH : shape[0] + REACH]


def _excess(share: Float, known: Bool) -> Float:
    """(d,) how much larger a share is than those some way before and behind; 0: nothing is."""
    near, far = BESIDE
    value, weight = np.zeros(len(share)), np.zeros(len(share))
    masked = np.where(known, share, 0.0)
    for shift in range(near, far + 1):
        value[shift:] += masked[:-shift]
        weight[shift:] += known[:-shift]
        value[:-shift] += masked[shift:]
        weight[:-shift] += known[shift:]
    return np.where(weight > 0, share - value / np.maximum(weight, 1), 0.0)
