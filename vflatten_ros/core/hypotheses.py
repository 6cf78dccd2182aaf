"""Ways to lay the surface flat, tried in turn until one makes a good item.

Which contacts join the cloth and which only touch cannot always be told where they are. Whether the
item then lies flat, and is one of a kind that exists, can.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.grouping import (
    CLOSED,
    PUZZLE,
    SPREAD_OUT,
    Grouped,
    group_pieces,
    put_beside,
    unfold_group,
)
from vflatten_ros.core.parallel import Ahead, Once
from vflatten_ros.core.placing import Group, place_groups
from vflatten_ros.core.recognition import UNKNOWN, Recognition, recognise
from vflatten_ros.core.rotation import (
    Fused,
    Surface,
    Unfolded,
    doubts,
    link_surface,
    unfold_surface,
)
from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import Progress

WHOLE = "whole"
WAYS = (  # how, greatest doubt, badness of what was tried before below which it is left out
    (WHOLE, np.inf, -np.inf),
    (PUZZLE, 1.0, -0.5),
    (CLOSED, 1.0, -0.2),
    (SPREAD_OUT, 1.0, -0.2),
    (WHOLE, 1.0, 0.0),
    (PUZZLE, 0.6, 0.0),
    (CLOSED, 0.6, 0.0),
    (WHOLE, 0.6, 0.0),
    (PUZZLE, 0.4, 0.0),
    (CLOSED, 0.4, 0.0),
    (SPREAD_OUT, 0.4, 0.0),
)
STRAYS, MOSTLY_LEFT = 0.06, 0.3  # share that any result leaves out; more that counts as 1
LAID, MOSTLY_LAID = 0.05, 0.08  # overlap that any garment laid flat has; more that counts as 1
EXPLAINED, MOSTLY_ODD = 0.95, 0.5  # share of the outline that is the category's; less counting as 1
WORTH_PLACING = 0.1  # share of the samples of a group
PLACED_WAYS = 2  # categories by which groups are placed that are looked at


@dataclass(frozen=True, eq=False)
class Tried:
    """One way to lay the item flat, and what it is then."""

    unfolded: Unfolded
    found: Recognition

    @property
    def badness(self) -> float:
        """How badly the best category fits, how far from flat it lies, what it leaves out.

        A garment laid flat has one layer of either side everywhere; more say that layers were
        joined that are not. A piece alone may look like a whole item of another kind.
        """
        misfit = self.found.fit.misfit if self.found.fit is not None else np.inf
        folded = max(0.0, self.unfolded.overlap - LAID) / MOSTLY_LAID
        left_out = max(0.0, 1.0 - self.unfolded.share - STRAYS) / MOSTLY_LEFT
        explained = self.found.fit.explained if self.found.fit is not None else 0.0
        odd = max(0.0, EXPLAINED - explained) / MOSTLY_ODD
        return float(misfit + folded + left_out + odd + (self.found.category == UNKNOWN))


def likeliest(
    fused: Fused,
    templates: tuple[Template, ...],
    config: Config,
    progress: Progress,
) -> Tried:
    """The way of laying the surface flat that makes the best item.

    Most items need two tries, so two are made at once, and a result that is not needed is dropped.

    Raises
    ------
    VFlattenError
        No way led to a flat surface.
    """
    linked = Once(partial(link_surface, fused, config.rotation))
    looked = Once(partial(doubts, fused, config.rotation))

    def surface(doubt: float, progress: Progress) -> Surface:
        ramps = looked(progress) if np.isfinite(doubt) else None
        plain = linked(progress)
        return plain if ramps is None else replace(plain, doubt=ramps)

    def pieces(doubt: float, progress: Progress) -> Grouped:
        return group_pieces(surface(doubt, progress), doubt, config.rotation, progress)

    grouped = {doubt: Once(partial(pieces, doubt)) for _, doubt, _ in WAYS}

    def tried(how: str, doubt: float, progress: Progress) -> Tried:
        if how == WHOLE:
            whole = surface(doubt, progress)
            unfolded = unfold_surface(whole, doubt, config.rotation, progress)
            return _recognised(unfolded, templates, config, progress)
        groups = grouped[doubt](progress)
        return _from_groups(groups, how, templates, config, progress)

    ways = [(enough, partial(tried, how, doubt)) for how, doubt, enough in WAYS]
    return _first_good(ways, progress)


def _first_good(
    ways: Sequence[tuple[float, Callable[[Progress], Tried]]], progress: Progress
) -> Tried:
    """The best of the ways; those that are needed only if none before was as good as they ask."""
    tries: list[Tried] = []
    failures: list[DisconnectedSurface] = []
    number, needed = 0, len(ways)
    with Ahead([way for _, way in ways]) as ahead:
        while number < needed:
            try:
                tries.append(ahead.result(number, progress))
            except DisconnectedSurface as error:
                failures.append(error)
            number += 1
            best = min((tried.badness for tried in tries), default=np.inf)
            later = range(number, len(ways))
            needed = next((k for k in later if best < ways[k][0]), len(ways))
            ahead.drop(needed)
    if not tries:
        raise failures[0]
    return min(tries, key=lambda tried: tried.badness)


def _from_groups(
    grouped: Grouped,
    start: str,
    templates: tuple[Template, ...],
    config: Config,
    progress: Progress,
) -> Tried:
    """The largest group by itself, or with the others placed beside it, whichever is better."""
    which = [k for k, mask in enumerate(grouped.masks) if k == 0 or mask.mean() > WORTH_PLACING]
    laid = [unfold_group(grouped, k, start, config.rotation, progress) for k in which]
    tries = [_recognised(laid[0], templates, config, progress)]
    if len(laid) > 1:
        groups = [Group(one.points, one.side, one.outline) for one in laid]
        placings = place_groups(groups, templates, config, progress)
        least = placings[0].cost
        odds = {p.template.category: float(np.exp(least - p.cost)) for p in placings}
        for placing in placings[:PLACED_WAYS]:
            sigma_m = config.assembly.sigma_m
            beside = put_beside(laid, placing.motions, sigma_m, config.rotation)
            only = tuple(t for t in templates if t.category == placing.template.category)
            tried = _recognised(beside, only, config, progress)
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


def _recognised(
    unfolded: Unfolded, templates: tuple[Template, ...], config: Config, progress: Progress
) -> Tried:
    outline, points = unfolded.outline, unfolded.points
    return Tried(unfolded, recognise(outline, points, templates, config.recognition, progress))
