"""Unrolls a surface of samples into the plane without a first guess, and robustly.

Every pair of neighbouring samples says where one lies in the other's tangent plane (the chord,
lengthened to the arc that the turn of the normals implies: exact on cylinders) and how the two
tangent frames are turned against one another (parallel transport). First the angles of all frames
in the plane follow from the turns (a sparse eigenvector), then all places from the offsets (sparse
least squares); both repeat with weights that let wrong pairs go. Complex numbers stand for vectors
of the plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, identity
from scipy.sparse.linalg import SuperLU, splu

from vflatten_ros.core.values import Bool, Float, Int

Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Relations:
    """Pairs of samples and how they lie to one another along the surface."""

    i: Int  # (m,)
    j: Int  # (m,)
    ahead: Complex  # (m,) from i to j in i's frame, m
    back: Complex  # (m,) from j to i in j's frame, m
    turn: Complex  # (m,) unit: j's frame in i's

    def part(self, keep: Bool | Int) -> Relations:
        """Some of the pairs."""
        return Relations(
            self.i[keep], self.j[keep], self.ahead[keep], self.back[keep], self.turn[keep]
        )

    @property
    def length_m(self) -> Float:
        """(m,) distance along the surface."""
        return np.abs(self.ahead)


def joined(*parts: Relations) -> Relations:
    """All pairs of several relations."""
    return Relations(
        np.concatenate([p.i for p in parts]),
        np.concatenate([p.j for p in parts]),
        np.concatenate([p.ahead for p in parts]),
        np.concatenate([p.back for p in parts]),
        np.concatenate([p.turn for p in parts]),
    )


def relate(points: Float, normals: Float, i: Int, j: Int) -> Relations:
    """How pairs of nearby samples lie to one another along the surface.

    Parameters
    ----------
    points, normals : ndarray of shape (n, 3)
        Samples and their unit normals, all on the same side of the cloth. Chords longer than the
        radius of curvature are not to be trusted.
    i, j : ndarray of shape (m,)
        Pairs.
    """
    right, up = tangent_frames(normals)
    ahead, back = arcs(points[j] - points[i], normals[i], normals[j])

    def in_frame(vector: Float, of: Int) -> Complex:
        return _dot(vector, right[of]) + 1j * _dot(vector, up[of])

    turn = in_frame(_carried(right[j], normals[j], normals[i]), i)
    return Relations(
        i,
        j,
        in_frame(ahead, i),
        in_frame(-back, j),
        turn / np.abs(turn),
    )


def arcs(chord: Float, start: Float, end: Float) -> tuple[Float, Float]:
    """Steps along the surface of given chords, in the tangent planes at both of their ends.

    Exact on cylinders, whatever the direction of the chord.

    Parameters
    ----------
    chord : ndarray of shape (m, 3)
    start, end : ndarray of shape (m, 3)
        Unit normals at the two ends of each.

    Returns
    -------
    at_start, at_end : ndarray of shape (m, 3)
    """
    middle = start + end
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    flat = chord - _dot(chord, middle)[:, None] * middle
    bend = end - start
    size = np.linalg.norm(bend, axis=1)
    across = bend / np.maximum(size, 1e-12)[:, None]  # the direction that bends
    half = np.arcsin(np.clip(size / 2.0, 0.0, 1.0))
    arc = np.where(half > 1e-4, half / np.maximum(np.sin(half), 1e-9), 1.0)
    along = flat + ((arc - 1.0) * _dot(flat, across))[:, None] * across
    return _carried(along, middle, start), _carried(along, middle, end)


def tangent_frames(normals: Float) -> tuple[Float, Float]:
    """Two unit tangents of every normal, (n, 3) each, with right x up = normal."""
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    right = np.cross(least, normals)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return right, np.cross(normals, right)


def unroll(
    count: int, relations: Relations, weight: Float, scale_m: float, rounds: int = 8
) -> tuple[Float, Complex, Float]:
    """Places of all samples in the plane.

    Parameters
    ----------
    count : int
        Samples; the relations must connect all of them.
    relations : Relations
    weight : ndarray of shape (m,)
        Trust in each pair.
    scale_m : float
        Misfits well above this lose their say.
    rounds : int
        Reweightings.

    Returns
    -------
    uv : ndarray of shape (count, 2)
        Right-handed as seen against the normals.
    frame : ndarray of shape (count,)
        Unit; the direction of each sample's right tangent in the plane.
    misfit_m : ndarray of shape (m,)
    """
    frame = _angles(count, relations, weight)
    trust = weight
    place = np.zeros(count, dtype=complex)
    for _ in range(rounds):
        place = _places(count, relations, frame, trust)
        misfit = _misfit(relations, place, frame)
        trust = weight / (1.0 + (misfit / scale_m) ** 2) ** 2
        frame = _turned(relations, place, frame, trust)
    return np.stack([place.real, place.imag], axis=1), frame, _misfit(relations, place, frame)


def _dot(a: Float, b: Float) -> Float:
    out: Float = np.einsum("ij,ij->i", a, b)
    return out


def _carried(vector: Float, start: Float, end: Float) -> Float:
    """Vectors turned by the smallest rotation that takes `start` to `end` (unit rows)."""
    axis = np.cross(start, end)
    cos = _dot(start, end)[:, None]
    spin = np.cross(axis, vector)
    result: Float = (
        vector * cos + spin + axis * (_dot(axis, vector)[:, None] / np.maximum(1 + cos, 1e-9))
    )
    return result


def _laplacian(
    count: int, relations: Relations, weight: Float, turn: Complex | Float | float
) -> csc_matrix:
    """Hermitian matrix of sum w |x_j - turn x_i|^2, slightly raised so that it can be inverted."""
    i, j = relations.i, relations.j
    values = np.concatenate([-weight * np.conj(turn), -weight * turn, weight, weight])
    rows, cols = np.concatenate([i, j, i, j]), np.concatenate([j, i, i, j])
    matrix = coo_matrix((values, (rows, cols)), shape=(count, count)).tocsc()
    return matrix + 1e-9 * max(float(weight.mean()), 1e-300) * identity(count, format="csc")


def _factored(matrix: csc_matrix) -> SuperLU:
    """Factors of a Hermitian matrix: an ordering for symmetric patterns keeps them sparse."""
    return splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def _angles(count: int, relations: Relations, weight: Float) -> Complex:
    """Frames of the plane that agree best with the turns: lowest eigenvector, by power steps."""
    solver = _factored(_laplacian(count, relations, weight, relations.turn))
    frame = np.ones(count, dtype=complex)
    for _ in range(30):
        frame = solver.solve(frame)
        frame /= np.abs(frame).max()
    return _unit(frame, np.ones(count, dtype=complex))


def _unit(values: Complex, otherwise: Complex) -> Complex:
    size = np.abs(values)
    return np.where(size > 1e-12, values / np.maximum(size, 1e-12), otherwise)


def _places(count: int, relations: Relations, frame: Complex, weight: Float) -> Complex:
    i, j = relations.i, relations.j
    offset = weight * 0.5 * (frame[i] * relations.ahead - frame[j] * relations.back)
    right = _summed(count, j, offset) - _summed(count, i, offset)
    solver = _factored(_laplacian(count, relations, weight, 1.0))
    solved = solver.solve(np.stack([right.real, right.imag], axis=1))
    place: Complex = solved[:, 0] + 1j * solved[:, 1]
    result: Complex = place - place.mean()
    return result


def _summed(count: int, at: Int, values: Complex | Float) -> Complex:
    real = np.bincount(at, values.real, count)
    return real + 1j * np.bincount(at, values.imag, count)


def _misfit(relations: Relations, place: Complex, frame: Complex) -> Float:
    i, j = relations.i, relations.j
    seen = 0.5 * (frame[i] * relations.ahead - frame[j] * relations.back)
    out: Float = np.abs(place[j] - place[i] - seen)
    return out


def _turned(relations: Relations, place: Complex, frame: Complex, weight: Float) -> Complex:
    """Frames that fit the present places best; the turns to neighbours decide where none do."""
    i, j, turn = relations.i, relations.j, relations.turn
    step = place[j] - place[i]
    count = len(place)
    fit = _summed(count, i, weight * step * np.conj(relations.ahead))
    fit += _summed(count, j, -weight * step * np.conj(relations.back))
    small = 1e-4 * weight
    fit += _summed(count, i, small * frame[j] * np.conj(turn))
    fit += _summed(count, j, small * frame[i] * turn)
    return _unit(fit, frame)


def frames_of(relations: Relations, uv: Float, frame: Complex, weight: Float) -> Complex:
    """Directions of the samples' tangent frames in the plane, once the places have changed."""
    return _turned(relations, uv[:, 0] + 1j * uv[:, 1], frame, weight)


def carry(
    points: Float,
    samples: Float,
    normals: Float,
    uv: Float,
    frame: Complex,
    near: Int,
    distance: Float,
) -> Float:
    """Places in the plane of further points of the surface, from the samples around each.

    Parameters
    ----------
    points : ndarray of shape (q, 3)
    samples, normals : ndarray of shape (n, 3)
    uv, frame : ndarray
        Of the samples.
    near : ndarray of shape (q, k)
        Samples of each point, nearest first.
    distance : ndarray of shape (q, k)
        Theirs, metres; inf: none.
    """
    right, up = tangent_frames(normals)
    chord = points[:, None] - samples[near]
    local = np.einsum("qkd,qkd->qk", chord, right[near]) + 1j * np.einsum(
        "qkd,qkd->qk", chord, up[near]
    )
    place = (uv[:, 0] + 1j * uv[:, 1])[near] + frame[near] * local
    weight = np.where(np.isfinite(distance), 1.0 / (distance**2 + 1e-6), 0.0)
    mean = (place * weight).sum(axis=1) / weight.sum(axis=1)
    return np.column_stack([mean.real, mean.imag])
