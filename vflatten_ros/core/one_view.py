"""One view alone laid flat (Kita & Kita 2019, section 2): what it shows, and nothing beside."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vflatten_ros.core.boundary import boundary_points, level_pairs
from vflatten_ros.core.config import Config
from vflatten_ros.core.contour import trace_outline
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.geodesics import geodesic_lines
from vflatten_ros.core.observation import Observation, edges, observe, quads
from vflatten_ros.core.patch_flattening import flatten_patch
from vflatten_ros.core.sampling import thinned
from vflatten_ros.core.surface import Surface
from vflatten_ros.core.values import (
    Bool,
    FlatPoints,
    FlatSurface,
    Flattened,
    Float,
    GeodesicLines,
    Int,
    Notice,
    Progress,
    View,
    no_progress,
)

LINES_PER_POINT = 3  # geodesic lines that start at a boundary point
POINT_SIGMA_M = 0.002  # of a flattened point, whatever its stress
FEWEST_POINTS = 100  # of the largest piece
LEFT_OUT = 0.05  # share of the points beyond which a notice says so


def flatten_one_view(view: View, config: Config, progress: Progress = no_progress) -> Flattened:
    """Flatten the largest piece of cloth that a view shows without a jump.

    Parameters
    ----------
    view : View
    config : Config
    progress : Progress

    Raises
    ------
    DisconnectedSurface
        No piece is large enough.
    """
    observation = observe(view, config, progress)
    progress("flattening", 0.0)
    uv, stress, main = _laid_flat(observation)
    xy = view.points_view[:, :2]
    uv[main] = _turned_to(uv[main], xy[main])
    sampled = np.flatnonzero(main)
    sampled = sampled[
        thinned(
            observation.surface.points[sampled],
            np.zeros(len(sampled), dtype=np.int64),
            config.integration.spacing_m,
        )
    ]
    lines = _lines(observation, main, config, progress)
    progress("outline", 0.0)
    surface = _surface(observation, main, uv, config.patches.step_m)
    outline = trace_outline(
        surface, POINT_SIGMA_M, 0.5 * observation.surface.spacing_m, config.contour
    )
    points = FlatPoints(
        uv[sampled],
        observation.surface.points[sampled],
        np.full(len(sampled), view.view_id, dtype=np.int64),
        view.pixel[sampled].astype(np.int64),
        np.hypot(POINT_SIGMA_M, stress[sampled]),
        stress[sampled],
        np.zeros(len(sampled), dtype=bool),
    )
    return Flattened(points, xy[sampled], lines, outline, (), _notices(main))


def _laid_flat(observation: Observation) -> tuple[Float, Float, Bool]:
    """Flat place and stress (m) of every point, and which points are of the largest piece."""
    surface, (row, col) = observation.surface, observation.place.T
    patch = flatten_patch(surface)
    piece = np.where(observation.patch >= 0, _pieces(surface)[row, col], -1)
    size = np.bincount(piece[piece >= 0]) if (piece >= 0).any() else np.zeros(1, dtype=np.int64)
    if size.max() < FEWEST_POINTS:
        raise DisconnectedSurface(
            f"the largest piece of cloth without a jump has {size.max()} points, expected "
            f"{FEWEST_POINTS} or more; check the cloud, the crop box and surface.radius_m"
        )
    uv = patch.uv[row, col].astype(np.float64)
    main = (piece == size.argmax()) & np.isfinite(uv).all(axis=1)
    return uv, patch.strain[row, col] * surface.spacing_m, main


def _pieces(surface: Surface) -> Int:
    """(rows, cols) number of the piece that measured neighbours make up; -1: not measured."""
    layers = surface.layers
    number = np.full(layers.seen.shape, -1, dtype=np.int64)
    number[layers.seen] = np.arange(layers.seen.sum())
    right = layers.right[:, :-1] & layers.seen[:, :-1] & layers.seen[:, 1:]
    down = layers.down[:-1] & layers.seen[:-1] & layers.seen[1:]
    a = np.concatenate([number[:, :-1][right], number[:-1][down]])
    b = np.concatenate([number[:, 1:][right], number[1:][down]])
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(number.max() + 1, number.max() + 1))
    number[layers.seen] = connected_components(graph, directed=False)[1]
    return number


def _turned_to(uv: Float, xy: Float) -> Float:
    """The flat points turned, and mirrored if need be, to lie as they hang."""
    middle = uv.mean(axis=0)
    left, _, right = np.linalg.svd((uv - middle).T @ (xy - xy.mean(axis=0)))
    turned: Float = (uv - middle) @ left @ right
    return turned


def _surface(observation: Observation, main: Bool, uv: Float, step_m: float) -> FlatSurface:
    number = np.full(len(main), -1, dtype=np.int64)
    number[main] = np.arange(main.sum())
    cells = number[quads(observation, main)]
    flat = np.where(main[:, None], uv, np.nan)
    edge = edges(observation, flat, step_m)[main]
    return FlatSurface(uv[main], observation.surface.points[main], edge, cells)


def _lines(
    observation: Observation, main: Bool, config: Config, progress: Progress
) -> GeodesicLines:
    """Geodesic lines between boundary points of similar height."""
    surface = observation.surface
    ring: Int = boundary_points(observation.place, surface.spacing_m, config.boundary).source
    ring = ring[main[ring]]
    points = surface.points[ring]
    group = np.zeros(len(ring), dtype=np.int64)
    i, j = level_pairs(points[:, 2], group, config.geodesics.height_window_m, LINES_PER_POINT)
    found = geodesic_lines(surface, points[i], points[j], config.geodesics, progress)
    ids = np.full(len(i), observation.view.view_id, dtype=np.int64)
    return GeodesicLines(found.nodes, ids, found.length_m, found.sigma_m, found.flagged)


def _notices(main: Bool) -> tuple[Notice, ...]:
    text = (
        "one view shows one side of the item, and not what hangs behind: category and sizes are of "
        "what it shows; take two views or a rotation"
    )
    notices = (Notice("untrusted", text),)
    share = 1.0 - float(main.mean())
    if share < LEFT_OUT:
        return notices
    text = (
        f"{100 * share:.0f} % of what the view shows lies beyond jumps or creases and was left out"
    )
    return (Notice("hidden_crease", text), *notices)
