"""Groups of pieces that nothing seen joins, placed as a category's outline has them.

Every group lies flat by itself, front and back. Its ends lie on the outline of the whole item, its
cloth inside, and not on cloth of the same side. And no two points hang farther apart than it is
along the cloth (`cloth_ways`). The category's outline is fitted to the largest group, the others
are tried all over it, either way up, and the outline is fitted to all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.cloth_ways import ClothWays, cloth_ways
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
PLACES, EACH = 60, 6  # of a group, either way up, that are looked at; of one rotation
SEARCHED = 8  # of all of them, best first, round which better ones are searched
TOGETHER = 4  # places of the groups before, with which the next is placed
ALIKE_M = 0.01  # between the middles of a group in two places that are one
STIFF = 0.05  # of the swing that is allowed: the groups are rigid
NEAR_M = 0.02  # beyond the main group's outline
THIN = 4  # of these points every fourth is judged by its chords
AS_GOOD = 2.0  # by how much a group may fit worse turned over, halves of squared sigmas
NEAREST_M = 0.03  # from which on it counts how much farther apart points lie than they hang
TORN_M = 0.02  # excess of a chord over the way along the flat cloth that errors make
END_SIGMA_M = 0.002
STEPS = np.array([np.radians(8.0), 0.02, 0.02])  # of the search round a place: turn, shift
FINEST = 16.0  # how much smaller they become
WORTH_PLACING = 8.0  # cost of the largest group alone beyond the least, up to which the others are
# placed beside it: e^-8 is less than any odds that are looked at
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
    beside: float = 0.0  # of cloth upon cloth of its own side, and of chords, alike

    @property
    def outline(self) -> Float:
        """(c, 2) of the item."""
        outline: Float = place(self.template, self.pose, self.state)[0][: self.template.vertices]
        return outline

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
    hangs: Float  # (i, 3) where they hang, m
    cloth: tuple[Complex, Complex]  # all points with the outside up, and down

    @property
    def middle(self) -> complex:
        """Of what is inside."""
        return complex(self.inner.mean())


@dataclass(frozen=True, eq=False)
class _Images:
    """Images by which places are judged."""

    low: Float  # (2,)
    signed: Float  # distance to the category's outline, inside negative, m
    taken: tuple[Float, Float]  # depth in what lies there outside up, and down, m
    ways: ClothWays
    ways_m: Float  # (2, c + 1, l) to some of what lies there, from every cell, of either side
    laid: Complex  # (l,) where that lies
    same: NDArray[np.bool_]  # (i, l) whether some of the group is of its side, if not mirrored
    clear: NDArray[np.bool_]  # (i, l) whether that is known
    chord_m: Float  # (i, l) between them as they hang
    log_chord: NDArray[np.float32]  # (i, l) logarithm of that, or of NEAREST_M

    def cells(self, z: Complex) -> Int:
        """Numbers of the cells at places, or nearest to them."""
        rows, cols = self.signed.shape
        col = np.rint((z.real - self.low[0]) / CELL_M).astype(np.int64).clip(0, cols - 1)
        row = np.rint((z.imag - self.low[1]) / CELL_M).astype(np.int64).clip(0, rows - 1)
        cell: Int = row * cols + col
        return cell


@dataclass(frozen=True, eq=False)
class _Places:
    """Places of a group."""

    mirrored: NDArray[np.bool_]  # (t,)
    where: Float  # (t, 3) turn, and where the middle of what is judged lies

    def motion(self, which: int, shape: _Shape) -> Motion:
        """To one of them."""
        mirrored, (angle, u, v) = bool(self.mirrored[which]), self.where[which]
        turn = complex(np.exp(1j * angle))
        arm = np.conj(shape.middle) if mirrored else shape.middle
        return Motion(mirrored, turn, complex(u + 1j * v - turn * arm))


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
        another have no motions, and a cost as if the other groups fitted them as they fit the best:
        WORTH_PLACING above that, or more.
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
    fits.sort(key=lambda fit: fit[0])
    most = min(config.assembly.hopeless, WORTH_PLACING)
    likely = [fit for fit in fits if fit[0] < fits[0][0] + most]
    first: list[Placing] = []
    for done, (energy, template, pose, state) in enumerate(likely):
        progress("place", 0.4 + 0.4 * done / len(likely))
        placing = Placing(template, pose, state, (), energy)
        first.append(_fitted(_placed(placing, shapes, config), shapes, main, config))
    least, more = min((p.cost, p.cost - fit[0]) for p, fit in zip(first, likely, strict=True))
    first += [
        Placing(t, pose, state, (), energy + more) for energy, t, pose, state in fits[len(likely) :]
    ]
    found: dict[str, Placing] = {}
    for placing in sorted(first, key=lambda placing: (not placing.motions, placing.cost)):
        found.setdefault(placing.template.category, placing)
    for done, (category, placing) in enumerate(found.items()):
        progress("place", 0.8 + 0.2 * done / len(found))
        if placing.motions and placing.cost < least + WORTH_A_TURN:
            again = _fitted(_placed(placing, shapes, config), shapes, main, config)
            found[category] = _placed(again, shapes, config)
    placed = sorted((p for p in found.values() if p.motions), key=lambda placing: placing.cost)
    at_least = placed[0].cost + WORTH_PLACING
    others = [replace(p, energy=max(p.energy, at_least)) for p in found.values() if not p.motions]
    return placed + sorted(others, key=lambda placing: placing.cost)


def turned_over(placing: Placing, groups: Sequence[Group], config: Config) -> list[Motion | None]:
    """Where each group lies turned over about its place, if that is nearly as likely; else None.

    A leg's two seams look alike, and nothing that was seen may join them to the rest.

    Parameters
    ----------
    placing : Placing
        Of these groups, with motions.
    groups : sequence of Group
        As they were placed, the one that stays first.
    config : Config
    """
    shapes = [_shape(group) for group in groups]
    images = _judging(placing, shapes[0])
    found: list[Motion | None] = [None]
    for k in range(1, len(groups)):
        others = [i for i in range(len(groups)) if i != k]
        motion, shape = placing.motions[k], shapes[k]
        here = images([shapes[i] for i in others], [placing.motions[i] for i in others], shape)
        own = _places([motion], shape)
        other = _searched(here, shape, _places(_flipped(motion, shape), shape), config.assembly)
        costs = [_costs(here, shape, p, config.assembly)[:, 0].sum() for p in (own, other)]
        found.append(other.motion(0, shape) if costs[1] < costs[0] + AS_GOOD else None)
    return found


def _flipped(motion: Motion, shape: _Shape) -> list[Motion]:
    """A place of a group turned over about its long and its short axis."""
    z = motion(shape.inner)
    middle = complex(z.mean())
    axes = np.linalg.eigh(np.cov(z.real, z.imag))[1].T @ [1, 1j]
    flips = []
    for twice in axes**2:  # a reflection: z -> middle + twice * conj(z - middle)
        turn = complex(twice * np.conj(motion.turn))
        shift = complex(middle + twice * np.conj(motion.shift - middle))
        flips.append(Motion(not motion.mirrored, turn, shift))
    return flips


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
    assembly = config.assembly
    images = _judging(placing, shapes[0])
    starts = placing.motions or _together(placing, shapes, images, assembly)
    motions, beside = [STAYS], 0.0
    for k, shape in enumerate(shapes[1:], start=1):
        here = images(shapes[:k], motions, shape)
        placed = _searched(here, shape, _places([starts[k]], shape), assembly)
        motions.append(placed.motion(0, shape))
        beside += float(_costs(here, shape, placed, assembly)[1:].sum())
    return replace(placing, motions=tuple(motions), beside=beside)


def _judging(
    placing: Placing, main: _Shape
) -> Callable[[Sequence[_Shape], Sequence[Motion], _Shape], _Images]:
    """What makes the images for a group, of those placed and their motions."""
    template, outline = placing.template, placing.outline
    ways = cloth_ways(outline, template.seam, template.single_sheet)
    return partial(_images, outline=outline, ways=ways, main_m=ways.to(main.inner[::THIN]))


def _together(
    placing: Placing,
    shapes: Sequence[_Shape],
    images: Callable[[Sequence[_Shape], Sequence[Motion], _Shape], _Images],
    config: AssemblyConfig,
) -> tuple[Motion, ...]:
    """Places of all groups, of those that each by itself might have.

    Which of a group's is right may show only in that the next group fits beside it.
    """
    kept: list[tuple[tuple[Motion, ...], float]] = [((STAYS,), 0.0)]
    for k, shape in enumerate(shapes[1:], start=1):
        starts = _candidates(placing.template, placing.pose, placing.state, shape)
        alone = images(shapes[:1], [STAYS], shape)
        places = _searched(alone, shape, _places(starts, shape), config)
        tried = []
        for motions, cost in kept:
            here = alone if k == 1 else images(shapes[:k], motions, shape)
            costs = cost + _costs(here, shape, places, config).sum(axis=0)
            tried += [((*motions, places.motion(j, shape)), c) for j, c in enumerate(costs)]
        kept = sorted(tried, key=lambda one: one[1])[:TOGETHER]
    return kept[0][0]


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
        poses, _ = matches(template, _real(ends), _real(inner), PLACES, state, EACH)
        for angle, u, v in poses:  # of the outline as the group has it
            back = turn * np.exp(-1j * angle)
            found.append(Motion(mirrored, complex(back), complex(shift - back * (u + 1j * v))))
    return found


def _places(motions: Sequence[Motion], shape: _Shape) -> _Places:
    mirrored = np.array([m.mirrored for m in motions])
    turn, shift = np.array([m.turn for m in motions]), np.array([m.shift for m in motions])
    centre = turn * np.where(mirrored, np.conj(shape.middle), shape.middle) + shift
    return _Places(mirrored, np.column_stack([np.angle(turn), centre.real, centre.imag]))


def _searched(images: _Images, shape: _Shape, starts: _Places, config: AssemblyConfig) -> _Places:
    """The best places near the starts, best first."""
    cost = _costs(images, shape, starts, config).sum(axis=0)
    first = np.argsort(cost, kind="stable")[:SEARCHED]
    mirrored, where, cost = starts.mirrored[first], starts.where[first], cost[first]
    scale = np.ones(len(where))
    ways = np.vstack([np.eye(3), -np.eye(3)]) * STEPS
    while scale.max() > 1 / FINEST:
        tried = where[:, None] + ways * scale[:, None, None]
        around = _Places(np.repeat(mirrored, len(ways)), tried.reshape(-1, 3))
        costs = _costs(images, shape, around, config).sum(axis=0)
        costs = costs.reshape(len(where), -1)
        best, rows = costs.argmin(axis=1), np.arange(len(where))
        better = costs[rows, best] < cost - 1e-9
        where = np.where(better[:, None], tried[rows, best], where)
        cost = np.where(better, costs[rows, best], cost)
        scale = np.where(better, scale, scale / 2)
    kept: list[int] = []
    for k in np.argsort(cost, kind="stable"):
        apart = np.abs(where[kept, 1:] - where[k, 1:]).max(axis=1) > ALIKE_M
        if (apart | (mirrored[kept] != mirrored[k])).all():
            kept.append(int(k))
    return _Places(mirrored[kept], where[kept])


def _costs(images: _Images, shape: _Shape, places: _Places, config: AssemblyConfig) -> Float:
    """(3, t) misfits of the places: to the outline, of cloth upon cloth, of chords."""
    turn = np.exp(1j * places.where[:, 0])[:, None]
    centre = (places.where[:, 1:] @ [1, 1j])[:, None]
    mirrored = places.mirrored[:, None]

    def moved(z: Complex) -> Complex:
        arm = z - shape.middle
        there: Complex = turn * np.where(mirrored, arm.conj(), arm) + centre
        return there

    sigma = config.misfit_m
    laid = moved(shape.inner)
    inner = images.cells(laid)
    off = images.signed.take(images.cells(moved(shape.ends))) / sigma
    out = np.maximum(images.signed.take(inner), 0.0) / sigma
    up = np.where(mirrored, -shape.up, shape.up)
    depth = np.where(up > 0, images.taken[0].take(inner), images.taken[1].take(inner))
    over = np.maximum(depth - config.overlap_m, 0.0) * (up != 0) / sigma
    fit = config.end_weight * robust_mean(off, 3.0) + config.inner_weight * robust_mean(out, 3.0)
    upon = config.overlap_weight * robust_mean(over, 6.0)
    way = _ways_m(images, laid[:, ::THIN], places.mirrored)
    torn = np.maximum(images.chord_m - way - TORN_M, 0.0) * images.clear / sigma
    apart = (laid[:, ::THIN, None] - images.laid).astype(np.complex64)
    lies_m2 = np.maximum(apart.real**2 + apart.imag**2, NEAREST_M**2)
    loose = 0.5 * np.log(lies_m2) - images.log_chord
    hung = config.chord_weight * robust_mean(torn, 5.0).mean(axis=-1)
    hung += config.slack_weight * np.maximum(loose, 0.0).mean(axis=(-2, -1))
    return np.stack([fit, upon, hung])


def _ways_m(images: _Images, laid: Complex, mirrored: NDArray[np.bool_]) -> Float:
    """(t, i, l) lengths of the ways along the cloth from (t, i) places of the group."""
    side = np.where(mirrored[:, None, None], ~images.same, images.same)
    cells = images.ways.at(laid)[:, :, None]
    ways: Float = images.ways_m[1 - side, cells, np.arange(side.shape[2])]
    return ways


def _images(
    placed: Sequence[_Shape],
    motions: Sequence[Motion],
    shape: _Shape,
    outline: Float,
    ways: ClothWays,
    main_m: Float,
) -> _Images:
    cloth: list[list[Complex]] = [[], []]
    for one, motion in zip(placed, motions, strict=True):
        for k in (0, 1):
            cloth[k ^ motion.mirrored].append(motion(one.cloth[k]))
    taken = [_real(np.concatenate(side)) for side in cloth]
    reach = float(np.abs(shape.inner - shape.inner.mean()).max()) + 0.05
    everything = np.vstack([outline, *taken])
    low, high = everything.min(axis=0) - reach, everything.max(axis=0) + reach
    cols, rows = np.ceil((high - low) / CELL_M).astype(int) + 1
    body = np.zeros((rows, cols), np.uint8)
    cv2.fillPoly(body, [np.rint((outline - low) / CELL_M).astype(np.int32)], (1,))
    depths = []
    for uv in taken:
        image = np.zeros((rows, cols), np.uint8)
        col, row = np.rint((uv - low) / CELL_M).astype(int).T
        image[row, col] = 1
        closed = cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        depths.append(_depth(closed.astype(np.uint8)))
    outside = np.asarray(1 - body, dtype=np.uint8)
    signed = _depth(outside) - _depth(body)
    beside = [m(s.inner[::THIN]) for s, m in zip(placed, motions, strict=True)]
    ways_m = np.concatenate([main_m, *(ways.to(z) for z in beside[1:])], axis=2)
    up = np.concatenate([(-s.up if m.mirrored else s.up)[::THIN] for s, m in zip(placed, motions)])
    hangs = np.concatenate([s.hangs[::THIN] for s in placed])
    sides = np.outer(shape.up[::THIN], up)
    chord = np.linalg.norm(shape.hangs[::THIN, None] - hangs, axis=2)
    return _Images(
        low=low,
        signed=signed,
        taken=(depths[0], depths[1]),
        ways=ways,
        ways_m=ways_m,
        laid=np.concatenate(beside),
        same=sides > 0,
        clear=sides != 0,
        chord_m=chord,
        log_chord=np.log(np.maximum(chord, NEAREST_M)).astype(np.float32),
    )


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
        group.points.xyz_hanger[thin],
        (cloth[group.side >= 0], cloth[group.side < 0]),
    )


def _real(z: Complex) -> Float:
    return np.column_stack([z.real, z.imag])
