"""Ways to lay the surface flat, tried in turn until one makes a good item.

Which contacts join the cloth and which only touch cannot always be told where they are. Whether the
item then lies flat, and is one of a kind that exists, can.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from vflatten_ros.core.category_outline import MOST_DEEP_M, deep_inside_m
from vflatten_ros.core.config import Config, RotationConfig
from vflatten_ros.core.doubled import MISLAID, doubled_share
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.grouping import Grouped, group_pieces, put_beside, unfold_group
from vflatten_ros.core.placing import Group, place_groups
from vflatten_ros.core.recognition import UNKNOWN, Recognition, recognise
from vflatten_ros.core.rotation import (
    Fused,
    Surface,
    Unfolded,
    doubts,
    drawn_again,
    link_surface,
    unfold_surface,
)
from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import Float, Progress

WHOLE = np.inf  # the doubt at which all links are believed
WAYS = (  # draw of the samples, greatest doubt of what joins pieces
    (0, WHOLE),
    (0, 1.0),
    (0, 0.4),
    (1, WHOLE),
    (1, 0.4),
    (1, 1.0),
)
FINER = 0.8  # spacing of the samples drawn again, in that of the first
DISPUTED = -0.5  # badness below which a way that is unsure, or has rivals, settles it
PLACED = -0.35  # the same for groups that nothing joins but the category
YIELDING = 0.15  # by which the third way and each further one raise these two
RIVAL = 1.5  # how much worse ways to other categories may be
MAJORITY = 2  # ways of the best one's category for each such, for them not to count
UNDECIDED = 0.9  # probability of the best way's category below which it is unsure
VOTE = 2.0  # by how many e-folds a way counts less if it is worse by 1
NEAR_TIE = 0.67  # share of the best category's votes, for the result not to be trusted
SURE = 0.97  # probability of a category below which one way alone is not believed
MOST_UNSEEN = 0.15  # share of the outline that no view shows, above which it is not, either
DOUBTFUL = 0.3  # badness above which a result is not to be trusted, and more ways are tried
UNSURE = 0.7  # probability of its category below which it is not, either
STRAYS, MOSTLY_LEFT = 0.06, 0.3  # share that any result leaves out; more that counts as 1
LAID, MOSTLY_LAID = 0.05, 0.08  # overlap that any garment laid flat has; more that counts as 1
MOSTLY_DOUBLED = 0.1  # share of a single sheet on other cloth of its own that counts as 1
STRAINED_M = 0.001  # misfit of the distances at a point that cloth laid flat seldom has
STRAIN, MOSTLY_STRAINED = 0.06, 0.1  # share of points with more; more that counts as 1
EXPLAINED, MOSTLY_ODD = 0.95, 0.5  # share of the outline that is the category's; less counting as 1
ODD = 0.5  # for a long stretch of the outline deep inside the category's
ASIDE = 3.0  # of the share that is left out in large groups, beside: it can be no noise
WORTH_PLACING = 0.1  # share of the samples of a group
HOPELESS = 0.8  # misfit of the largest group, above which none is: that group is laid out wrong
PLACED_WAYS = 2  # categories by which groups are placed that are looked at, if they are as likely
LEAST_ODDS = 1e-3  # as this, against the likeliest


@dataclass(frozen=True, eq=False)
class Tried:
    """One way to lay the item flat, and what it is then."""

    unfolded: Unfolded
    found: Recognition
    aside: float = 0.0  # share of the samples in large groups that were left out
    rival: str = ""  # another category for which other ways speak nearly as much
    rotation: RotationConfig = RotationConfig()  # by which it was laid flat

    @cached_property
    def deep_m(self) -> float:
        """Longest stretch of the outline that was seen deep inside the category's, m."""
        if self.found.fit is None:
            return 0.0
        return deep_inside_m(self.unfolded.outline, self.found.fit)

    @cached_property
    def doubled(self) -> float:
        """Share of a single sheet that lies on other cloth of its own; 0 for any other item."""
        if self.found.fit is None or not self.found.fit.template.single_sheet:
            return 0.0
        return doubled_share(self.unfolded.points)

    @property
    def badness(self) -> float:
        """How badly and unsurely a category fits, how far from flat it lies, what is left out.

        A garment laid flat has one layer of either side everywhere, and distances that agree; where
        there are more layers, or the distances contradict each other over some area, layers were
        joined that are not. A piece alone may look like a whole item of another kind.
        """
        misfit = self.found.fit.misfit if self.found.fit is not None else np.inf
        folded = max(0.0, self.unfolded.overlap - LAID) / MOSTLY_LAID
        strain = float((self.unfolded.points.stress > STRAINED_M).mean())
        folded += max(0.0, strain - STRAIN) / MOSTLY_STRAINED
        folded += max(0.0, self.doubled - MISLAID) / MOSTLY_DOUBLED
        left_out = max(0.0, 1.0 - self.unfolded.share - STRAYS) / MOSTLY_LEFT
        explained = self.found.fit.explained if self.found.fit is not None else 0.0
        odd = max(0.0, EXPLAINED - explained) / MOSTLY_ODD
        if self.deep_m > MOST_DEEP_M:
            odd += ODD
        left_out += ASIDE * self.aside
        unknown = float(self.found.category == UNKNOWN)
        return float(misfit + folded + left_out + odd + 1.0 - self.sure + unknown)

    @property
    def sure(self) -> float:
        """Probability of the likeliest category."""
        known = [p for name, p in self.found.probabilities.items() if name != UNKNOWN]
        return max(known, default=0.0)

    @property
    def untrusted(self) -> str:
        """Why the result is not to be trusted; empty: it may be."""
        if self.badness > DOUBTFUL:
            return f"no category fits the item well, or it does not lie flat ({self.badness:.1f})"
        if self.sure < UNSURE:
            return f"it is only {self.sure:.0%} likely to be what it most looks like"
        if self.rival:
            return f"laid flat in other ways it is nearly as good a {self.rival}"
        return ""


def likeliest(
    fused: Fused,
    templates: tuple[Template, ...],
    config: Config,
    progress: Progress,
) -> Tried:
    """The way of laying the surface flat that makes the best item.

    Raises
    ------
    VFlattenError
        No way led to a flat surface.
    """
    tries: list[Tried] = []
    failures: list[DisconnectedSurface] = []
    draws: dict[int, _Draw] = {}
    for draw, doubt in WAYS[: config.rotation.ways]:
        if settled(tries):
            break
        if draw not in draws:
            draws[draw] = _Draw(fused, draw, templates, config, progress)
        try:
            tries.append(draws[draw].tried(doubt))
        except DisconnectedSurface as error:
            failures.append(error)
    if not tries:
        raise failures[0]
    return replace(_best(tries), rival=rival(tries))


def finer(config: RotationConfig) -> RotationConfig:
    """The same for a denser draw of the samples: it sees other places where layers touch.

    No length goes beyond its allowed range.
    """
    least = {field.name: field.metadata["low"] for field in fields(config)}
    lengths = ("spacing_m", "link_m")
    return replace(config, **{n: max(least[n], FINER * getattr(config, n)) for n in lengths})


def settled(tries: Sequence[Tried]) -> bool:
    """Whether what was tried is good enough, undisputed, and one way alone beyond doubt."""
    if not tries:
        return False
    best = _best(tries)
    known = [one for one in tries if one.found.category != UNKNOWN]
    near = [one for one in known if one.badness < best.badness + RIVAL]
    against = sum(one.found.category != best.found.category for one in near)
    agreed = len(near) - against >= MAJORITY * against
    limit = DOUBTFUL
    if not agreed or best.sure < UNDECIDED:
        limit = DISPUTED + YIELDING * max(0, len(tries) - 2)
    elif len(best.unfolded.parts) > 1:
        limit = PLACED + YIELDING * max(0, len(tries) - 2)
    if best.badness >= limit:
        return False
    unseen = float(tries[0].unfolded.outline.inferred.mean())
    return len(tries) > 1 or (tries[0].sure >= SURE and unseen < MOST_UNSEEN)


def rival(tries: Sequence[Tried]) -> str:
    """Another category that has nearly as many votes as the best way's; or none."""
    votes = _votes(tries)
    mine = votes.pop(_best(tries).found.category)
    votes.pop(UNKNOWN, None)
    other = max(votes, key=lambda name: votes[name], default="")
    return other if other and votes[other] > NEAR_TIE * mine else ""


def _votes(tries: Sequence[Tried]) -> dict[str, float]:
    """How much speaks for each category: the better a way to it, and the more ways, the more."""
    least = min(one.badness for one in tries)
    votes: dict[str, float] = {}
    for one in tries:
        vote = 1.0 if one.badness == least else float(np.exp(VOTE * (least - one.badness)))
        votes[one.found.category] = votes.get(one.found.category, 0.0) + vote
    return votes


def _best(tries: Sequence[Tried]) -> Tried:
    """The best way to the category with most votes."""
    votes = _votes(tries)
    category = max(votes, key=lambda name: votes[name])
    return min((t for t in tries if t.found.category == category), key=lambda t: t.badness)


class _Draw:
    """The ways with one draw of the samples, and what several of them need."""

    def __init__(
        self,
        fused: Fused,
        draw: int,
        templates: tuple[Template, ...],
        config: Config,
        progress: Progress,
    ) -> None:
        if draw:
            config = replace(config, rotation=finer(config.rotation))
            fused = drawn_again(fused, draw, config.rotation, progress)
        self._fused = fused
        self._templates, self._config, self._progress = templates, config, progress
        self._linked = link_surface(fused, config.rotation, progress)

    @cached_property
    def _doubted(self) -> Surface:
        doubt = doubts(self._fused, self._config.rotation, self._progress)
        return replace(self._linked, doubt=doubt)

    def tried(self, doubt: float) -> Tried:
        """One of WAYS.

        Raises
        ------
        DisconnectedSurface
        """
        config, progress = self._config, self._progress
        if doubt == WHOLE:
            unfolded = unfold_surface(self._linked, config.rotation, progress)
            return _recognised(unfolded, self._templates, config, progress)
        return self._from_groups(group_pieces(self._doubted, doubt, config.rotation, progress))

    def _from_groups(self, grouped: Grouped) -> Tried:
        """The largest group by itself, or with others placed beside it, whichever is better."""
        config, progress = self._config, self._progress
        laid = [unfold_group(grouped, 0, config.rotation, progress)]
        alone = _recognised(laid[0], self._templates, config, progress)
        large = [k for k, mask in enumerate(grouped.masks) if k and mask.mean() > WORTH_PLACING]
        alone = replace(alone, aside=sum(float(grouped.masks[k].mean()) for k in large))
        if not large or alone.found.fit is None or alone.found.fit.misfit > HOPELESS:
            return alone
        laid += [unfold_group(grouped, k, config.rotation, progress) for k in large]
        groups = [Group(one.points, one.side, one.outline) for one in laid]
        placings = place_groups(groups, self._templates, config, progress)
        least = placings[0].cost
        odds = {p.template.category: float(np.exp(least - p.cost)) for p in placings}
        tries = [alone]
        for placing in placings[:PLACED_WAYS]:
            if odds[placing.template.category] < LEAST_ODDS:
                break
            sigma_m = config.assembly.sigma_m
            beside = put_beside(laid, placing.motions, placing.outline, sigma_m, config.rotation)
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


def _recognised(
    unfolded: Unfolded,
    templates: tuple[Template, ...],
    config: Config,
    progress: Progress,
    begin: Mapping[str, tuple[Float, Float]] | None = None,
) -> Tried:
    outline, points = unfolded.outline, unfolded.points
    found = recognise(outline, points, templates, config.recognition, progress, begin)
    return Tried(unfolded, found, rotation=config.rotation)
