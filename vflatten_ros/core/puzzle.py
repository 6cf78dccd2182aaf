"""Pieces of the surface, each laid flat by itself, put together like a jigsaw puzzle.

What hangs together on one sheet lies flat to the millimetre, whatever the item. Where the edges of
two pieces lie side by side, as the two layers of a hem do, that is a tie between them. Ties of
one pair of pieces that agree on one rigid motion over a length of edge are right; the few between
layers that only happen to touch agree with nothing. The pieces with most ties are joined first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.values import Bool, Float, Int

Complex = NDArray[np.complex128]

AGREE_M = 0.012  # ties that are met within this, beside their slack, agree
APART_M = 0.03  # two ties nearer than this do not tell a direction
CELL_M = 0.010  # ties in the same cell count once
MOST_TIES = 400
TRIALS = 800
ROUNDS = 5  # of fitting a motion to the ties that it meets
RASTER_M = 0.006  # of the images that tell whether pieces lie on one another
MOST_OVERLAP = 0.15  # share of a piece on the same side of the other, above which it is wrong
SEED = 20190401


@dataclass(frozen=True, eq=False)
class Ties:
    """Pairs of samples of different pieces that lie together on the cloth, rightly or not."""

    one: Int  # (t,)
    other: Int  # (t,)
    slack_m: Float  # (t,) how far apart they may be


@dataclass(frozen=True)
class Motion:
    """Rigid motion in the plane: z -> turn * (z or, mirrored, its conjugate) + shift."""

    mirrored: bool
    turn: complex
    shift: complex

    def __call__(self, z: Complex) -> Complex:
        moved: Complex = self.turn * (z.conj() if self.mirrored else z) + self.shift
        return moved


@dataclass(frozen=True, eq=False)
class Puzzle:
    """Pieces as they were joined."""

    z: Complex  # (n,) place of every sample in the plane of its group; NaN in no piece
    side: Float  # (n,) 1 outside up, -1 outside down, 0 unclear
    group: Int  # (n,) pieces of the same number were joined; -1: in no piece
    met: Bool  # (t,) ties that joined them


def put_together(
    pieces: Sequence[Bool], uv: Sequence[Float], side: Sequence[Float], ties: Ties, least: int
) -> Puzzle:
    """Join pieces as their ties agree.

    Parameters
    ----------
    pieces : sequence of ndarray of shape (n,)
        Masks of the samples of each.
    uv : sequence of ndarray of shape (n, 2)
        Places of the samples of each piece in its own plane; NaN elsewhere.
    side : sequence of ndarray of shape (n,)
        1 outside up, -1 outside down in that plane.
    ties : Ties
    least : int
        Fewest places (CELL_M) in which ties must agree for two pieces to be joined.
    """
    n = len(pieces[0])
    z = np.full(n, np.nan + 0j)
    group, up = np.full(n, -1), np.zeros(n)
    for k, (piece, places, sides) in enumerate(zip(pieces, uv, side, strict=True)):
        own = piece & np.isfinite(places).all(1)
        group[own], up[own] = k, sides[own]
        z[own] = places[own] @ np.array([1, 1j])
    met = np.zeros(len(ties.one), dtype=bool)
    refused: set[tuple[int, int]] = set()
    found: dict[tuple[int, int], tuple[int, Bool, Motion]] = {}
    while True:
        a, b = group[ties.one], group[ties.other]
        for pair in sorted(set(zip(np.minimum(a, b).tolist(), np.maximum(a, b).tolist()))):
            if pair[0] < 0 or pair[0] == pair[1] or pair in refused or pair in found:
                continue
            rows = np.flatnonzero((np.minimum(a, b) == pair[0]) & (np.maximum(a, b) == pair[1]))
            first = np.where(a[rows] == pair[0], ties.one[rows], ties.other[rows])
            second = np.where(a[rows] == pair[0], ties.other[rows], ties.one[rows])
            # round a rim lie the two sides of the cloth; along a straight one nothing else tells
            mirrored = float((up[first] * up[second]).sum()) > 0.0
            agree, motion, places_ = agreeing(z[first], z[second], ties.slack_m[rows], mirrored)
            mask = np.zeros(len(ties.one), dtype=bool)
            mask[rows[agree]] = True
            found[pair] = places_, mask, motion
        if not found:
            break
        pair = max(found, key=lambda p: found[p][0])
        count, mask, motion = found.pop(pair)
        if count < least:
            break
        kept, moved = group == pair[0], group == pair[1]
        there = motion(z[moved])
        turned = -up[moved] if motion.mirrored else up[moved]
        if overlap(z[kept], up[kept], there, turned) > MOST_OVERLAP:
            refused.add(pair)
            continue
        z[moved], up[moved], group[moved] = there, turned, pair[0]
        met |= mask
        found = {p: f for p, f in found.items() if not {*p} & {*pair}}
        refused = {p for p in refused if not {*p} & {*pair}}
    return Puzzle(z, up, group, met)


def agreeing(
    one: Complex, other: Complex, slack_m: Float, mirrored: bool
) -> tuple[Bool, Motion, int]:
    """The rigid motion of the others' plane that meets ties in the most places.

    Random pairs of ties are tried (Fischler and Bolles 1981), the same ones every time.

    Parameters
    ----------
    one, other : ndarray of shape (t,)
        Ends of the ties in the planes of either.
    slack_m : ndarray of shape (t,)
        How far apart the ends may be.
    mirrored : bool
        Whether the motion turns the others' plane over.

    Returns
    -------
    met : ndarray of shape (t,)
    motion : Motion
    places : int
        Cells of CELL_M with ties that are met; 0: no two ties that are apart agree.
    """
    nothing = np.zeros(len(one), dtype=bool), Motion(False, 1.0, 0.0), 0
    few = _one_per_cell(one, other)
    if len(few) < 2:
        return nothing
    p, q, slack = one[few], other[few], slack_m[few]
    rng = np.random.default_rng(SEED)
    i, j = rng.integers(len(few), size=(2, 4 * TRIALS))
    along, against = p[j] - p[i], q[j] - q[i]
    alike = (np.abs(against) > APART_M) & (np.abs(np.abs(along) - np.abs(against)) < AGREE_M)
    i, along, against = i[alike][:TRIALS], along[alike][:TRIALS], against[alike][:TRIALS]
    if not len(i):
        return nothing
    there = q.conj() if mirrored else q
    turn = along / (against.conj() if mirrored else against)
    turn /= np.abs(turn)
    shift = p[i] - turn * there[i]
    off = np.abs(turn[:, None] * there + shift[:, None] - p)
    score = (np.clip(1.0 - off / (AGREE_M + slack), 0.0, None) ** 0.5).sum(1)
    k = int(score.argmax())
    motion = Motion(mirrored, complex(turn[k]), complex(shift[k]))
    for _ in range(ROUNDS):
        met = np.abs(motion(other) - one) < AGREE_M + slack_m
        if met.sum() < 2:
            return nothing
        motion = _fitted(one[met], other[met], motion.mirrored)
    met = np.abs(motion(other) - one) < AGREE_M + slack_m
    places = len(np.unique(np.floor(_real(other[met]) / CELL_M), axis=0))
    return met, motion, places


def _fitted(one: Complex, other: Complex, mirrored: bool) -> Motion:
    there = other.conj() if mirrored else other
    turn = complex(((one - one.mean()) * (there - there.mean()).conj()).sum())
    turn = turn / abs(turn) if abs(turn) > 0 else 1.0
    return Motion(mirrored, turn, complex(one.mean() - turn * there.mean()))


def _one_per_cell(one: Complex, other: Complex) -> Int:
    """Rows of ties, one for each pair of cells of their ends, evenly chosen if there are many."""
    cells = np.floor(np.hstack([_real(one), _real(other)]) / CELL_M)
    rows: Int = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    if len(rows) > MOST_TIES:
        rows = rows[np.linspace(0, len(rows) - 1, MOST_TIES).astype(int)]
    return rows


def _real(z: Complex) -> Float:
    return np.column_stack([z.real, z.imag])


def overlap(z_one: Complex, up_one: Float, z_other: Complex, up_other: Float) -> float:
    """Share of either piece, whichever is more, that lies on the same side of the other."""
    least = min(z_one.real.min(), z_other.real.min()), min(z_one.imag.min(), z_other.imag.min())
    most = max(z_one.real.max(), z_other.real.max()), max(z_one.imag.max(), z_other.imag.max())
    size = np.ceil((np.array(most) - least) / RASTER_M).astype(int) + 3
    covered = np.zeros(2)
    for sign in (1.0, -1.0):
        cells = [
            np.rint((_real(z[up == sign]) - least) / RASTER_M).astype(int) + 1
            for z, up in ((z_one, up_one), (z_other, up_other))
        ]
        for k, (mine, yours) in enumerate((cells, cells[::-1])):
            image = np.zeros(size[::-1], dtype=np.uint8)
            image[yours[:, 1], yours[:, 0]] = 1
            image = cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
            image = cv2.erode(image, np.ones((5, 5), np.uint8))
            covered[k] += image[mine[:, 1], mine[:, 0]].sum()
    return float((covered / [max(len(z_one), 1), max(len(z_other), 1)]).max())
