"""How good one way of laying the surface flat is, and which of several to believe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vflatten_ros.core.category_outline import MOST_DEEP_M, deep_inside_m, missing_share
from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.doubled import MISLAID, doubled_share
from vflatten_ros.core.geometry import twice_area
from vflatten_ros.core.measurement import covered
from vflatten_ros.core.recognition import UNKNOWN, Recognition
from vflatten_ros.core.rotation import Unfolded
from vflatten_ros.core.seams import torn_share
from vflatten_ros.core.template_fit import Fit
from vflatten_ros.core.unfolding import creased

DISPUTED = -0.5  # badness below which a way that is unsure, or has rivals, settles it
PLACED = -0.35  # the same for groups that nothing joins but the category
YIELDING = 0.15  # by which the third way and each further one raise these two
RIVAL = 1.5  # how much worse ways to other categories may be
MAJORITY = 2  # ways of the best one's category for each such, for them not to count
UNDECIDED = 0.9  # probability of the best way's category below which it is unsure
AGREE = 0.03  # share by which sizes of ways that agree differ
VOTE = 2.0  # by how many e-folds a way counts less if it is worse by 1
CONFIRM = 0.05  # share by which sizes may differ of ways that confirm each other
AGAINST = 5.0  # how much worse a way may be for its sizes to contradict those of one in parts
NEAR_TIE = 0.67  # share of the best category's votes, for the result not to be trusted
SURE = 0.97  # probability of a category below which one way alone is not believed
MOST_UNSEEN = 0.15  # share of the outline that no view shows, above which it is not, either
DOUBTFUL = 0.3  # badness above which a result is not to be trusted, and more ways are tried
UNSURE = 0.9  # probability of its category below which it is not, either
OF_STRIP = 0.35  # of the width of the strip that what is hidden would make across the item
IN_FOLD_M = 0.03  # how much cloth a fold between two parts of a single sheet hides, one deviation:
# 4 to 5 cm in four towels. Nothing else tells how far apart they lie
# Deviation of any size, as a share of it: lengths along the cloth are off together. Without it 4 %
# of the sizes over 60 cm were off by more than three deviations
OF_ANY_SIZE = 0.005
OF_SIZE = 0.05  # deviation of a size, as a share of it, for each 1 of badness: so large were the
# errors of results that were not trusted
STRAYS, MOSTLY_LEFT = 0.06, 0.3  # share that any result leaves out; more that counts as 1
BETWEEN, MOSTLY_BETWEEN, WORST_BETWEEN = 0.2, 0.1, 0.5  # the same of an item in parts that only the
# category joins: what is left out may be what lies between them; and what that counts at most
LAID, MOSTLY_LAID = 0.05, 0.08  # overlap that any garment laid flat has; more that counts as 1
MOSTLY_DOUBLED = 0.1  # share of a single sheet on other cloth of its own that counts as 1
TORN, MOSTLY_TORN = 0.08, 0.15  # share of the seams along which front and back hang apart; more
# that counts as 1. Of eleven items that lay well 5 % at most, of a towel that lay like a skirt 48 %
CREASED, MOSTLY_CREASED, WORST_CREASED = 0.035, 0.05, 0.8  # share of near pairs that fall short as
# across creases; more that counts as 1; what that counts at most: round tubes have up to 0.2. Of 60
# ways that were right within 7 % one had more than 0.04, two wrong ones 0.07 and 0.08
STRAINED_M = 0.001  # misfit of the distances at a point that cloth laid flat seldom has
STRAIN, MOSTLY_STRAINED = 0.06, 0.1  # share of points with more; more that counts as 1
EXPLAINED, MOSTLY_ODD = 0.95, 0.5  # share of the outline that is the category's; less counting as 1
ODD = 0.5  # for a long stretch of the outline deep inside the category's
UNSEEN, MOSTLY_UNSEEN = 0.2, 0.25  # share of the outline that no view shows; more that counts as 1
MISSING, MOSTLY_MISSING = 0.04, 0.1  # share of the category that is not there; more counting as 1
HIDDEN, MOSTLY_HIDDEN = 0.11, 0.25  # share of the category, between parts that it alone joins, that
# no view shows; more that counts as 1
ASIDE = 3.0  # of the share that is left out in large groups, beside: it can be no noise
# Cloth that was seen, in that of the category: of 858 ways right within 5 % between 0.56 and 1.21
MOST_CLOTH, MOSTLY_MORE = 1.25, 0.3  # more that counts as 1
LEAST_CLOTH, MOSTLY_LESS = 0.55, 0.15  # less that counts as 1


@dataclass(frozen=True)
class Verdict:
    """What is said of a way when it is weighed against others."""

    category: str
    badness: float
    sure: float  # probability of the category, or of the likeliest one if it is "unknown"
    parts: int  # groups that only the category joins, or 1
    unseen: float  # share of the outline that no view shows
    size_m: tuple[float, float] = (0.0, 0.0)  # width and length; 0: none


@dataclass(frozen=True, eq=False)
class Tried:
    """One way to lay the item flat, and what it is then."""

    unfolded: Unfolded
    found: Recognition
    aside: float = 0.0  # share of the samples in large groups that were left out
    rival: str = ""  # another category for which other ways speak nearly as much
    contradicted: bool = False  # whether other ways have other sizes than its parts make
    rotation: RotationConfig = RotationConfig()  # by which it was laid flat

    def weighed_again(self, found: Recognition) -> Tried:
        """The same with the category that it has once its loose parts were turned."""
        again = replace(self.found, category=found.category, probabilities=found.probabilities)
        won = self.rival == found.category
        return replace(self, found=again, rival="" if won else self.rival)

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

    @cached_property
    def torn(self) -> float:
        """Share of the category's seams along which front and back hang apart."""
        if self.found.fit is None:
            return 0.0
        template = self.found.fit.template
        outline = self.found.fit.points()[: template.vertices]
        return torn_share(self.unfolded.points, self.unfolded.side, outline, template.seam)

    @cached_property
    def missing(self) -> float:
        """Share of the category's area in which there is nothing, seen or hidden."""
        if self.found.fit is None:
            return 0.0
        return missing_share(self.unfolded.outline, self.found.fit)

    @cached_property
    def hidden(self) -> float:
        """Share of the category's area that no view shows, where only it joins several parts."""
        if self.found.fit is None or len(self.unfolded.parts) == 1:
            return 0.0
        return 1.0 - covered(self.found.fit, self.unfolded.points)

    @cached_property
    def cloth(self) -> float:
        """Cloth that was seen, laid flat or left out, as a share of the category's front and back.

        There is a sample to every square of `spacing_m`. A leg by itself looks like a skirt, but
        one with less cloth than was seen; of one laid out too wide most would have been hidden.
        """
        if self.found.fit is None:
            return 0.0
        seen = len(self.unfolded.points.uv) / self.unfolded.share
        return float(seen * self.rotation.spacing_m**2 / (2.0 * _area_m2(self.found.fit)))

    @cached_property
    def creased(self) -> float:
        """Share of near pairs on one sheet that fall short as across a crease."""
        parts = self.unfolded.parts
        return max(creased(p.plane, p.distances.bound_m, p.distances.same_sheet) for p in parts)

    @property
    def apart_sigma_m(self) -> float:
        """How uncertain an end is by where parts lie that only the category joins, m."""
        if len(self.unfolded.parts) == 1 or self.found.fit is None:
            return 0.0
        strip_m = self.hidden * float(np.sqrt(_area_m2(self.found.fit)))
        single = self.found.fit.template.single_sheet
        return float(np.hypot(IN_FOLD_M if single else 0.0, OF_STRIP * strip_m))

    @property
    def size_sigma(self) -> float:
        """How uncertain sizes are as a share of them, the more the worse the item lies flat."""
        return float(np.hypot(OF_ANY_SIZE, OF_SIZE * max(0.0, self.badness)))

    @property
    def unseen(self) -> float:
        """Share of the outline that no view shows."""
        return float(self.unfolded.outline.inferred.mean())

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
        folded += min(max(0.0, self.creased - CREASED) / MOSTLY_CREASED, WORST_CREASED)
        folded += max(0.0, self.doubled - MISLAID) / MOSTLY_DOUBLED
        folded += max(0.0, self.torn - TORN) / MOSTLY_TORN
        left_out = max(0.0, 1.0 - self.unfolded.share - STRAYS) / MOSTLY_LEFT
        explained = self.found.fit.explained if self.found.fit is not None else 0.0
        odd = max(0.0, EXPLAINED - explained) / MOSTLY_ODD
        if self.deep_m > MOST_DEEP_M:
            odd += ODD
        odd += max(0.0, self.missing - MISSING) / MOSTLY_MISSING
        odd += max(0.0, self.cloth - MOST_CLOTH) / MOSTLY_MORE
        odd += max(0.0, LEAST_CLOTH - self.cloth) / MOSTLY_LESS
        if len(self.unfolded.parts) > 1:
            between = max(0.0, 1.0 - self.unfolded.share - BETWEEN) / MOSTLY_BETWEEN
            left_out += min(between, WORST_BETWEEN)
        left_out += ASIDE * self.aside
        left_out += max(0.0, self.unseen - UNSEEN) / MOSTLY_UNSEEN
        left_out += max(0.0, self.hidden - HIDDEN) / MOSTLY_HIDDEN
        unknown = float(self.found.category == UNKNOWN)
        return float(misfit + folded + left_out + odd + 1.0 - self.sure + unknown)

    @property
    def sure(self) -> float:
        """Probability of its category; of the likeliest, if that is "unknown"."""
        known = {name: p for name, p in self.found.probabilities.items() if name != UNKNOWN}
        return known.get(self.found.category, max(known.values(), default=0.0))

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and length, m; 0 without an outline."""
        fit = self.found.fit
        if fit is None:
            return 0.0, 0.0
        found = fit.template.measure(fit.state, fit.covariance[3:, 3:])
        return found["width"][0], found["length"][0]

    @property
    def verdict(self) -> Verdict:
        """All that is needed of it beside other ways."""
        return Verdict(
            category=self.found.category,
            badness=self.badness,
            sure=self.sure,
            parts=len(self.unfolded.parts),
            unseen=self.unseen,
            size_m=self.size_m,
        )

    @property
    def untrusted(self) -> str:
        """Why the result is not to be trusted; empty: it may be."""
        if self.badness > DOUBTFUL:
            return f"no category fits the item well, or it does not lie flat ({self.badness:.1f})"
        if self.sure < UNSURE:
            return f"it is only {self.sure:.0%} likely to be what it most looks like"
        if self.rival:
            return f"laid flat in other ways it is nearly as good a {self.rival}"
        if self.contradicted:
            return "only its category joins its parts, and in other ways it has other sizes"
        return ""


def _area_m2(fit: Fit) -> float:
    """What the outline of a category encloses."""
    return 0.5 * float(abs(twice_area(fit.points()[: fit.template.vertices])))


def settled(tries: Sequence[Verdict]) -> bool:
    """Whether what was tried is good enough, undisputed, and one way alone beyond doubt."""
    if not tries:
        return False
    best = best_of(tries)
    known = [one for one in tries if one.category != UNKNOWN]
    near = [one for one in known if one.badness < best.badness + RIVAL]
    against = sum(one.category != best.category for one in near)
    agreed = len(near) - against >= MAJORITY * against
    limit = DOUBTFUL
    if not agreed or best.sure < UNDECIDED:
        limit = DISPUTED + YIELDING * max(0, len(tries) - 2)
    elif best.parts > 1:
        limit = PLACED + YIELDING * max(0, len(tries) - 2)
    if best.badness >= limit or contradicted(best, tries):
        return False
    return len(tries) > 1 or (best.sure >= SURE and best.unseen < MOST_UNSEEN)


def rival(tries: Sequence[Verdict]) -> str:
    """Another category that has nearly as many votes as the best way's; or none."""
    votes = _votes(tries)
    mine = votes.pop(best_of(tries).category)
    votes.pop(UNKNOWN, None)
    other = max(votes, key=lambda name: votes[name], default="")
    return other if other and votes[other] > NEAR_TIE * mine else ""


def _votes(tries: Sequence[Verdict]) -> dict[str, float]:
    """How much speaks for each category: the better a way to it, and the more ways, the more."""
    least = min(one.badness for one in tries)
    votes: dict[str, float] = {}
    for one in tries:
        vote = 1.0 if one.badness == least else float(np.exp(VOTE * (least - one.badness)))
        votes[one.category] = votes.get(one.category, 0.0) + vote
    return votes


def best_of(tries: Sequence[Verdict]) -> Verdict:
    """The best way, to the category with most votes.

    If none is to be trusted, the one that others of the category agree with in size: a wrong way
    is wrong in its own manner, and what lies badly may still have the right size. For the same
    reason, where ways of one piece agree on other sizes than one in parts, the best of these.
    """
    votes = _votes(tries)
    category = max(votes, key=lambda name: votes[name])
    alike = [one for one in tries if one.category == category]
    best = min(alike, key=lambda one: one.badness)
    if category == UNKNOWN:
        return best
    if contradicted(best, tries):
        whole = [one for one in _weighable(best, tries) if one.parts == 1]
        agreed = [one for one in whole if any(_near(one, o, AGREE) for o in whole if o is not one)]
        if agreed:
            return min(agreed, key=lambda one: one.badness)
    if best.badness <= DOUBTFUL:
        return best
    return max(alike, key=lambda one: _agreeing(one, alike))


def contradicted(best: Verdict, tries: Sequence[Verdict]) -> bool:
    """Whether a way's parts are joined by its category alone, and others have other sizes.

    Nothing tells how far apart such parts lie, so one other way has to have the same sizes, if any
    may be compared.
    """
    others = _weighable(best, tries) if best.parts > 1 else []
    return bool(others) and not any(_near(one, best, CONFIRM) for one in others)


def _weighable(best: Verdict, tries: Sequence[Verdict]) -> list[Verdict]:
    """Other ways to a category whose sizes may be compared with those of its best."""
    return [
        one
        for one in tries
        if one is not best
        and one.category == best.category
        and one.badness < best.badness + AGAINST
        and 0.0 not in one.size_m
    ]


def _near(one: Verdict, other: Verdict, share: float) -> bool:
    """Whether both sizes of two ways differ by no more than a share of them."""
    return bool(np.all(np.abs(np.log(np.divide(one.size_m, other.size_m))) < share))


def _agreeing(one: Verdict, alike: Sequence[Verdict]) -> float:
    """How much speaks for a way's sizes: its own vote, and of others as far as theirs are alike."""
    if 0.0 in one.size_m:
        return 0.0
    least = min(each.badness for each in alike)
    said = [each for each in alike if 0.0 not in each.size_m]
    ratio = np.array([each.size_m for each in said]) / one.size_m
    off = ((np.log(ratio) / AGREE) ** 2).sum(axis=1)
    vote = np.exp(least - np.array([each.badness for each in said]))
    return float(vote @ np.exp(-0.5 * off))
