"""Groups of pieces that nothing seen joins, placed as a category's outline has them.

Every group lies flat by itself, front and back. Its ends lie on the outline of the whole item, its
cloth inside, and not on cloth of the same side. The category's outline is fitted to the largest
group, the others are tried all over it, either way up, and the outline is fitted to all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.config import AssemblyConfig, Config
from vflatten_ros.core.evidence import Evidence, evidence_from, robust_mean, seen_beside
from vflatten_ros.core.partial_match import matches
from vflatten_ros.core.puzzle import Complex, Motion
from vflatten_ros.core.template_fit import place, refine
from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import FlatPoints, Float, Int, Outline, Progress, no_progress

MOST = 120  # ends of a group, and points inside, that are judged
CELL_M = 0.004  # of the images that judge a place
COARSE, CUTS = (12.0, 9.0), (6.0, 5.0, 4.0, 3.0, 3.0, 3.0)  # of the fits of the outline, in sigmas
MOST_FITS, KEPT, WAYS = 8, 4, 2  # of a category: tried, refined, kept
PLACES = 6  # of a group, either way up, that are looked at
SEARCHED = 6  # of all of them, best first, round which better ones are searched
STIFF = 0.05  # of the swing that is allowed: the groups are rigid
NEAR_M = 0.02  # beyond the main group's outline
END_SIGMA_M = 0.002
STEPS = np.array([np.radians(8.0), 0.02, 0.02])  # of the search round a place: turn, shift
FINEST = 16.0  # how much smaller they become
WORTH_PLACING = 8.0  # cost of the largest group alone beyond the least of all groups, up to which
# the others are placed beside it: e^-8 is less than any odds that are looked at
WORTH_A_TURN = 4.0  # cost beyond the least, up to which a category is fitted and placed again


@dataclass(frozen=True, eq=False)
class Group:
    """Cloth that lies flat in one piece; its place beside others is not known."""

    points: FlatPoints
    side: Float  # (n,) 1 outside up, -1 outside down
    outline: Outline  # inferred where cloth goes on unseen


@dataclass(frozen=True, eq=False)
class Placing:
    """All groups as one category has them."""

    template: Template
    pose: Float  # (3,)
    state: Float  # (m,)
    motions: tuple[Motion, ...]  # of the groups; the first stays where it is. None: not placed
    energy: float  # of the fit of the outline, in halves of squared sigmas; if not placed, at least
    beside: float = 0.0  # cloth upon cloth of its own side, alike

    @property
    def cost(self) -> float:
        """Of both."""
        return self.energy + self.beside


@dataclass(frozen=True, eq=False)
class _Shape:
    """What of a group is judged."""

    ends: Complex  # (e,)
    normal: Complex  # (e,) outward
    spacing_m: float  # of the ends
    inner: Complex  # (i,)
    up: Float  # (i,)
    cloth: tuple[Complex, Complex]  # all points with the outside up, and down


@dataclass(frozen=True, eq=False)
class _Images:
    """Images by which places are judged."""

    low: Float  # (2,)
    signed: Float  # distance to the category's outline, inside negative, m
    taken: tuple[Float, Float]  # depth in what lies there outside up, and down, m

    def cells(self, uv: Float) -> Int:
        """(...) numbers of the cells at (..., 2) places, or nearest to them."""
        rows, cols = self.signed.shape
        at = np.rint((uv - self.low) / CELL_M).astype(np.int64)
        cell: Int = at[..., 1].clip(0, rows - 1) * cols + at[..., 0].clip(0, cols - 1)
        return cell


STAYS = Motion(False, 1.0, 0.0)


def place_groups(
    groups: Sequence[Group],
    templates: Sequence[Template],
    config: Config,
    progress: Progress = no_progress,
) -> list[Placing]:
    """Place groups as the categories have them, the likeliest category first.

    Parameters
    ----------
    groups : sequence of Group
        Largest first.
    templates : sequence of Template
    config : Config
    progress : Progress

    Returns
    -------
    list of Placing
        One for each category that the largest group may belong to. Those that it rules out against
        the best one have no motions, and a cost that is at least WORTH_PLACING more.
    """
    shapes = [_shape(group) for group in groups]
    main = evidence_from(groups[0].outline, groups[0].points, config.recognition)
    main = replace(main, seen=np.where(main.distance < NEAR_M, main.seen, 0.0))
    alone = _evidence(main, shapes[:1], [STAYS], config)
    fits: list[tuple[float, Template, Float, Float]] = []
    for done, template in enumerate(templates):
        progress("place", 0.4 * done / len(templates))
        stiff = replace(template, swing=STIFF * template.swing)
        for pose, state, energy in _first_fits(stiff, shapes[0], alone):
            fits.append((energy, stiff, pose, state))
    # each later one: cloth placed beside it makes no fit better, so most need not be placed
    fits.sort(key=lambda fit: fit[0])
    likely = [fit for fit in fits if fit[0] < fits[0][0] + config.assembly.hopeless]
    first: list[Placing] = []
    least = np.inf
    for done, (energy, template, pose, state) in enumerate(likely):
        progress("place", 0.4 + 0.4 * done / len(likely))
        placing = Placing(template, pose, state, (), energy)
        if energy < least + WORTH_PLACING:
            placing = _fitted(_placed(placing, shapes, config), shapes, main, config)
            least = min(least, placing.cost)
        first.append(placing)
    found: dict[str, Placing] = {}
    for placing in sorted(first, key=lambda placing: placing.cost):
        found.setdefault(placing.template.category, placing)
    for done, (category, placing) in enumerate(found.items()):
        progress("place", 0.8 + 0.2 * done / len(found))
        if placing.cost < least + WORTH_A_TURN:
            again = _fitted(_placed(placing, shapes, config), shapes, main, config)
            found[category] = _placed(again, shapes, config)
    return sorted(found.values(), key=lambda placing: placing.cost)


def _first_fits(
    template: Template, main: _Shape, evidence: Evidence
) -> list[tuple[Float, Float, float]]:
    """Poses and cuts of an outline of which the main group may be a part only."""
    inner = np.concatenate(main.cloth)
    pose, state = matches(template, _real(main.ends), _real(inner)[::8], MOST_FITS)
    for cuts in (COARSE, CUTS):
        pose, state, energy = refine(template, evidence, pose, state, cuts)
        first = np.argsort(energy, kind="stable")[:KEPT]
        pose, state, energy = pose[first], state[first], energy[first]
    kept: list[int] = []
    for k in range(len(pose)):
        off = [
            np.r_[np.sin((pose[k, 0] - pose[c, 0]) / 2), pose[k, 1:] - pose[c, 1:]] for c in kept
        ]
        if all(np.abs(o).max() > 0.05 for o in off):
            kept.append(k)
    return [(pose[k], state[k], float(energy[k])) for k in kept[:WAYS]]


def _placed(placing: Placing, shapes: Sequence[_Shape], config: Config) -> Placing:
    """Place the groups under the outline, near where they are if they are somewhere."""
    outline = place(placing.template, placing.pose, placing.state)[0][: placing.template.vertices]
    motions, beside = [STAYS], 0.0
    for k, shape in enumerate(shapes[1:], start=1):
        images = _images(shapes[:k], motions, outline, shape)
        if placing.motions:
            starts: Sequence[Motion] = [placing.motions[k]]
        else:
            starts = _candidates(placing.template, placing.pose, placing.state, shape)
        motion, overlap = _best(images, shape, starts, config.assembly)
        motions.append(motion)
        beside += overlap
    return replace(placing, motions=tuple(motions), beside=beside)


def _fitted(placing: Placing, shapes: Sequence[_Shape], main: Evidence, config: Config) -> Placing:
    """Fit the outline to the groups as they are placed."""
    evidence = _evidence(main, shapes, placing.motions, config)
    start = placing.pose[None], placing.state[None]
    poses, states, energies = refine(placing.template, evidence, *start, CUTS)
    return replace(placing, pose=poses[0], state=states[0], energy=float(energies[0]))


def _candidates(template: Template, pose: Float, state: Float, shape: _Shape) -> list[Motion]:
    """Places of a group where its ends lie on an outline, either way up."""
    found = []
    turn, shift = np.exp(1j * pose[0]), pose[1] + 1j * pose[2]
    for mirrored in (False, True):
        ends, inner = (z.conj() if mirrored else z for z in (shape.ends, shape.inner))
        poses, _ = matches(template, _real(ends), _real(inner), PLACES, state)
        for angle, u, v in poses:  # of the outline as the group has it
            back = turn * np.exp(-1j * angle)
            found.append(Motion(mirrored, complex(back), complex(shift - back * (u + 1j * v))))
    return found


def _best(
    images: _Images, shape: _Shape, starts: Sequence[Motion], config: AssemblyConfig
) -> tuple[Motion, float]:
    """Best place near any of the starts, and its cost beside the outline's: cloth upon cloth."""
    mirrored = np.array([m.mirrored for m in starts])
    turn, shift = np.array([m.turn for m in starts]), np.array([m.shift for m in starts])
    middle = shape.inner.mean()
    centre = turn * np.where(mirrored, np.conj(middle), middle) + shift
    where = np.column_stack([np.angle(turn), centre.real, centre.imag])
    cost = _costs(images, shape, mirrored, where, middle, config).sum(axis=0)
    first = np.argsort(cost, kind="stable")[:SEARCHED]
    mirrored, where, cost = mirrored[first], where[first], cost[first]
    scale = np.ones(len(where))
    ways = np.vstack([np.eye(3), -np.eye(3)]) * STEPS
    while scale.max() > 1 / FINEST:
        tried = where[:, None] + ways * scale[:, None, None]
        costs = _costs(
            images, shape, np.repeat(mirrored, len(ways)), tried.reshape(-1, 3), middle, config
        ).sum(axis=0)
        costs = costs.reshape(len(where), -1)
        best, rows = costs.argmin(axis=1), np.arange(len(where))
        better = costs[rows, best] < cost - 1e-9
        where = np.where(better[:, None], tried[rows, best], where)
        cost = np.where(better, costs[rows, best], cost)
        scale = np.where(better, scale, scale / 2)
    k = int(cost.argmin())
    beside = _costs(images, shape, mirrored[[k]], where[[k]], middle, config)[1, 0]
    turned = complex(np.exp(1j * where[k, 0]))
    arm = np.conj(middle) if mirrored[k] else middle
    motion = Motion(bool(mirrored[k]), turned, complex(where[k, 1:] @ [1, 1j] - turned * arm))
    return motion, float(beside)


def _costs(
    images: _Images,
    shape: _Shape,
    mirrored: NDArray[np.bool_],
    where: Float,
    middle: complex,
    config: AssemblyConfig,
) -> Float:
    """(2, t) misfits of (t, 3) places (turn, middle): to the outline, and cloth upon cloth."""
    turn, centre = np.exp(1j * where[:, 0])[:, None], (where[:, 1:] @ [1, 1j])[:, None]

    def moved(z: Complex) -> Float:
        arm = z - middle
        out = turn * np.where(mirrored[:, None], arm.conj(), arm) + centre
        return np.stack([out.real, out.imag], axis=-1)

    sigma = config.misfit_m
    inner = images.cells(moved(shape.inner))
    off = images.signed.take(images.cells(moved(shape.ends))) / sigma
    out = np.maximum(images.signed.take(inner), 0.0) / sigma
    up = np.where(mirrored[:, None], -shape.up, shape.up)
    depth = np.where(up > 0, images.taken[0].take(inner), images.taken[1].take(inner))
    over = np.maximum(depth - config.overlap_m, 0.0) * (up != 0) / sigma
    fit = config.end_weight * robust_mean(off, 3.0) + config.inner_weight * robust_mean(out, 3.0)
    return np.stack([fit, config.overlap_weight * robust_mean(over, 6.0)])


def _images(
    placed: Sequence[_Shape], motions: Sequence[Motion], outline: Float, shape: _Shape
) -> _Images:
    sides: list[list[Complex]] = [[], []]
    for one, motion in zip(placed, motions, strict=True):
        for k in (0, 1):
            sides[k ^ motion.mirrored].append(motion(one.cloth[k]))
    taken = [_real(np.concatenate(side)) for side in sides]
    reach = float(np.abs(shape.inner - shape.inner.mean()).max()) + 0.05
    everything = np.vstack([outline, *taken])
    low, high = everything.min(axis=0) - reach, everything.max(axis=0) + reach
    cols, rows = np.ceil((high - low) / CELL_M).astype(int) + 1
    body = np.zeros((rows, cols), np.uint8)
    cv2.fillPoly(body, [np.rint((outline - low) / CELL_M).astype(np.int32)], (1,))
    depths = []
    for uv in taken:
        cloth = np.zeros((rows, cols), np.uint8)
        col, row = np.rint((uv - low) / CELL_M).astype(int).T
        cloth[row, col] = 1
        closed = cv2.morphologyEx(cloth, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        depths.append(_depth(closed.astype(np.uint8)))
    outside = np.asarray(1 - body, dtype=np.uint8)
    return _Images(low, _depth(outside) - _depth(body), (depths[0], depths[1]))


def _depth(image: NDArray[np.uint8]) -> Float:
    away = cv2.distanceTransform(image.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    depth: Float = away.astype(np.float64) * CELL_M
    return depth


def _evidence(
    main: Evidence, shapes: Sequence[_Shape], motions: Sequence[Motion], config: Config
) -> Evidence:
    """What the fit of the outline rests on: the ends and the cloth of all groups as placed."""
    uv = _real(np.concatenate([m(s.ends) for s, m in zip(shapes, motions, strict=True)]))
    normal = _real(
        np.concatenate(
            [
                m.turn * (s.normal.conj() if m.mirrored else s.normal)
                for s, m in zip(shapes, motions, strict=True)
            ]
        )
    )
    inner = _real(np.concatenate([m(s.inner) for s, m in zip(shapes, motions, strict=True)]))
    sigma = [
        np.full(len(s.ends), END_SIGMA_M if k == 0 else config.assembly.sigma_m)
        for k, s in enumerate(shapes)
    ]
    weight = [np.full(len(s.ends), main.density * s.spacing_m) for s in shapes]
    misfit = config.recognition.misfit_m
    return replace(
        main,
        outline=uv,
        normal=normal,
        sigma=np.hypot(np.concatenate(sigma), misfit),
        weight=np.concatenate(weight),
        inner=inner,
        inner_sigma=np.full(len(inner), np.hypot(config.assembly.sigma_m, misfit)),
        inner_weight=np.full(len(inner), 0.5 * main.total / len(inner)),
        seen=seen_beside(main, uv),
    )


def _shape(group: Group) -> _Shape:
    outline = group.outline
    z = outline.uv @ np.array([1, 1j])
    along = np.roll(z, -2) - np.roll(z, 2)
    normal = -1j * along / np.maximum(np.abs(along), 1e-9)
    length = float(np.abs(z - np.roll(z, 1)).sum())
    keep = np.flatnonzero(~outline.inferred)
    keep = keep if len(keep) > 3 else np.arange(len(z))
    some = keep[np.linspace(0, len(keep) - 1, min(len(keep), MOST)).astype(int)]
    spacing = length / len(z) * len(keep) / len(some)
    cloth = group.points.uv @ np.array([1, 1j])
    thin = np.linspace(0, len(cloth) - 1, min(len(cloth), MOST)).astype(int)
    return _Shape(
        z[some],
        normal[some],
        spacing,
        cloth[thin],
        group.side[thin],
        (cloth[group.side >= 0], cloth[group.side < 0]),
    )


def _real(z: Complex) -> Float:
    return np.column_stack([z.real, z.imag])
