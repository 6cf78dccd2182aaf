"""A view's pieces of cloth laid flat, all their points at once.

On cloth, which hardly stretches, directions can be carried from place to place without turning:
the frames of neighbouring places differ by a known angle. Two sparse least-squares problems follow,
with one matrix: turn every frame so that neighbours agree, then place the points so that each
differs from its neighbours by the step between them on the surface. A few rounds of fitting the
turns to the places again and placing the points with them (as-rigid-as-possible) spread what
noise is left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, identity
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from vflatten_ros.core.surface import Surface
from vflatten_ros.core.unrolling import arcs
from vflatten_ros.core.values import Bool, Float, Int

Complex = NDArray[np.complex128]
ROUNDS = 8
GAP = 6  # grid steps across the widest gap that is tied
MOST_MISFIT_M = 0.003  # a tie that misses the way around by more is none: a cut, or another layer


@dataclass(frozen=True, eq=False)
class FlatPatch:
    """The grid places of a surface in the plane; each piece has a position of its own."""

    uv: Float  # (rows, cols, 2) metres, nan where there is no surface
    piece: NDArray[np.int32]  # (rows, cols) number of the piece, largest first; -1: none
    strain: Float  # (rows, cols) rms misfit of the steps to the neighbours, relative


@dataclass(frozen=True, eq=False)
class _Steps:
    """Steps from places a to places b, as complex numbers in the frames of both."""

    a: Int
    b: Int
    of_a: Complex
    of_b: Complex

    def turned(self, turn: Float) -> Complex:
        """The steps in the plane, for turns of the frames."""
        spin = np.exp(1j * turn)
        return np.asarray(0.5 * (spin[self.a] * self.of_a + spin[self.b] * self.of_b))


def flatten_patch(surface: Surface) -> FlatPatch:
    """Lay every connected piece of a view's surface flat, by the measured places alone.

    Places on both sides of a slit or a hole hang together around it. Across a narrow gap without a
    jump they are also tied to each other, where that agrees with the way around.
    """
    layers = surface.layers
    used = layers.seen
    number = np.full(used.shape, -1)
    number[used] = np.arange(used.sum())
    rows, cols = np.nonzero(used)
    frames, points = _frames(surface, rows, cols)
    sure = 1.0 / (1e-12 + surface.sigma_grid_m[rows, cols] ** 2)
    sure /= sure.mean()

    edges = _edges(number, layers.right, layers.down)
    place, turn = _solve(_steps(points, frames, *edges), sure, len(rows))
    over = _gap_edges(number, layers.smooth_right, layers.smooth_down)
    if len(over[0]):
        ties = _steps(points, frames, *over)
        misfit = np.abs(place[ties.b] - place[ties.a] - ties.turned(turn))
        agree = misfit < MOST_MISFIT_M
        if agree.any():
            both = (np.concatenate([e, o[agree]]) for e, o in zip(edges, over))
            edges = (next(both), next(both))
            place, turn = _solve(_steps(points, frames, *edges), sure, len(rows))
    return _on_grid(used, rows, cols, place, _steps(points, frames, *edges))


def _edges(number: Int, right: Bool, down: Bool) -> tuple[Int, Int]:
    """Pairs of joined neighbours."""
    used = number >= 0
    right = right[:, :-1] & used[:, :-1] & used[:, 1:]
    down = down[:-1] & used[:-1] & used[1:]
    a = np.concatenate([number[:, :-1][right], number[:-1][down]])
    b = np.concatenate([number[:, 1:][right], number[1:][down]])
    return a, b


def _gap_edges(number: Int, right: Bool, down: Bool) -> tuple[Int, Int]:
    """Pairs on both sides of a narrow gap in a row or a column, without a jump between."""
    first, second = [], []
    for places, smooth in ((number, right), (number.T, down.T)):
        clear = smooth[:, :-1]
        for width in range(2, GAP + 1):
            near, far = places[:, :-width], places[:, width:]
            way = clear[:, : near.shape[1]] & (near >= 0) & (far >= 0)
            for k in range(1, width):
                way &= clear[:, k : k + near.shape[1]] & (places[:, k : k + near.shape[1]] < 0)
            first.append(near[way])
            second.append(far[way])
    return np.concatenate(first), np.concatenate(second)


def _frames(surface: Surface, rows: Int, cols: Int) -> tuple[Float, Float]:
    """(k, 3, 3) rows: two tangents and the normal; (k, 3) points."""
    rc = np.stack([rows, cols], axis=1).astype(float)
    fit = surface.fits[rows, cols]
    by_row, by_col = surface.rays.tangents(rc, fit[:, 0], fit[:, 1:3])
    normal = np.cross(by_row, by_col)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = by_col / np.linalg.norm(by_col, axis=1, keepdims=True)
    frames = np.stack([first, np.cross(normal, first), normal], axis=1)
    return frames, surface.rays.to_points(rc, fit[:, 0])


def _steps(points: Float, frames: Float, a: Int, b: Int) -> _Steps:
    """The step along each edge as a complex number in the frames of both ends."""
    ahead = arcs(points[b] - points[a], frames[a, 2], frames[b, 2])
    steps = []
    for end, step in zip((a, b), ahead):
        x, y = (np.einsum("ki,ki->k", frames[end, i], step) for i in (0, 1))
        steps.append(x + 1j * y)
    return _Steps(a, b, steps[0], steps[1])


def _solve(steps: _Steps, sure: Float, count: int) -> tuple[Complex, Float]:
    """(k,) complex places and (k,) turns of the frames that fit the steps best."""
    a, b = steps.a, steps.b
    weight = sure[a] * sure[b]  # slopes at borders, which turns depend on, are the worst known
    factor, incidence = _factor(count, a, b, weight)
    turn = factor.solve(incidence.T @ (weight * np.angle(steps.of_a * steps.of_b.conj())))
    place = _place(factor, incidence, weight * steps.turned(turn))
    before = turn
    for k in range(ROUNDS):
        turned = _turns(place, steps, weight, turn)
        # momentum (Nesterov 1983): bends of the whole patch die out slowly without
        change = k / (k + 3) * np.angle(np.exp(1j * (turned - before)))
        turn, before = turned + change, turned
        place = _place(factor, incidence, weight * steps.turned(turn))
    return place, turn


def _factor(count: int, a: Int, b: Int, weight: Float) -> tuple[SuperLU, csr_matrix]:
    """Factor of the weighted graph Laplacian, and the edges' differences b minus a."""
    edges = np.arange(len(a))
    ones = np.ones(len(a))
    incidence = csr_matrix(
        (np.concatenate([-ones, ones]), (np.concatenate([edges, edges]), np.concatenate([a, b]))),
        shape=(len(a), count),
    )
    # a touch of the identity holds each piece in place
    laplacian = incidence.T @ incidence.multiply(weight[:, None]) + 1e-9 * identity(count)
    options = {"SymmetricMode": True}
    factor = splu(
        laplacian.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
    )
    return factor, incidence


def _place(factor: SuperLU, incidence: csr_matrix, step: Complex) -> Complex:
    """(k,) complex places whose differences are the steps, by least squares."""
    right = incidence.T @ np.stack([step.real, step.imag], axis=1)
    solved = factor.solve(np.ascontiguousarray(right))
    return np.asarray(solved[:, 0] + 1j * solved[:, 1])


def _turns(place: Complex, steps: _Steps, weight: Float, turn: Float) -> Float:
    """The turn of every frame that fits its steps to the places best."""
    step = (place[steps.b] - place[steps.a]) * weight
    count = len(turn)
    pull = np.zeros(count, complex)
    for end, own in ((steps.a, steps.of_a), (steps.b, steps.of_b)):
        product = step * own.conj()
        pull += np.bincount(end, product.real, count) + 1j * np.bincount(end, product.imag, count)
    return np.where(np.abs(pull) > 0, np.angle(pull), turn)


def _on_grid(
    used: Bool,
    rows: Int,
    cols: Int,
    place: Complex,
    steps: _Steps,
) -> FlatPatch:
    uv = np.full((*used.shape, 2), np.nan)
    uv[rows, cols] = np.stack([place.real, place.imag], axis=1)
    a, b, count = steps.a, steps.b, len(rows)
    error = (np.abs(place[b] - place[a]) / np.maximum(np.abs(steps.of_a), 1e-12) - 1) ** 2
    total = np.bincount(a, error, count) + np.bincount(b, error, count)
    edges = np.bincount(a, minlength=count) + np.bincount(b, minlength=count)
    strain = np.zeros(used.shape)
    strain[rows, cols] = np.sqrt(total / np.maximum(edges, 1))
    piece = np.full(used.shape, -1, np.int32)
    piece[rows, cols] = _pieces(a, b, count)
    return FlatPatch(uv, piece, strain)


def _pieces(a: Int, b: Int, count: int) -> Int:
    """(k,) which places hang together, the largest piece first."""
    graph = csr_matrix((np.ones(len(a)), (a, b)), shape=(count, count))
    label = connected_components(graph, directed=False)[1]
    order = np.argsort(-np.bincount(label), kind="stable")
    return np.asarray(np.argsort(order, kind="stable")[label])
