"""Distances along the whole surface -> where every sample lies when the item lies flat.

A garment laid flat is a folded isometric image of its surface: between any two points the flat
distance is at most the distance along the cloth, across front and back alike. So every pair has an
upper bound; near pairs of one sheet keep their distance, robustly, since tubes have to crease
somewhere; and otherwise the points spread. No panels, seams or correspondences are needed.
"""

from __future__ import annotations

from collections.abc import Sequence

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
RELAXING = 16  # steps of Levenberg and Marquardt at most
RELAXED = 3e-4  # share of the stress: a step that gains less is the last
FARTHEST_STEP_M = 0.02
DAMPING, LEAST_DAMPING = 1e-3, 1e-5  # of the first step, and ever; in the median stiffness
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
    plane, towards = _classical_scaling(bound), _Majorisation(bound, near)
    turns = [(spread, creasing[0]) for spread in SPREAD]
    turns += [(SPREAD[-1], slack) for slack in creasing[1:]]
    rounds = [turn for turn in turns for _ in range(config.unfold_rounds)]
    for done, (spread, slack) in enumerate(rounds):
        progress("unfold", done / len(rounds))
        plane = towards.step(plane, spread, slack)
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
    centre, towards = plane.mean(0), _Majorisation(bound, near)
    for slack in creasing:
        for _ in range(config.unfold_rounds):
            plane = towards.step(plane, spread, slack)
    settled: Float = plane + centre
    return settled


def relaxed(plane: Float, bound: Float, near: Bool) -> Float:
    """The plane in which bounds and near distances are kept best, from one that is not far from it.

    Long parts bend so easily that stress majorisation takes thousands of steps to straighten them.
    These are steps of Levenberg and Marquardt on the same stress, of points that do not spread.

    Parameters
    ----------
    plane : ndarray of shape (k, 2)
        Where they are, m.
    bound, near : ndarray of shape (k, k)
        As of unfold.

    Returns
    -------
    ndarray of shape (k, 2)
    """
    k, centre = len(plane), plane.mean(0)
    stress = _Stress(bound, near)
    cost, system, force = stress.at(plane)
    damping = DAMPING
    for _ in range(RELAXING):
        held = system.copy()
        diagonal = held.ravel()[:: 2 * k + 1]
        diagonal += damping * np.median(diagonal)  # nothing fixes where the whole lies
        factor = cho_factor(held.T, overwrite_a=True, check_finite=False)
        step = cho_solve(factor, force, check_finite=False).reshape(2, k).T
        step *= min(1.0, FARTHEST_STEP_M / max(float(np.abs(step).max()), 1e-12))
        tried = stress.at(plane - step)
        if tried[0] >= cost:
            damping *= 10.0
            continue
        gained = cost - tried[0]
        plane, damping = plane - step, max(damping / 3.0, LEAST_DAMPING)
        cost, system, force = tried
        if gained < RELAXED * cost:
            break
    settled: Float = plane - plane.mean(0) + centre
    return settled


class _Stress:
    """What settle makes small without spreading: a robust stress, one-sided for most pairs."""

    def __init__(self, bound: Float, near: Bool) -> None:
        self._bound, self._near = bound, near
        safe, self._base = _weights(bound)
        self._gives = CREASING[-1] * safe  # how far a near pair falls short that gives way

    def at(self, plane: Float) -> tuple[float, Float, Float]:
        """Of a (k, 2) plane: the stress, its (2k, 2k) curvature as of Gauss-Newton, its slope.

        The slope is of shape (2k,); in both all u come before all v.
        """
        k = len(plane)
        x, y = plane.T
        flat = np.maximum(_pairwise(plane), 1e-6)
        u, v = (x[:, None] - x) / flat, (y[:, None] - y) / flat
        off = flat - self._bound
        over = off > 0
        share = (off / self._gives) ** 2
        gone = np.where(over, off**2, np.where(self._near, self._gives**2 * np.log1p(share), 0.0))
        cost = float((self._base * gone).sum())
        weight = self._base * np.where(over, 1.0, np.where(self._near, 1.0 / (1.0 + share), 0.0))
        pull = weight * off
        slope = np.r_[(pull * u).sum(1), (pull * v).sum(1)]
        system = np.empty((2 * k, 2 * k))
        for first, one in ((0, u), (k, v)):
            for second, other in ((0, u), (k, v)):
                block = -weight * one * other
                block.ravel()[:: k + 1] -= block.sum(1)
                system[first : first + k, second : second + k] = block
        return cost, system, slope


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


class _Majorisation:
    """Steps of stress majorisation (de Leeuw 1977) towards bounds.

    Its arrays of all pairs are made once: asking for such memory takes as long as filling it.
    """

    def __init__(self, bound: Float, near: Bool) -> None:
        safe, self._base = _weights(bound)
        self._bound = bound
        self._stay = STAY * self._base  # of its present distance
        self._near = np.flatnonzero(near)
        self._near_bound, self._near_safe = bound.ravel()[self._near], safe.ravel()[self._near]
        self._near_base = self._base.ravel()[self._near]
        self._flat, self._target, self._weight, self._system, self._short = (
            np.empty(bound.shape) for _ in range(5)
        )
        self._spread = np.nan

    def step(self, plane: Float, spread: float, slack: float) -> Float:
        """Three steps under weights taken from the residuals.

        Parameters
        ----------
        plane : ndarray of shape (k, 2)
        spread : float
            Weight of pairs that fall short.
        slack : float
            How far a near pair falls short where it weighs half, as a share of its distance.
        """
        k = len(plane)
        if spread != self._spread:
            self._spread = spread
            np.multiply(self._base, spread, out=self._short)
        flat = self._pairwise(plane)
        weight, target, system = self._weight, self._target, self._system
        np.copyto(weight, self._base)
        np.copyto(weight, self._short, where=self._bound > flat)
        weight.ravel()[self._near] = self._near_weight(flat, spread, slack)
        flat *= self._stay  # a pair without any say stays where it is
        np.multiply(weight, self._bound, out=target)
        target += flat
        weight += self._stay
        np.subtract(1 / k, weight, out=system)  # 1/k: fixes the centroid
        system.ravel()[:: k + 1] += weight.sum(1)
        # it is symmetric; the order of its transpose is LAPACK's, which then needs no copy
        factor = cho_factor(system.T, overwrite_a=True, check_finite=False)
        for _ in range(3):
            ratio = self._pairwise(plane)
            np.maximum(ratio, 1e-9, out=ratio)
            np.divide(target, ratio, out=ratio)
            force = ratio.sum(1)[:, None] * plane - ratio @ plane
            plane = cho_solve(factor, force, overwrite_b=True, check_finite=False)
        return plane

    def _near_weight(self, flat: Float, spread: float, slack: float) -> Float:
        """Of the near pairs: the less, down to `spread`, the more they fall short."""
        weight = np.maximum(self._near_bound - flat.ravel()[self._near], 0.0)
        weight /= slack * self._near_safe
        weight *= weight
        weight += 1.0
        np.maximum(np.divide(1.0, weight, out=weight), spread, out=weight)
        weight *= self._near_base
        return weight

    def _pairwise(self, plane: Float) -> Float:
        return _pairwise(plane, self._flat, self._weight)


def _weights(bound: Float) -> tuple[Float, Float]:
    """Bounds, with 1 where there is none, and the weights of the pairs; (k, k) each."""
    safe = np.where(bound > 0, bound, 1.0)
    return safe, (bound > 0) / safe**1.5


def _pairwise(plane: Float, apart: Float | None = None, across: Float | None = None) -> Float:
    """Distances, written to `apart`; `across` is overwritten."""
    x, y = plane.T
    apart = np.subtract(x[:, None], x, out=apart)
    apart *= apart
    across = np.subtract(y[:, None], y, out=across)
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
    uv, misfit = np.full((len(around), 2), np.nan), np.full(len(around), np.inf)
    rows = np.flatnonzero(np.isfinite(around_m).sum(1) >= 3)
    for start in range(0, len(rows), BLOCK):
        some = rows[start : start + BLOCK]
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
    misfit = np.sqrt((base * excess.clip(0) ** 2).sum(0) / total)
    return np.column_stack([u, v]), misfit


def orientation(uv: Float, xyz: Float, normal: Float, a: Int, b: Int) -> Float:
    """Which way up each sample lies: 1 with its outside up, -1 with its outside down, 0 unclear.

    From the links (a, b) around a sample: whether their directions turn the same way in the plane
    as about its normal.
    """
    placed = np.isfinite(uv).all(1)
    both = placed[a] & placed[b]
    start, end = np.r_[a[both], b[both]], np.r_[b[both], a[both]]
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
