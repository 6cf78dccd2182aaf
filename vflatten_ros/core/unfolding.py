"""Distances along the whole surface -> where every sample lies when the item lies flat.

A garment laid flat is a folded isometric image of its surface: between any two points the flat
distance is at most the distance along the cloth, across front and back alike. So every pair has an
upper bound; near pairs of one sheet keep their distance, robustly, since tubes have to crease
somewhere; and otherwise the points spread. No panels, seams or correspondences are needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.values import Bool, Float, Int, Progress, no_progress

UPON_M = 0.015  # landmarks this near in the plane lie on one another ...
UPON_FAR_M = 0.08  # ... if they are this far apart along the cloth
STAY = 1e-6  # weight of the present distance of every pair: keeps the equations regular
BLOCK = 4096  # samples placed at a time, so that they stay in the cache
SPREAD = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001)  # weight of distances that fall short, in turn
# How far a near pair may fall short before it hardly counts, as a share of its distance, in turn.
# Round the side of a tube the cloth is one sheet, and where it creases is found by the pairs that
# give way. The less each may, the fewer do, and wholly: the crease is sharp (graduated
# non-convexity, Blake and Zisserman 1987)
CREASING = (0.2, 0.1, 0.05)
SOFTLY = CREASING[:1]  # for pieces whose edges are the creases
CREASED = 0.2  # share of its distance by which a near pair falls short across a crease


def unfold(
    bound: Float,
    near: Bool,
    config: RotationConfig,
    progress: Progress = no_progress,
    creasing: Sequence[float] = CREASING,
) -> Float:
    """Plane coordinates that keep the bounds, keep near distances, and spread otherwise.

    Parameters
    ----------
    bound : ndarray of shape (k, k)
        Distances along the surface.
    near : ndarray of shape (k, k)
        Pairs that keep their distance both ways.
    config : RotationConfig
    progress : Progress
    creasing : sequence of float
        How sharply the cloth creases in the end; see CREASING.

    Returns
    -------
    ndarray of shape (k, 2)
        Metres; position, rotation and mirror image are arbitrary but repeatable.
    """
    plane, aims = _classical_scaling(bound), _aims(bound, near)
    turns = [(spread, creasing[0]) for spread in SPREAD]
    turns += [(SPREAD[-1], slack) for slack in creasing[1:]]
    rounds = [turn for turn in turns for _ in range(config.unfold_rounds)]
    for done, (spread, slack) in enumerate(rounds):
        progress("unfold", done / len(rounds))
        plane = _majorise(plane, aims, spread, slack)
    return plane


def settle(
    plane: Float,
    bound: Float,
    near: Bool,
    config: RotationConfig,
    spread: float = 0.0,
    creasing: Sequence[float] = CREASING[-1:],
) -> Float:
    """Keep bounds and near distances, from where the points are, without spreading much more.

    Parameters
    ----------
    plane : ndarray of shape (k, 2)
        Where they are, m.
    bound, near, config
        As of unfold.
    spread : float
        Weight of distances that fall short.
    creasing : sequence of float
        As of unfold.

    Returns
    -------
    ndarray of shape (k, 2)
    """
    centre, aims = plane.mean(0), _aims(bound, near)
    for slack in creasing:
        for _ in range(config.unfold_rounds):
            plane = _majorise(plane, aims, spread, slack)
    settled: Float = plane + centre
    return settled


def creased(plane: Float, bound: Float, near: Bool) -> float:
    """Share of the near pairs that fall short as across a crease.

    A garment laid flat has few, or none where its seams are sharp. More mean that it gave way where
    distances contradict each other.

    Parameters
    ----------
    plane : ndarray of shape (k, 2)
        Places laid flat, m.
    bound, near : ndarray of shape (k, k)
        As of unfold.
    """
    apart = _pairwise(plane)[near]
    return float((apart < (1.0 - CREASED) * bound[near]).mean()) if len(apart) else 0.0


def overlap(plane: Float, bound: Float, up: Float) -> float:
    """Share of landmarks on which others of the same side lie, from far along the cloth.

    A garment laid flat has one layer of either side everywhere. More mean that layers were
    joined that are not.
    """
    upon = (_pairwise(plane) < UPON_M) & (bound > UPON_FAR_M) & (np.outer(up, up) > 0)
    return float(upon.any(1).mean())


def carry(points: Float, before: Float, after: Float) -> Float:
    """Carry points along with an outline that moves from `before` to `after`.

    Each moves rigidly, as the outline around it does on average (Schaefer et al. 2006, image
    deformation by moving least squares).

    Parameters
    ----------
    points : ndarray of shape (n, 2)
    before, after : ndarray of shape (k, 2)
        Corresponding vertices of the closed outline.
    """
    start, end = _along(before), _along(after)
    weight = 1 / (((points[:, None] - start) ** 2).sum(2) + 1e-4) ** 2
    weight /= weight.sum(1, keepdims=True)
    from_, to = weight @ start, weight @ end
    p = (start - from_[:, None]) @ np.array([1, 1j])
    q = (end - to[:, None]) @ np.array([1, 1j])
    turn = (weight * p.conj() * q).sum(1)
    turn /= np.maximum(np.abs(turn), 1e-12)
    moved = turn * ((points - from_) @ np.array([1, 1j]))
    carried: Float = to + np.column_stack([moved.real, moved.imag])
    return carried


def _along(outline: Float, per_edge: int = 20) -> Float:
    """Points along every edge of a closed outline, alike in number."""
    share = np.linspace(0.0, 1.0, per_edge, endpoint=False)[:, None]
    after = np.roll(outline, -1, axis=0)
    points: Float = outline[:, None] + (after - outline)[:, None] * share
    return points.reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class _Aims:
    """Bounds, and what the weights of stress majorisation take from them."""

    bound: Float  # (k, k)
    near: Bool  # (k, k)
    base: Float  # (k, k) weight of a pair
    stay: Float  # (k, k) of its present distance
    safe: Float  # (k, k) the bounds, 1 where there is none


def _aims(bound: Float, near: Bool) -> _Aims:
    safe = np.where(bound > 0, bound, 1.0)
    base = (bound > 0) / safe**1.5
    return _Aims(bound, near, base, STAY * base, safe)


def _majorise(plane: Float, aims: _Aims, spread: float, slack: float) -> Float:
    """Three steps of stress majorisation (de Leeuw 1977) under weights taken from the residuals."""
    k = len(plane)
    bound, base = aims.bound, aims.base
    flat = _pairwise(plane)
    short = np.maximum(bound - flat, 0.0)
    robust = short / (slack * aims.safe)
    robust *= robust
    robust += 1.0
    np.maximum(np.divide(1.0, robust, out=robust), spread, out=robust)
    weight = np.where(short > 0, np.where(aims.near, robust, spread), 1.0)
    weight *= base
    flat *= aims.stay  # a pair without any say stays where it is
    target = weight * bound
    target += flat
    weight += aims.stay
    system = 1 / k - weight  # 1/k: fixes the centroid
    system[np.diag_indices(k)] += weight.sum(1)
    factor = cho_factor(system, overwrite_a=True, check_finite=False)
    for _ in range(3):
        apart = _pairwise(plane)
        ratio = np.divide(target, np.maximum(apart, 1e-9, out=apart), out=apart)
        force = ratio.sum(1)[:, None] * plane - ratio @ plane
        plane = cho_solve(factor, force, overwrite_b=True, check_finite=False)
    return plane


def _pairwise(plane: Float) -> Float:
    x, y = plane.T
    apart: Float = x[:, None] - x
    apart *= apart
    across = y[:, None] - y
    across *= across
    apart += across
    return np.sqrt(apart, out=apart)


def _classical_scaling(bound: Float) -> Float:
    """Torgerson 1952; signs fixed by the largest coordinate, or results flip between machines."""
    squared = bound**2
    gram = -0.5 * (squared - squared.mean(0) - squared.mean(1)[:, None] + squared.mean())
    values, axes = np.linalg.eigh(gram)
    axes = axes[:, -2:]
    axes = axes * np.sign(axes[np.abs(axes).argmax(0), [0, 1]])
    plane: Float = axes * np.sqrt(np.maximum(values[-2:], 0.0))
    return plane


def place_samples(around: Int, around_m: Float, sheet: Bool, plane: Float) -> tuple[Float, Float]:
    """Every sample's place from its distances to the landmarks around it.

    Parameters
    ----------
    around : ndarray of shape (n, p)
        Landmarks near each sample.
    around_m : ndarray of shape (n, p)
        Distances from them, inf where unknown.
    sheet : ndarray of shape (n, p)
        Where the distance is known both ways; elsewhere it is an upper bound.
    plane : ndarray of shape (k, 2)
        Places of the landmarks.

    Returns
    -------
    uv : ndarray of shape (n, 2)
        NaN where fewer than three landmarks are near.
    misfit_m : ndarray of shape (n,)
        Root of the mean squared excess over the distances, inf where uv is NaN.
    """
    uv, misfit = np.empty((len(around), 2)), np.empty(len(around))
    for start in range(0, len(around), BLOCK):
        some = slice(start, start + BLOCK)
        uv[some], misfit[some] = _placed(around[some].T, around_m[some].T, sheet[some].T, plane)
    return uv, misfit


def _placed(around: Int, around_m: Float, sheet: Bool, plane: Float) -> tuple[Float, Float]:
    """place_samples of (p, n) distances."""
    known = np.isfinite(around_m)
    distance = np.where(known, around_m, 0.0)
    base = np.where(known, 1 / (distance + 0.005) ** 2, 0.0) * np.where(sheet, 1.0, 0.1)
    total = np.maximum(base.sum(0), 1e-9)
    x, y = plane[:, 0][around], plane[:, 1][around]
    u, v = (base * x).sum(0) / total, (base * y).sum(0) / total
    shorter, longer = 1 / (0.2 * distance + 0.003), 1 / 0.01
    for _ in range(8):
        du, dv = u - x, v - y
        apart = np.maximum(np.sqrt(du * du + dv * dv), 1e-6)
        excess = apart - distance
        slack = excess * np.where(excess < 0, shorter, longer)
        weight = base / (1 + slack * slack)
        du /= apart
        dv /= apart
        # damped: a single ring of landmarks leaves the direction across it loose
        damping = 0.05 * weight.sum(0) + 1e-9
        pull = weight * excess
        fu, fv = (pull * du).sum(0), (pull * dv).sum(0)
        weight_u = weight * du
        uu, cross = (weight_u * du).sum(0) + damping, (weight_u * dv).sum(0)
        vv = (weight * dv * dv).sum(0) + damping
        size = uu * vv - cross * cross
        u, v = u - (vv * fu - cross * fv) / size, v - (uu * fv - cross * fu) / size
    uv = np.column_stack([u, v])
    misfit = np.sqrt((base * excess.clip(0) ** 2).sum(0) / total)
    few = known.sum(0) < 3
    uv[few], misfit[few] = np.nan, np.inf
    return uv, misfit


def orientation(uv: Float, xyz: Float, normal: Float, a: Int, b: Int) -> Float:
    """Which way up each sample lies: 1 with its outside up, -1 with its outside down, 0 unclear.

    From the links (a, b) around a sample: whether their directions turn the same way in the plane
    as about its normal.
    """
    start, end = np.r_[a, b], np.r_[b, a]
    chord, flat = xyz[end] - xyz[start], uv[end] - uv[start]
    mean = np.zeros((len(xyz), 3, 2))  # sum of chord x flat: its minors give the sign of the map
    for i in range(3):
        for j in range(2):
            mean[:, i, j] = np.bincount(start, chord[:, i] * flat[:, j], minlength=len(xyz))
    turn = (np.cross(mean[:, :, 0], mean[:, :, 1]) * normal).sum(1)
    size = np.bincount(start, (chord**2).sum(1), minlength=len(xyz))
    sign = np.nan_to_num(turn / np.maximum(size, 1e-12) ** 2)
    for _ in range(3):  # neighbours lie the same way up, but for creases
        around = np.bincount(start, sign[end], minlength=len(xyz))
        sign = sign + around / np.maximum(np.bincount(start, minlength=len(xyz)), 1)
    clear = np.abs(sign) > 0.02
    result: Float = np.where(clear, np.sign(sign), 0.0)
    return result
