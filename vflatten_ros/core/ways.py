"""Ways to lay the surface flat: which contacts are believed to join the cloth.

Which contacts join it and which only touch cannot always be told where they are. Whether the item
then lies flat, and is one of a kind that exists, can.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace

import numpy as np

from vflatten_ros.core.config import Config, RotationConfig
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.faces import ONE_CLOTH
from vflatten_ros.core.fused import Fused, drawn_again
from vflatten_ros.core.grouping import Grouped, group_pieces, put_beside, unfold_group
from vflatten_ros.core.hems import cut_at_hem, hem_within
from vflatten_ros.core.middle_slit import axes_of
from vflatten_ros.core.necks import cut_at_neck
from vflatten_ros.core.placing import Group, Placing, place_groups, turned_over
from vflatten_ros.core.recognition import (
    UNKNOWN,
    Recognition,
    likeliest_of,
    of_one_cloth,
    recognise,
)
from vflatten_ros.core.rotation import (
    Surface,
    Unfolded,
    doubts,
    link_surface,
    parted,
    unfold_surface,
)
from vflatten_ros.core.templates import Template
from vflatten_ros.core.tried import Tried, Verdict
from vflatten_ros.core.values import Float, Progress

WHOLE = np.inf  # the doubt at which all links are believed
NECK = 0.0  # stands for a cut: all links are believed but those across a narrow neck
WAYS = (  # draw of the samples, greatest doubt of what joins pieces
    (0, WHOLE),
    (0, NECK),  # where nothing is narrow this is soon known
    (0, 1.0),
    (0, 0.4),
    (1, WHOLE),
    (1, NECK),
    (1, 0.4),
)
FINER = 0.8  # spacing of the samples drawn again, in that of the first
WORTH_PLACING = 0.1  # share of the samples of a group
HOPELESS = 0.8  # misfit of the largest group, above which none is: that group is laid out wrong
WORTH_CUTTING = 5.0  # badness up to which a way may be wrong about a hem only
PLACED_WAYS = 2  # categories by which groups are placed that are looked at, if they are as likely
LEAST_ODDS = 1e-3  # as this, against the likeliest

Said = Verdict | DisconnectedSurface  # of a way: what it is, or why there is no such way


@dataclass(frozen=True, eq=False)
class Task:
    """What the ways start from."""

    fused: Fused
    templates: tuple[Template, ...]
    config: Config


class Ways:
    """Tries the ways, by their place in WAYS.

    Only what the best way to each category laid flat is kept: the others are large and lost.
    """

    def __init__(self, task: Task) -> None:
        self._task = task
        self._draw: _Draw | None = None
        self._kept: dict[str, tuple[int, Tried]] = {}  # by category

    def verdict(self, way: int, progress: Progress) -> Said:
        """Try a way."""
        try:
            tried = self._tried(way, progress)
        except DisconnectedSurface as error:
            return error
        category = tried.found.category
        if category not in self._kept or tried.badness < self._kept[category][1].badness:
            self._kept[category] = way, tried
        return tried.verdict

    def laid_flat(self, way: int, progress: Progress) -> Tried:
        """What a way led to, tried again if it was not kept.

        Raises
        ------
        DisconnectedSurface
        """
        kept = dict(self._kept.values())
        return kept[way] if way in kept else self._tried(way, progress)

    def _tried(self, way: int, progress: Progress) -> Tried:
        draw, doubt = WAYS[way]
        if self._draw is None or self._draw.number != draw:
            self._draw = None  # before the next one takes its room
            self._draw = _Draw(self._task, draw, progress)
        return self._draw.tried(doubt, progress)


def finer(config: RotationConfig) -> RotationConfig:
    """The same for a denser draw of the samples: it sees other places where layers touch.

    No length goes beyond its allowed range.
    """
    least = {field.name: field.metadata["low"] for field in fields(config)}
    lengths = ("spacing_m", "link_m")
    return replace(config, **{n: max(least[n], FINER * getattr(config, n)) for n in lengths})


class _Draw:
    """The ways with one draw of the samples, and what several of them need."""

    def __init__(self, task: Task, number: int, progress: Progress) -> None:
        fused, config = task.fused, task.config
        if number:
            config = replace(config, rotation=finer(config.rotation))
            fused = drawn_again(fused, number, config.rotation, progress)
        self.number = number
        self._fused, self._templates = fused, task.templates
        self._config = config
        self._linked = link_surface(fused, config.rotation, progress)
        self._doubted: Surface | None = None

    def tried(self, doubt: float, progress: Progress) -> Tried:
        """One of WAYS; if a hem lies within, cut along it, or as it was, whichever is better.

        Raises
        ------
        DisconnectedSurface
        """
        best = self._laid(doubt, progress)
        fit, config = best.found.fit, self._config.rotation
        if fit is None or fit.misfit > HOPELESS or best.badness > WORTH_CUTTING:
            return best
        hem = hem_within(best.unfolded, fit, config)
        if hem is None:
            return best
        laid = best.unfolded
        with suppress(DisconnectedSurface):  # it is as good as before
            for anew in (False, True):
                grouped = cut_at_hem(laid, hem, anew, config, progress)
                if grouped is None:
                    break
                cut = self._from_groups(grouped, progress)
                best = min((best, cut), key=lambda one: one.badness)
                if not best.untrusted:
                    break
        return best

    def _laid(self, doubt: float, progress: Progress) -> Tried:
        config = self._config
        if doubt == WHOLE:
            unfolded = unfold_surface(self._linked, config.rotation, progress)
            return _recognised(unfolded, self._templates, config, progress)
        if doubt == NECK:
            grouped = cut_at_neck(self._linked, config.rotation, progress)
            return self._from_groups(grouped, progress)
        if self._doubted is None:
            found = doubts(self._fused, config.rotation, progress)
            self._doubted = replace(self._linked, doubt=found)
        grouped = group_pieces(self._doubted, doubt, config.rotation, progress)
        return self._from_groups(grouped, progress)

    def _from_groups(self, grouped: Grouped, progress: Progress) -> Tried:
        """The largest group by itself, or with others placed beside it, whichever is better."""
        config = self._config
        laid = [unfold_group(grouped, 0, config.rotation, progress)]
        alone = _recognised(laid[0], self._templates, config, progress)
        large = [k for k, mask in enumerate(grouped.masks) if k and mask.mean() > WORTH_PLACING]
        alone = replace(alone, aside=sum(float(grouped.masks[k].mean()) for k in large))
        if not large or alone.found.fit is None or alone.found.fit.misfit > HOPELESS:
            return alone
        laid += [unfold_group(grouped, k, config.rotation, progress) for k in large]
        groups = [Group(one.points, one.side, one.outline) for one in laid]

        def cost(placing: Placing) -> float:
            return placing.cost + of_one_cloth(placing.template, self._linked.even)

        placings = sorted(place_groups(groups, self._templates, config, progress), key=cost)
        odds = {p.template.category: float(np.exp(cost(placings[0]) - cost(p))) for p in placings}
        if placings[0].template.single_sheet and self._linked.even >= ONE_CLOTH:
            placings = placings[:1]  # as well as a garment may lie
        placed = []
        for placing in placings[:PLACED_WAYS]:
            if odds[placing.template.category] < LEAST_ODDS:
                break
            sigma_m = config.assembly.sigma_m
            turned = turned_over(placing, groups, config)
            beside = put_beside(
                laid, placing.motions, placing.outline, sigma_m, turned, config.rotation
            )
            axes = axes_of(placing.outline, placing.pose)
            cut = parted(beside, axes, config.rotation) if _like_legs(placing.template) else None
            if cut is not None and cut[1] > 0.5:
                del odds[placing.template.category]  # the groups are legs
            else:
                placed.append((placing, beside))
        tries = [alone]
        for placing, beside in placed:
            (only,) = (t for t in self._templates if t.category == placing.template.category)
            # all groups' ends say which way up it lies; where groups meet, the outline may not
            begin = {only.category: (placing.pose, only.state_of(placing.template, placing.state))}
            tried = _recognised(beside, (only,), config, progress, begin)
            tries.append(replace(tried, found=_among(tried.found, odds)))
        return min(tries, key=lambda tried: tried.badness)


def _among(found: Recognition, odds: Mapping[str, float]) -> Recognition:
    """The category as the groups were placed by, weighed against the others that they could be.

    Put side by side, two legs look like a towel; where their ends met, the placing knows.
    """
    known = {name: odds[name] / sum(odds.values()) for name in odds}
    unknown = found.probabilities[UNKNOWN]
    probabilities = {name: (1.0 - unknown) * p for name, p in known.items()} | {UNKNOWN: unknown}
    return replace(found, probabilities=probabilities)


def _like_legs(template: Template) -> bool:
    """Whether two legs that hang against each other look like it."""
    return not template.parts and not template.single_sheet


def _slit_or_not(
    whole: Recognition, cut: Recognition, chance: float, templates: Sequence[Template]
) -> dict[str, float]:
    """Probabilities of the categories where an item has, by chance, a slit up its middle.

    Then it has legs, whatever else it looks like.
    """
    legs = [t.category for t in templates if t.parts]
    all_legs = max(sum(cut.probabilities[name] for name in legs), 1e-9)
    told = {name: (1.0 - chance) * p for name, p in whole.probabilities.items()}
    for name in legs:
        told[name] += chance * cut.probabilities[name] / all_legs
    return {name: p / sum(told.values()) for name, p in told.items()}


def _chance(slit: float, templates: Sequence[Template], even: float) -> float:
    """Probability of a slit between legs, by its signs and how evenly apart the faces hang."""
    against = max((of_one_cloth(t, even) for t in templates if t.parts), default=0.0)
    return float(slit / (slit + (1.0 - slit) * np.exp(against)))


def _recognised(
    unfolded: Unfolded,
    templates: tuple[Template, ...],
    config: Config,
    progress: Progress,
    begin: Mapping[str, tuple[Float, Float]] | None = None,
) -> Tried:
    def named(laid: Unfolded) -> Recognition:
        outline, points = laid.outline, laid.points
        settings, even = config.recognition, laid.surface.even
        return recognise(outline, points, templates, settings, progress, begin, even)

    found = named(unfolded)
    if begin is None and (fit := found.fit) is not None and not fit.template.parts:
        outline = fit.points()[: fit.template.vertices]
        axes = axes_of(outline, fit.pose, across=fit.template.single_sheet)
        cut = parted(unfolded, axes, config.rotation)  # are these legs?
        if cut is not None:
            legs = named(cut[0])
            chance = _chance(cut[1], templates, unfolded.surface.even)
            told = _slit_or_not(found, legs, chance, templates)
            if chance > 0.5:
                unfolded, found = cut[0], legs
            found = likeliest_of(found, told)
    return Tried(unfolded, found, rotation=config.rotation)
