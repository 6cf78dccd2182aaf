"""Shortest lines along the surface of one view (paper, section 2.1), all lines at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from vflatten_ros.core.arrays import as_points
from vflatten_ros.core.breaks import Layers, connected_window, joined_places
from vflatten_ros.core.config import GeodesicConfig
from vflatten_ros.core.errors import InvalidInput
from vflatten_ros.core.routes import find_routes
from vflatten_ros.core.springs import relax_springs
from vflatten_ros.core.surface import Surface, depth_at
from vflatten_ros.core.values import Bool, Float, Int, Progress, no_progress

OK, JUMP, MISSING, BENT, NOT_CONVERGED = range(5)
STEPS = 20  # of Gauss-Newton; lines on cloth need 3 to 8
FINE = 4  # samples a node interval when a line is measured
CORNER = 1  # grid steps past the corner of a rim


@dataclass(frozen=True, eq=False)
class Geodesics:
    """Lines along the surface and their lengths."""

    nodes: Float  # (m, M, 3)
    length_m: Float  # (m,)
    sigma_m: Float  # (m,) one standard deviation
    flagged: Bool  # (m,) True: not simply the distance on the flat cloth, see reason
    reason: NDArray[np.uint8]  # (m,) OK, JUMP, MISSING, BENT or NOT_CONVERGED


def geodesic_lines(
    surface: Surface,
    starts: Float,
    ends: Float,
    config: GeodesicConfig,
    progress: Progress = no_progress,
) -> Geodesics:
    """Shortest lines on the surface between pairs of points.

    A line that nothing observed joins crosses the gap on an extrapolated surface, with reason
    JUMP or MISSING and a standard deviation that grows with the gap. A line that bends round a
    border is BENT: its length is an upper bound of the distance on the flat cloth.

    Parameters
    ----------
    surface : Surface
    starts, ends : ndarray of shape (m, 3)
        Ends of the lines, in the surface's frame; moved onto the surface along the rays.
    config : GeodesicConfig

    Returns
    -------
    Geodesics

    Raises
    ------
    InvalidInput
        Wrong shapes or values that are not finite.
    """
    starts, ends = as_points(starts, "starts"), as_points(ends, "ends")
    if len(starts) != len(ends):
        raise InvalidInput(f"starts and ends differ in number: {len(starts)} and {len(ends)}")
    if not len(starts):
        none = np.zeros(0)
        nodes = np.zeros((0, config.nodes, 3))
        return Geodesics(nodes, none, none, none > 0, none.astype(np.uint8))
    a, b = surface.rays.to_grid(starts)[0], surface.rays.to_grid(ends)[0]
    path, apart = _first_guess(surface, a, b, config.nodes)
    progress("geodesics", 0.3)
    if config.solver == "springs":
        nodes, held, converged = relax_springs(surface, path, progress)
        lines = _describe(surface, surface.rays.to_grid(nodes)[0], held, converged)
        length = np.linalg.norm(np.diff(nodes, axis=1), axis=2).sum(axis=1)
        return replace(lines, nodes=nodes, length_m=length)
    held, converged = np.zeros(path.shape[:2], bool), np.ones(len(path), bool)
    path[~apart], held[~apart], converged[~apart] = relax_newton(surface, path[~apart], progress)
    return _describe(surface, path, held, converged)


def _first_guess(surface: Surface, a: Float, b: Float, nodes: int) -> tuple[Float, Bool]:
    """(m, nodes, 2) lines on the observed surface where there are any, and which ends are apart."""
    t = np.linspace(0, 1, nodes)[None, :, None]
    path = a[:, None] + t * (b - a)[:, None]
    lost = ~_open(surface, path, over_gaps=True)
    apart = np.zeros(len(a), bool)
    if lost.any():
        points = _grid_points(surface)
        way, length = find_routes(surface.layers, points, a[lost], b[lost], nodes, bridge=False)
        path[lost] = way
        apart[lost] = np.isinf(length)
    return path, apart


def _grid_points(surface: Surface) -> Float:
    places = np.moveaxis(np.indices(surface.layers.valid.shape), 0, -1).astype(float)
    return surface.rays.to_points(places, surface.fits[..., 0])


def _dense(path: Float, fine: int) -> Float:
    """(m, (M - 1) * fine + 1, 2) places along (m, M, 2) polylines."""
    n = path.shape[1]
    t = np.linspace(0, n - 1, (n - 1) * fine + 1)
    i = np.minimum(t.astype(int), n - 2)
    f = (t - i)[None, :, None]
    return np.asarray(path[:, i] * (1 - f) + path[:, i + 1] * f)


def _open(surface: Surface, path: Float, over_gaps: bool = False) -> Bool:
    """(m,) whether nothing separates the places along each line."""
    longest = np.abs(np.diff(path, axis=1)).max()
    fine = int(np.ceil(max(longest, 1e-9) / 0.8))
    return np.asarray(joined_places(surface.layers, _dense(path, fine), over_gaps)[1].all(axis=1))


def _points(surface: Surface, rc: Float) -> tuple[Float, Float]:
    """(m, M, 3) points and (m, M, 3, 2) tangents at (m, M, 2) grid places."""
    flat = rc.reshape(-1, 2)
    depth, slope, _ = depth_at(surface, flat)
    points = surface.rays.to_points(flat, depth)
    tangents = np.stack(surface.rays.tangents(flat, depth, slope), axis=-1)
    m, n = rc.shape[:2]
    return points.reshape(m, n, 3), tangents.reshape(m, n, 3, 2)


def relax_newton(surface: Surface, path: Float, progress: Progress) -> tuple[Float, Bool, Bool]:
    """Gauss-Newton on the energy of zero-length springs, all nodes in one banded system.

    Nodes that would leave the observed surface are held where they are.

    Returns
    -------
    path (m, M, 2), held (m, M), converged (m,)
    """
    m, n = path.shape[:2]
    path = path.copy()
    held = np.zeros((m, n), bool)
    converged = np.zeros(m, bool)
    length = np.full(m, 1e9)
    change_of_length = np.ones(m)
    for step in range(STEPS):
        progress("geodesics", 0.3 + 0.6 * step / STEPS)
        live = np.flatnonzero(~converged)
        if not len(live):
            break
        points, tangents = _points(surface, path[live])
        now = np.linalg.norm(np.diff(points, axis=1), axis=2).sum(axis=1)
        change = _newton_step(points, tangents, held[live, 1:-1])
        size = np.abs(change).max(axis=(1, 2))
        change_of_length[live] = np.abs(now / length[live] - 1)
        converged[live] = (size < 0.02) | (change_of_length[live] < 1e-5)
        length[live] = now
        change *= np.minimum(1.0, 6.0 / np.maximum(size, 1e-12))[:, None, None]
        moved, stuck = _allowed(surface, path[live], change)
        path[live] = moved
        held[live, 1:-1] |= stuck
    return path, held, converged | (change_of_length < 5e-4)


def _allowed(surface: Surface, path: Float, change: Float) -> tuple[Float, Bool]:
    """The path after the change, without the moves of nodes that would leave the surface."""
    moved = path.copy()
    moved[:, 1:-1] += change
    pair = np.stack([path[:, 1:-1], moved[:, 1:-1]], axis=2).reshape(-1, 2, 2)
    steps = int(np.ceil(max(float(np.abs(change).max()), 1e-9) / 0.8))
    was = joined_places(surface.layers, pair[:, :1])[0][:, 0]
    free = joined_places(surface.layers, _dense(pair, steps), over_gaps=True)[1].all(axis=1)
    stuck = (was & ~free).reshape(change.shape[:2])
    moved[:, 1:-1][stuck] = path[:, 1:-1][stuck]
    return moved, stuck


def _newton_step(points: Float, tangents: Float, held: Bool) -> Float:
    """(m, M - 2, 2) step of the inner nodes."""
    m, n = points.shape[:2]
    pull = points[:, :-2] - 2 * points[:, 1:-1] + points[:, 2:]
    inner = np.where(held[..., None, None], 0.0, tangents[:, 1:-1])
    right = np.einsum("mnki,mnk->mni", inner, pull)
    diagonal = 2 * np.einsum("mnki,mnkj->mnij", inner, inner)
    coupling = -np.einsum("mnki,mnkj->mnij", inner[:, :-1], inner[:, 1:])
    own = np.stack([diagonal[..., 0, 0], diagonal[..., 1, 1]], axis=-1)
    band = np.zeros((4, m, n - 2, 2))  # upper form of solveh_banded: band[3 + i - j, j]
    band[3] = np.where(held[..., None], 1.0, own * (1 + 1e-6))
    band[2, :, :, 1] = diagonal[..., 0, 1]
    band[2, :, 1:, 0] = coupling[..., 1, 0]
    band[1, :, 1:, 0] = coupling[..., 0, 0]
    band[1, :, 1:, 1] = coupling[..., 1, 1]
    band[0, :, 1:, 1] = coupling[..., 0, 1]
    solved: Float = solveh_banded(band.reshape(4, -1), right.reshape(-1), check_finite=False)
    return solved.reshape(m, n - 2, 2)


def _describe(surface: Surface, path: Float, held: Bool, converged: Bool) -> Geodesics:
    """Lengths, standard deviations and reasons of relaxed lines."""
    dense = _dense(path, FINE)
    points, _ = _points(surface, dense)
    segment = np.linalg.norm(np.diff(points, axis=1), axis=2)
    coarse = np.linalg.norm(np.diff(points[:, ::2], axis=1), axis=2)
    # chords are short by a multiple of their squared length: extrapolate (Richardson 1911)
    length = (4 * segment.sum(axis=1) - coarse.sum(axis=1)) / 3
    sigma = np.hypot(_end_sigma(surface, dense, points), 1e-3 * length)
    apart = np.linalg.norm(points[:, -1] - points[:, 0], axis=1)
    gap, bridge, jumps = _gaps(surface, dense, points, segment)
    broken = gap > 0
    length = np.where(broken, segment.sum(axis=1) - gap + bridge, length)
    bent = held.any(axis=1) & ~broken
    reason = np.select(
        [broken & jumps, broken, bent, ~converged], [JUMP, MISSING, BENT, NOT_CONVERGED], OK
    ).astype(np.uint8)
    doubt = np.select(
        [broken & jumps, broken, bent, ~converged],
        # cloth behind a jump may be much longer than the way across; a hole is likely smooth;
        # a flat distance lies between the distance in space and the length round the border
        [
            0.5 * bridge + 0.05 * length,
            0.3 * bridge + 0.01 * length,
            0.6 * (length - apart),
            0.6 * (length - apart),
        ],
        0.0,
    )
    return Geodesics(points[:, ::FINE], length, np.hypot(sigma, doubt), reason != OK, reason)


def _gaps(
    surface: Surface, dense: Float, points: Float, segment: Float
) -> tuple[Float, Float, Bool]:
    """Per line: length from first to last break, distance across, whether depth jumps."""
    layers = surface.layers
    place = np.clip(np.round(dense).astype(int), 0, np.array(layers.valid.shape) - 1)
    guessed = layers.bridged[place[..., 0], place[..., 1]]
    tight = _dense(dense, 2)
    whole = joined_places(layers, tight)[1]
    broken = ~whole.reshape(len(dense), -1, 2).all(axis=2)
    hole = guessed[:, :-1] | guessed[:, 1:]
    bad = broken | hole
    count = bad.shape[1]
    first = np.argmax(bad, axis=1)
    last = count - np.argmax(bad[:, ::-1], axis=1)
    k = np.arange(count)
    between = (k >= first[:, None]) & (k < last[:, None]) & bad.any(axis=1)[:, None]
    row = np.arange(len(dense))
    chord = np.linalg.norm(points[row, last] - points[row, first], axis=1)
    gap = (segment * between).sum(axis=1)
    # on a guessed surface without a break the way along it beats the chord
    smooth = ~broken.any(axis=1)
    bridge = np.where(smooth, gap, chord)
    brief = ~smooth & (gap < surface.spacing_m) & (bridge > 0)
    gap[brief] *= ~_beside(layers, place[row, first][brief], place[row, last][brief])
    depth = surface.rays.to_grid(points)[1]
    step = np.abs(np.diff(depth, axis=1)).max(axis=1)
    measured, level = joined_places(layers, tight, over_gaps=True)
    cut = (measured[:, :-1] & measured[:, 1:] & ~level).any(axis=1)
    jumps = cut | broken.any(axis=1) & (step > 3.0 * surface.spacing_m)
    return gap, np.where(gap > 0, bridge, 0.0), jumps


def _beside(layers: Layers, a: Int, b: Int) -> Bool:
    """(k,) whether places (k, 2) at most two steps apart are joined by those around them.

    A line along a rim then only cuts a corner of it, by less than a grid step.
    """
    way = b - a
    near = np.abs(way).max(axis=1) <= CORNER
    strict = replace(layers, smooth_right=layers.right, smooth_down=layers.down)
    window = connected_window(strict, a[:, 0], a[:, 1], CORNER)
    at = np.clip(way + CORNER, 0, 2 * CORNER)
    return np.asarray(near & window[at[:, 0], at[:, 1], np.arange(len(a))])


def _end_sigma(surface: Surface, dense: Float, points: Float) -> Float:
    """Standard deviation of the length from the noise of both ends along their rays."""
    shape = np.array(surface.layers.valid.shape) - 1
    total = np.zeros(len(dense))
    for end, towards in ((0, 2), (-1, -3)):
        place = np.clip(np.round(dense[:, end]).astype(int), 0, shape)
        direction = points[:, towards] - points[:, end]
        direction /= np.maximum(np.linalg.norm(direction, axis=1), 1e-12)[:, None]
        ray = surface.rays.rays(dense[:, end])
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        along = np.einsum("mi,mi->m", direction, ray)
        total += (surface.sigma_grid_m[place[:, 0], place[:, 1]] * along) ** 2
    return np.sqrt(total)
