"""Places loose pieces of a flattened item beside its main piece, as a category's outline has them.

A hidden fold cuts the observed surface apart: how far the cloth turns in the fold is not seen. What
is known of a loose piece: laid flat, the fold opens about its tip; the piece does not overlap the
others; it lies inside the item's outline, with its own ends on that outline. The outline is the
category's. It
and the places of the pieces are found in turns, for the likeliest categories; the best explanation
wins. Sizes that rest on a placed piece have its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vflatten_ros.core.config import AssemblyConfig, Config, ContourConfig
from vflatten_ros.core.contour import trace_outline
from vflatten_ros.core.evidence import Evidence, evidence_from, robust_mean, seen_beside
from vflatten_ros.core.partial_match import matches
from vflatten_ros.core.template_fit import linearise, place, refine
from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import (
    FlatPiece,
    FlatPoints,
    FlatSurface,
    Flattened,
    Float,
    Notice,
    Progress,
    no_progress,
)

MOST = 100  # points of a piece's ends, and of its inside, that are judged
CELL_M = 0.004  # of the images that judge a place
COARSE = (12.0, 9.0)
MOST_FITS = 8  # fits of a category that are refined
STIFF = 0.05  # of the swing that is allowed where paths along the cloth are uncertain
NEAR_M = 0.02  # beyond the main piece's outline
CUTS = (6.0, 5.0, 4.0, 3.0, 3.0, 3.0)  # of the fits of the outline, in sigmas
USUALLY_HIDDEN, HIDDEN_SPREAD = 0.15, 0.15  # share of an item that two well-chosen views leave out
POLISH = 6.0  # logarithm of odds against a solution that better places of the pieces may turn
ALMOST, OTHERWISE = 0.05, 0.03  # odds of another solution, and what of a size, that are told
FINEST_M = 0.001  # steps of the last search for the places of pieces
HALF_PIXEL_M = 0.00125  # cloth reaches beyond the centres of its outermost pixels


@dataclass(frozen=True, eq=False)
class Assembly:
    """All pieces as one category has them."""

    template: Template
    pose: Float  # (3,) of the template, see template_fit
    state: Float  # (m,)
    evidence: Evidence  # the ends of all pieces
    flattened: Flattened  # in one piece
    chance: float  # logarithm, up to a constant that all categories share
    placing: Float | None = None  # (3 + m, 3 + m) covariance that the pieces' places bring


@dataclass(frozen=True, eq=False)
class _Ends:
    """Points of a piece's outline that may be ends of the item, in the piece's plane."""

    uv: Float  # (n, 2)
    normal: Float  # (n, 2) outward
    spacing_m: float  # of the points


@dataclass(frozen=True, eq=False)
class _Hinges:
    """Places where a loose piece may be joined to the main one."""

    there: Float  # (h, 2) in the main piece's plane
    here: Float  # (h, 2) in its own
    sigma_m: float


@dataclass(frozen=True, eq=False)
class _Turn:
    """A rigid motion in the plane: uv -> R(angle) (uv - moving) + fixed."""

    angle: float
    fixed: Float  # (2,)
    moving: Float  # (2,)

    def __call__(self, uv: Float) -> Float:
        return self.direction(uv - self.moving) + self.fixed

    def by(self, step: Float) -> _Turn:
        """Turned by an angle about the middle of the motion, and shifted."""
        return _Turn(self.angle + step[0], self.fixed + step[1:], self.moving)

    def direction(self, vector: Float) -> Float:
        """Turn directions."""
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        out: Float = vector @ np.array([[cos, sin], [-sin, cos]])
        return out


@dataclass(frozen=True, eq=False)
class _Images:
    """Distance images by which a place is judged."""

    low: Float  # (2,)
    signed: Float  # distance to the category's outline, inside negative, m
    taken: Float  # depth inside the pieces already placed, m, 0 outside


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What all categories need to know of the pieces."""

    flattened: Flattened
    main: Evidence  # of the main piece
    ends: tuple[_Ends, ...]
    inner: tuple[Float, ...]
    whole_inner: Float  # of the main piece, in order to know its extent
    hinges: tuple[_Hinges, ...]  # of each loose piece


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A category's outline, fitted to the main piece."""

    template: Template
    pose: Float
    state: Float
    energy: float


@dataclass(frozen=True, eq=False)
class _Trial:
    """A category's outline and the places of the pieces, on the way to an assembly."""

    template: Template
    pose: Float
    state: Float
    turns: tuple[_Turn, ...]
    placed: tuple[FlatPiece, ...]
    cost: float  # of the places, beside what the outline's fit says
    energy: float  # of the outline's fit


def assemble(
    flattened: Flattened,
    templates: Sequence[Template],
    config: Config,
    progress: Progress = no_progress,
) -> list[Assembly]:
    """Place the loose pieces as categories have them and fit these to all pieces, in turns.

    Parameters
    ----------
    flattened : Flattened
        With its pieces; the main one, which is the first, stays where it is.
    templates : sequence of Template
    config : Config
    progress : Progress

    Returns
    -------
    list of Assembly
        For the likeliest categories, best first.
    """
    prepared = _prepare(flattened, config)
    fits = []
    for done, template in enumerate(map(_stiff, templates)):
        progress("recognition", 0.4 * done / len(templates))
        fits += _first_fits(prepared, template, config)
    least = min(fit.energy for fit in fits)
    trials = []
    for done, fit in enumerate(f for f in fits if f.energy < least + config.assembly.hopeless):
        progress("recognition", 0.4 + 0.2 * done / len(fits))
        trial = _trial(prepared, fit.template, fit.pose, fit.state, config)
        trials.append(_alternate(prepared, trial, config, 1))
    likely = _likely(trials, config.assembly)
    found = []
    for done, trial in enumerate(likely):
        progress("recognition", 0.6 + 0.2 * done / len(likely))
        trial = _alternate(prepared, trial, config, config.assembly.alternations - 1)
        found.append((_finished(prepared, trial, config), trial))
    most = max(assembly.chance for assembly, _ in found)
    for k, (assembly, trial) in enumerate(found):  # in fairness to all that may win
        if assembly.chance > most - POLISH:
            progress("recognition", 0.8 + 0.2 * k / len(found))
            trial = _polished(prepared, trial, config)
            found[k] = (_finished(prepared, trial, config), trial)
    found.sort(key=lambda pair: -pair[0].chance)
    best, trial = found[0]
    ways = [assembly for assembly, _ in found if assembly.template.category == _name(best)]
    best = replace(best, placing=_placing(prepared, trial, config))
    others = {_name(assembly): assembly for assembly, _ in reversed(found)}
    others.pop(_name(best))
    rest = sorted(others.values(), key=lambda assembly: -assembly.chance)
    return [undecided(best, ways[1:]), *rest]


def _name(assembly: Assembly) -> str:
    return assembly.template.category


def undecided(best: Assembly, others: Sequence[Assembly]) -> Assembly:
    """The best of a category's ways to fit: uncertain as far as others, of other sizes, are likely.

    Others of the same sizes are the same item, turned as its category's symmetry allows.
    """
    others = [other for other in others if _differing(best, other)]
    if not others or best.placing is None:
        return best
    odds = np.exp([0.0, *(other.chance - best.chance for other in others)])
    share = odds[1:] / odds.sum()
    off = np.array([np.r_[o.pose, o.state] - np.r_[best.pose, best.state] for o in others])
    off[:, 0] = np.angle(np.exp(1j * off[:, 0]))
    placing = best.placing + np.einsum("k,ki,kj->ij", share, off, off)
    flattened, most = best.flattened, int(share.argmax())
    if share[most] > ALMOST:
        told = _differing(best, others[most])
        text = f"the item may also lie otherwise, at odds of {100 * share[most]:.0f} %: {told}"
        notice = Notice("solution_uncertain", text)
        flattened = replace(flattened, notices=(*flattened.notices, notice))
    return replace(best, placing=placing, flattened=flattened)


def _differing(best: Assembly, other: Assembly) -> str:
    """Width and length of another assembly, where they are others."""
    nothing = np.zeros((len(best.state), len(best.state)))
    here, there = (a.template.measure(a.state, nothing) for a in (best, other))
    return ", ".join(
        f"{name} {there[name][0]:.3f} instead of {here[name][0]:.3f} m"
        for name in ("width", "length")
        if abs(there[name][0] / here[name][0] - 1.0) > OTHERWISE
    )


def _likely(trials: Sequence[_Trial], config: AssemblyConfig) -> list[_Trial]:
    """The likeliest trials: a few categories, each in the ways that its outline may fit."""
    ways: list[_Trial] = []
    categories: set[str] = set()
    ordered = sorted(trials, key=_misfit)
    for trial in ordered:
        name = trial.template.category
        worst = _misfit(ordered[0]) + (config.hopeless if name not in categories else POLISH)
        if _misfit(trial) < worst and (name in categories or len(categories) < config.categories):
            categories.add(name)
            ways.append(trial)
    return ways


def _misfit(trial: _Trial) -> float:
    return trial.energy + trial.cost


def _stiff(template: Template) -> Template:
    """Parts of one piece of cloth are not turned against one another: that would be stress."""
    return replace(template, swing=STIFF * template.swing)


def _first_fits(prepared: _Prepared, template: Template, config: Config) -> list[_Fitted]:
    """Poses and cuts of an outline of which the main piece may be a part only."""
    still = _Turn(0.0, np.zeros(2), np.zeros(2))
    evidence = _ends_evidence(prepared, prepared.main, (still,), config)
    pose, state = matches(template, prepared.ends[0].uv, prepared.whole_inner, MOST_FITS)
    for cuts in (COARSE, CUTS):  # the worse half is dropped on the way
        pose, state, energy = refine(template, evidence, pose, state, cuts)
        first = np.argsort(energy, kind="stable")[: MOST_FITS // 2]
        pose, state, energy = pose[first], state[first], energy[first]
    return [_Fitted(template, pose[k], state[k], float(energy[k])) for k in _distinct(pose, energy)]


def _distinct(pose: Float, energy: Float) -> list[int]:
    """The best of each group of alike poses, two at most."""
    chosen: list[int] = []
    for k in np.argsort(energy, kind="stable"):
        off = [
            np.abs(np.r_[np.sin(0.5 * (pose[k, 0] - pose[c, 0])), pose[k, 1:] - pose[c, 1:]])
            for c in chosen
        ]
        if all(o.max() > 0.05 for o in off):
            chosen.append(int(k))
    return chosen[:2]


def _prepare(flattened: Flattened, config: Config) -> _Prepared:
    main, *loose = flattened.pieces
    return _Prepared(
        flattened,
        _near(evidence_from(flattened.outline, flattened.points, config.recognition)),
        tuple(_ends(piece, config.contour) for piece in flattened.pieces),
        tuple(_thin(piece.surface.uv) for piece in flattened.pieces),
        main.surface.uv[:: max(1, len(main.surface.uv) // 3000)],
        tuple(_hinges(main.surface, piece.surface, config.assembly) for piece in loose),
    )


def _near(main: Evidence) -> Evidence:
    """Evidence of the main piece; it says nothing of what is farther off, where others come."""
    return replace(main, seen=np.where(main.distance < NEAR_M, main.seen, 0.0))


def _trial(
    prepared: _Prepared,
    template: Template,
    pose: Float,
    state: Float,
    config: Config,
    before: Sequence[_Turn] = (),
) -> _Trial:
    """Place the pieces under an outline: anywhere, or near where they were."""
    main, *loose = prepared.flattened.pieces
    outline = place(template, pose, state)[0][: template.vertices]
    turns, placed, cost = [_Turn(0.0, np.zeros(2), np.zeros(2))], [main], 0.0
    for k, piece in enumerate(loose, start=1):
        images = _images(placed, outline, piece)
        hinges = prepared.hinges[k - 1]
        first = before[k] if before else None
        turn, misfit = _best_turn(
            images, prepared.ends[k].uv, prepared.inner[k], hinges, first, config.assembly
        )
        turns.append(turn)
        placed.append(_moved(piece, turn, config.assembly))
        cost += misfit
    return _Trial(template, pose, state, tuple(turns), tuple(placed), cost, np.inf)


def _alternate(prepared: _Prepared, trial: _Trial, config: Config, times: int) -> _Trial:
    """Fit the outline to the placed pieces, and place them again."""
    for _ in range(times):
        evidence = _ends_evidence(prepared, prepared.main, trial.turns, config)
        template = trial.template
        poses, states, energy = refine(
            template, evidence, trial.pose[None], trial.state[None], CUTS
        )
        trial = _trial(prepared, template, poses[0], states[0], config, trial.turns)
        trial = replace(trial, energy=float(energy[0]))
    return trial


def _polished(prepared: _Prepared, trial: _Trial, config: Config) -> _Trial:
    """Places and outline together: every place is judged with the outline that fits it best."""
    main, *loose = prepared.flattened.pieces
    for k, piece in enumerate(loose, start=1):
        images = _images(
            [p for n, p in enumerate(trial.placed) if n != k], main.surface.uv[:3], piece
        )
        step, moves = np.array([0.04, 0.006, 0.006]), list(np.vstack([np.eye(3), -np.eye(3)]))
        best = _joint_energy(prepared, trial, k, trial.turns[k], images, config)
        while step[1] > FINEST_M:
            for n, move in enumerate(moves):
                turn = best.turns[k].by(move * step)
                tried = _joint_energy(prepared, best, k, turn, images, config)
                if _misfit(tried) < _misfit(best) - 1e-6:
                    best = tried
                    moves.insert(0, moves.pop(n))  # what helped is tried first the next time
                    break
            else:
                step = step / 2
        trial = best
        placed = [
            *trial.placed[:k],
            _moved(piece, trial.turns[k], config.assembly),
            *trial.placed[k + 1 :],
        ]
        trial = replace(trial, placed=tuple(placed))
    return trial


def _placing(prepared: _Prepared, trial: _Trial, config: Config) -> Float:
    """Covariance of pose and cut, as the places of the loose pieces are uncertain."""
    turn, shift = config.assembly.turn_rad, config.assembly.shift_m
    start = np.r_[trial.pose, trial.state]
    total = np.zeros((len(start), len(start)))
    for k in range(1, len(trial.turns)):
        for step in np.diag([turn, shift, shift]):
            moved = []
            for way in (step, -step):
                turns = (*trial.turns[:k], trial.turns[k].by(way), *trial.turns[k + 1 :])
                evidence = _ends_evidence(prepared, prepared.main, turns, config)
                pose, state, _ = refine(
                    trial.template, evidence, trial.pose[None], trial.state[None], CUTS[-3:]
                )
                moved.append(np.r_[pose[0], state[0]])
            slope = 0.5 * (moved[0] - moved[1])
            total += np.outer(slope, slope)
    return total


def _joint_energy(
    prepared: _Prepared,
    trial: _Trial,
    k: int,
    turn: _Turn,
    images: _Images,
    config: Config,
) -> _Trial:
    """The trial with piece k elsewhere, and the outline fitted to that."""
    turns = (*trial.turns[:k], turn, *trial.turns[k + 1 :])
    evidence = _ends_evidence(prepared, prepared.main, turns, config)
    pose, state, energy = refine(
        trial.template, evidence, trial.pose[None], trial.state[None], CUTS[-2:]
    )
    hinges = prepared.hinges[k - 1]
    off = np.linalg.norm(turn(hinges.here) - hinges.there, axis=1).min() / hinges.sigma_m
    place_ = np.r_[turn.angle, turn.fixed, turn.moving][None]
    beside = _costs(
        images,
        prepared.ends[k].uv,
        prepared.inner[k],
        place_,
        np.array([[off, 0.0]]),
        config.assembly,
    )
    return replace(
        trial,
        pose=pose[0],
        state=state[0],
        turns=turns,
        energy=float(energy[0]),
        cost=float(beside[1, 0]),
    )


def _finished(prepared: _Prepared, trial: _Trial, config: Config) -> Assembly:
    """The whole item, and how likely the category is with it."""
    template = trial.template
    union = united(trial.placed)
    outline = trace_outline(union.surface, config.assembly.sigma_m, HALF_PIXEL_M, config.contour)
    whole = replace(
        prepared.flattened,
        points=union.points,
        start_uv=union.start_uv,
        pieces=(union,),
        outline=outline,
    )
    evidence = evidence_from(outline, union.points, config.recognition)
    evidence = _ends_evidence(prepared, evidence, trial.turns, config)
    pose, state, energy = refine(template, evidence, trial.pose[None], trial.state[None], CUTS)
    hessian = linearise(template, evidence, pose, state, CUTS[-1]).hessian[0]
    prior = np.diag(np.r_[1e-6, 1e-6, 1e-6, np.ones(template.dimensions)])
    occam = 0.5 * float(np.linalg.slogdet(hessian + prior)[1])
    hidden = _hidden_share(
        place(template, pose[0], state[0])[0][: template.vertices], union.surface
    )
    cost = trial.cost + 0.5 * (max(hidden - USUALLY_HIDDEN, 0.0) / HIDDEN_SPREAD) ** 2
    chance = -float(energy[0]) - occam - cost
    return Assembly(template, pose[0], state[0], evidence, whole, chance)


def _hidden_share(outline: Float, surface: FlatSurface) -> float:
    """Share of a category's outline that no view shows: the views are chosen to show the item."""
    low = outline.min(axis=0)
    cols, rows = np.ceil((outline.max(axis=0) - low) / CELL_M).astype(int) + 2
    body = np.zeros((rows, cols), np.uint8)
    cv2.fillPoly(body, [np.rint((outline - low) / CELL_M).astype(np.int32)], (1,))
    at = np.rint((surface.uv - low) / CELL_M).astype(int)
    col, row = at[((at >= 0) & (at < [cols, rows])).all(axis=1)].T
    seen = np.zeros((rows, cols), np.uint8)
    seen[row, col] = 1
    seen = cv2.morphologyEx(seen, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)).astype(np.uint8)
    return 1.0 - float((seen & body).sum()) / max(float(body.sum()), 1.0)


def _ends_evidence(
    prepared: _Prepared, union: Evidence, turns: Sequence[_Turn], config: Config
) -> Evidence:
    """What the fit of an outline rests on: ends of every piece, even where they face another."""
    ends, recognition = prepared.ends[: len(turns)], config.recognition
    uv = np.vstack([turn(e.uv) for turn, e in zip(turns, ends, strict=True)])
    normal = np.vstack([turn.direction(e.normal) for turn, e in zip(turns, ends, strict=True)])
    sigma = [
        np.full(len(e.uv), 0.002 if k == 0 else config.assembly.sigma_m) for k, e in enumerate(ends)
    ]
    inner = np.vstack([turn(points) for turn, points in zip(turns, prepared.inner, strict=False)])
    return replace(
        union,
        outline=uv,
        normal=normal,
        sigma=np.hypot(np.concatenate(sigma), recognition.misfit_m),
        weight=np.concatenate([np.full(len(e.uv), union.density * e.spacing_m) for e in ends]),
        inner=inner,
        inner_sigma=np.full(len(inner), np.hypot(config.assembly.sigma_m, recognition.misfit_m)),
        inner_weight=np.full(len(inner), 0.5 * prepared.main.total / len(inner)),
        seen=seen_beside(union, uv),
    )


def _best_turn(
    images: _Images,
    ends: Float,
    inner: Float,
    hinges: _Hinges,
    first: _Turn | None,
    config: AssemblyConfig,
) -> tuple[_Turn, float]:
    """Best of all hinges and rotations, or of those near the first, and its cost but the ends'."""
    spread = np.pi / config.rotations
    if first is None:
        angle = np.arange(config.rotations) * 2.0 * spread
        pairs = zip(hinges.there, hinges.here, strict=True)
        trials = np.array([(a, *p, *q) for p, q in pairs for a in angle])
    else:
        trials = np.array(
            [(first.angle, *p, *q) for p, q in zip(hinges.there, hinges.here, strict=True)]
        )
    costs = _costs(images, ends, inner, trials, np.zeros((len(trials), 2)), config).sum(axis=0)
    best = int(costs.argmin())
    cost, turn, shift = costs[best], trials[best], np.zeros(2)
    step = np.array([spread, 0.02, 0.02])
    ways = np.vstack([np.eye(3), -np.eye(3)])
    while step[1] > 0.001:
        moves = ways * step
        trials = np.column_stack([turn[:3] + moves, np.tile(turn[3:], (6, 1))])
        off = (shift + moves[:, 1:]) / hinges.sigma_m
        costs = _costs(images, ends, inner, trials, off, config).sum(axis=0)
        best = int(costs.argmin())
        if costs[best] < cost - 1e-9:
            cost, turn, shift = costs[best], trials[best], shift + moves[best, 1:]
        else:
            step = step / 2
    beside = _costs(images, ends, inner, turn[None], shift[None] / hinges.sigma_m, config)[1, 0]
    return _Turn(float(turn[0]), turn[1:3], turn[3:]), float(beside)


def _costs(
    images: _Images, ends: Float, inner: Float, trials: Float, shift: Float, config: AssemblyConfig
) -> Float:
    """Misfits of (t, 5) trials (angle, fixed, moving), shifted from their hinges by (t, 2) sigmas.

    Returns
    -------
    ndarray of shape (2, t)
        To the outline (ends off it, cloth outside), and beside it (cloth on cloth, parted hinge).
    """
    sigma = config.misfit_m
    inside = _all_turned(trials, inner)
    off = _look_up(images, images.signed, _all_turned(trials, ends)) / sigma
    out = np.maximum(_look_up(images, images.signed, inside), 0.0) / sigma
    over = np.maximum(_look_up(images, images.taken, inside) - config.overlap_m, 0.0) / sigma
    fit = config.end_weight * robust_mean(off, 3.0) + config.inner_weight * robust_mean(out, 3.0)
    beside = config.overlap_weight * robust_mean(over, 6.0)
    return np.stack([fit, beside + 0.5 * (shift**2).sum(axis=1)])


def _all_turned(trials: Float, uv: Float) -> Float:
    """(t, n, 2) places of (n, 2) points under (t, 5) trials."""
    angle, fixed, moving = trials[:, 0], trials[:, 1:3], trials[:, 3:]
    arm = (uv[None] - moving[:, None]) @ np.array([1.0, 1j]) * np.exp(1j * angle)[:, None]
    result: Float = np.stack([arm.real, arm.imag], axis=-1) + fixed[:, None]
    return result


def _look_up(images: _Images, image: Float, uv: Float) -> Float:
    at = np.rint((uv - images.low) / CELL_M).astype(np.int64)
    rows, cols = image.shape
    out: Float = image[np.clip(at[..., 1], 0, rows - 1), np.clip(at[..., 0], 0, cols - 1)]
    return out


def _images(placed: Sequence[FlatPiece], outline: Float, piece: FlatPiece) -> _Images:
    taken = np.vstack([p.surface.uv for p in placed])
    reach = float(np.linalg.norm(np.ptp(piece.surface.uv, axis=0)))
    low = np.minimum(outline.min(axis=0), taken.min(axis=0)) - reach
    high = np.maximum(outline.max(axis=0), taken.max(axis=0)) + reach
    cols, rows = np.ceil((high - low) / CELL_M).astype(int) + 1
    body, free = np.zeros((rows, cols), np.uint8), np.ones((rows, cols), np.uint8)
    cv2.fillPoly(body, [np.rint((outline - low) / CELL_M).astype(np.int32)], (1,))
    col, row = np.rint((taken - low) / CELL_M).astype(int).T
    free[row, col] = 0
    free = cv2.morphologyEx(free, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)).astype(np.uint8)

    def depth(image: NDArray[np.uint8]) -> Float:
        result: Float = (
            cv2.distanceTransform(image, cv2.DIST_L2, cv2.DIST_MASK_5).astype(np.float64) * CELL_M
        )
        return result

    one = np.uint8(1)
    return _Images(low, depth(one - body) - depth(body), depth(one - free))


def _hinges(main: FlatSurface, piece: FlatSurface, config: AssemblyConfig) -> _Hinges:
    """Points about which the loose piece may be turned: the same point in both pieces' planes.

    Where the pieces hang edge to edge, a fold between them is closed. Laid flat it opens about its
    tip, which lies on the line along which they touch. The piece hangs from there, so the tip is as
    high as the piece's upper end, or lower as far as the touching is seen.
    """
    distance, near = cKDTree(main.xyz_hanger).query(piece.xyz_hanger)
    if distance.min() < config.joined_m:  # neighbouring pixels: this is the tip
        k = int(distance.argmin())
        return _Hinges(main.uv[near[[k]]], piece.uv[[k]], config.joined_m)
    touching = np.flatnonzero(distance < distance.min() + config.touch_m)
    p, q = main.uv[near[touching]], piece.uv[touching]
    height = piece.xyz_hanger[touching, 2]
    rise = height - height.mean()
    top, highest = int(height.argmax()), float(piece.xyz_hanger[:, 2].max())
    turn, shift = _rigid(p, q)
    along = (
        rise @ (p - p.mean(axis=0)) / max(float(rise @ rise), 1e-12)
    )  # change of place with height
    if np.ptp(height) < 2 * config.touch_m or len(touching) < 10:
        along = np.zeros(2)
    up = np.linspace(0.0, highest + config.touch_m - height[top], config.hinges)
    there = p[top] + up[:, None] * along * min(1.0, 2.0 / max(float(np.linalg.norm(along)), 1e-9))
    return _Hinges(there, (there - shift) @ turn, config.hinge_m)


def _rigid(p: Float, q: Float) -> tuple[Float, Float]:
    """Rotation and shift with p = rotation @ q + shift, robust."""
    a, b = p @ np.array([1.0, 1j]), q @ np.array([1.0, 1j])
    weight = np.ones(len(a))
    turn, shift = 1.0 + 0j, 0j
    for _ in range(6):
        mean_a, mean_b = (weight @ a) / weight.sum(), (weight @ b) / weight.sum()
        turn = (weight * (a - mean_a) * np.conj(b - mean_b)).sum() + 1e-12
        turn /= abs(turn)
        shift = mean_a - turn * mean_b
        weight = 1.0 / (1.0 + (np.abs(a - turn * b - shift) / 0.02) ** 2) ** 2
    rotation = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    return rotation, np.array([shift.real, shift.imag])


def _ends(piece: FlatPiece, contour: ContourConfig) -> _Ends:
    outline = trace_outline(piece.surface, 0.0, HALF_PIXEL_M, contour)
    uv = outline.uv
    along = np.roll(uv, -2, axis=0) - np.roll(uv, 2, axis=0)
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    keep = np.flatnonzero(~outline.inferred)
    keep = keep if len(keep) > 3 else np.arange(len(uv))
    some = keep[np.linspace(0, len(keep) - 1, min(len(keep), MOST)).astype(int)]
    return _Ends(uv[some], normal[some], contour.spacing_m * len(keep) / len(some))


def _thin(uv: Float) -> Float:
    result: Float = uv[np.linspace(0, len(uv) - 1, min(len(uv), MOST)).astype(int)]
    return result


def _moved(piece: FlatPiece, turn: _Turn, config: AssemblyConfig) -> FlatPiece:
    points = replace(
        piece.points,
        uv=turn(piece.points.uv),
        sigma_m=np.hypot(piece.points.sigma_m, config.sigma_m),
    )
    return FlatPiece(
        points, turn(piece.start_uv), replace(piece.surface, uv=turn(piece.surface.uv))
    )


def united(pieces: Sequence[FlatPiece]) -> FlatPiece:
    """Pieces in one plane as one."""
    points, surfaces = [p.points for p in pieces], [p.surface for p in pieces]
    shifts = np.cumsum([0, *(len(s.uv) for s in surfaces)])
    return FlatPiece(
        FlatPoints(
            np.vstack([p.uv for p in points]),
            np.vstack([p.xyz_hanger for p in points]),
            np.concatenate([p.view_id for p in points]),
            np.vstack([p.pixel for p in points]),
            np.concatenate([p.sigma_m for p in points]),
            np.concatenate([p.stress for p in points]),
            np.concatenate([p.inferred for p in points]),
        ),
        np.vstack([p.start_uv for p in pieces]),
        FlatSurface(
            np.vstack([s.uv for s in surfaces]),
            np.vstack([s.xyz_hanger for s in surfaces]),
            np.concatenate([s.edge for s in surfaces]),
            np.vstack([s.cells + shift for s, shift in zip(surfaces, shifts, strict=False)]),
        ),
    )
