"""Which of several ways to lay an item flat is the better one."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from flat import lying_at

from vflatten_ros.categories import load_templates
from vflatten_ros.core import hypotheses, ways
from vflatten_ros.core import tried as judging
from vflatten_ros.core.config import Config, RotationConfig
from vflatten_ros.core.errors import Cancelled, DisconnectedSurface
from vflatten_ros.core.recognition import Recognition
from vflatten_ros.core.tried import Tried


def part(creased):
    """Landmarks in a row, of which a share of the pairs lies half as far apart as on the cloth."""
    plane = np.column_stack([0.01 * np.arange(40.0), np.zeros(40)])
    bound = np.abs(plane[:, 0] - plane[:, :1])
    near = np.triu(np.ones(bound.shape, dtype=bool), 1)
    row, col = np.argwhere(near)[: round(creased * near.sum())].T
    bound[row, col] *= 2.0
    distances = SimpleNamespace(bound_m=bound, same_sheet=near)
    return SimpleNamespace(plane=plane, distances=distances)


def tried(
    share=1.0,
    overlap=0.0,
    category="towel",
    misfit=-0.5,
    explained=1.0,
    aside=0.0,
    sure=1.0,
    unseen=0.0,
    strain=0.0,
    parts=1,
    dent_m=0.0,
    doubled=None,
    hidden=0.0,
    torn_m=0.0,
    cloth=0.9,
    creased=0.0,
    size_m=(0.4, 0.4),
):
    """A towel of 0.4 x 0.4 m, or what is said of it; its upper edge may lie further in.

    With a share that is `doubled` it is a single sheet; `cloth` is how much of its two sides was
    seen, shown by 1000 samples and those that were left out.
    """
    square = np.array([[0.0, 0.0], [0.4, 0.0], [0.4, 0.4], [0.0, 0.4]])
    share_ = np.linspace(0.0, 1.0, 25, endpoint=False)[:, None]
    uv = np.vstack([a + share_ * (b - a) for a, b in zip(square, np.roll(square, -1, axis=0))])
    uv = np.minimum(uv, [0.4, 0.4 - dent_m])
    outline = SimpleNamespace(uv=uv, inferred=np.arange(100) < 100 * unseen)
    low = [0.4 * hidden, 0.0]
    points = lying_at(np.random.default_rng(0).uniform(low, 0.4, (1000, 2)))
    points.stress[:] = np.where(np.arange(1000) < 1000 * strain, 0.002, 0.0005)
    on_others = np.argsort(points.uv[:, 0])[: round(1000 * (doubled or 0.0))]
    points.xyz_hanger[on_others, 2] = 0.1 * np.arange(len(on_others))
    unfolded = SimpleNamespace(
        share=share,
        overlap=overlap,
        outline=outline,
        points=points,
        side=np.where(np.arange(1000) % 2, 1.0, -1.0),
        parts=(part(0.0),) * (parts - 1) + (part(creased),),
    )
    points.xyz_hanger[::2, 2] += torn_m
    likely, other = ("skirt", "towel") if category == "skirt" else ("towel", "skirt")
    found = SimpleNamespace(
        category=category,
        probabilities={likely: sure, other: 1.0 - sure, "unknown": 0.0},
        fit=SimpleNamespace(
            misfit=misfit,
            explained=explained,
            template=SimpleNamespace(
                vertices=4,
                single_sheet=doubled is not None,
                seam=np.array([False, True, False, True]) & (doubled is None),
                measure=lambda *_: {"width": (size_m[0], 0.01), "length": (size_m[1], 0.01)},
            ),
            state=np.zeros(2),
            covariance=np.eye(5),
            points=lambda: square,
        ),
    )
    spacing_m = math.sqrt(cloth * 2.0 * 0.4**2 * share / 1000)
    return Tried(unfolded, found, aside, rotation=RotationConfig(spacing_m=spacing_m))


def settled(tries):
    return judging.settled([one.verdict for one in tries])


def contradicted(best, tries):
    verdicts = [one.verdict for one in tries]
    return judging.contradicted(verdicts[tries.index(best)], verdicts)


def rival(tries):
    return judging.rival([one.verdict for one in tries])


def test_all_that_is_wrong_with_a_way_counts():
    good = tried().badness
    assert good == pytest.approx(-0.5)
    worse = [
        tried(share=0.7),
        tried(overlap=0.15),
        tried(category="unknown"),
        tried(misfit=0.2),
        tried(explained=0.7),
        tried(sure=0.5),
        tried(strain=0.2),
    ]
    assert all(way.badness > good + 0.4 for way in worse)
    as_any_result_has = tried(share=0.95, overlap=0.04, explained=0.96, strain=0.05)
    assert as_any_result_has.badness == good


def test_an_item_of_which_much_was_not_seen_is_worse():
    assert tried(unseen=0.19).badness == tried().badness
    assert tried(unseen=0.6).badness == pytest.approx(tried().badness + 1.6)
    assert tried(unseen=0.6).untrusted and not tried(unseen=0.25).untrusted


def test_a_way_that_tears_the_seams_of_its_category_is_worse():
    assert tried(torn_m=0.01).torn == tried().torn == 0.0
    assert tried(torn_m=0.2).torn == 1.0
    assert tried(torn_m=0.2).badness > tried().badness + 1.0


def test_a_way_that_gives_way_along_many_creases_is_worse_but_not_hopeless():
    assert tried(creased=0.03).badness == tried().badness
    assert tried(creased=0.05).badness == pytest.approx(tried().badness + 0.3, abs=0.02)
    assert tried(creased=0.05, parts=2).creased == pytest.approx(0.05, abs=0.001)
    round_tube = tried(creased=0.2)
    assert round_tube.badness == pytest.approx(tried().badness + 0.8)
    assert not tried(creased=0.2, misfit=-0.7).untrusted


def test_cloth_that_is_hidden_between_parts_counts_and_makes_sizes_uncertain():
    """In one part nothing is hidden inside the outline: what is missing there is told otherwise."""
    whole, little, much = (tried(parts=2, hidden=share) for share in (0.0, 0.08, 0.3))
    assert tried(hidden=0.3).badness == whole.badness == little.badness
    assert much.badness > whole.badness + 0.5
    assert much.hidden == pytest.approx(0.3, abs=0.05)
    assert tried(hidden=0.3).apart_sigma_m == 0.0
    assert whole.apart_sigma_m < 0.005  # points that lie at random leave gaps
    assert little.apart_sigma_m == pytest.approx(0.35 * 0.4 * little.hidden)
    assert 0.01 < little.apart_sigma_m < 0.4 * much.apart_sigma_m
    fold = tried(parts=2, doubled=0.0).apart_sigma_m  # of a single sheet
    assert fold == pytest.approx(np.hypot(0.03, whole.apart_sigma_m))


def test_what_is_left_out_of_an_item_in_parts_may_lie_between_them():
    shares = 0.85, 0.77, 0.5
    whole, parts = ([tried(parts=n, share=share) for share in shares] for n in (1, 2))
    more = [one.badness - other.badness for one, other in zip(parts, whole, strict=True)]
    assert more == pytest.approx([0.0, 0.3, 0.5])


def test_sizes_are_the_less_certain_the_worse_the_item_lies():
    assert tried().size_sigma == 0.005
    bad = tried(overlap=0.21, misfit=0.3)
    assert bad.badness > 1.0
    assert bad.size_sigma == pytest.approx(np.hypot(0.005, 0.05 * bad.badness))


def test_a_single_sheet_lies_on_no_other_cloth_of_its_own():
    garment = tried().badness
    assert 0.0 < tried(doubled=0.01).doubled < 0.06
    assert tried(doubled=0.01).badness == garment
    assert tried(doubled=0.12).badness > garment + 0.4


def test_a_large_piece_left_aside_is_worse_than_as_many_shreds():
    shreds, piece = tried(share=0.75), tried(share=0.75, aside=0.2)
    assert piece.badness > shreds.badness + 0.3


def test_a_category_has_about_as_much_cloth_as_was_seen():
    assert tried(cloth=0.7, share=0.5).cloth == pytest.approx(0.7)  # what is left out was seen, too
    for share in (1.0, 0.5):
        odd = [
            tried(cloth=cloth, share=share).badness - tried(share=share).badness
            for cloth in (0.6, 1.2, 2.0, 0.4)
        ]
        assert odd == pytest.approx([0.0, 0.0, 2.5, 1.0])


def test_a_way_that_fits_nothing_is_the_worst():
    nothing = Tried(
        tried().unfolded,
        SimpleNamespace(category="unknown", probabilities={"unknown": 1.0}, fit=None),
    )
    assert nothing.badness == float("inf")


def test_one_good_way_settles_it_unless_the_category_or_much_of_the_outline_is_unsure():
    good, unsure, bad = tried(misfit=-0.5), tried(misfit=-0.5, sure=0.95), tried(misfit=0.5)
    assert settled([good])
    assert not settled([unsure]) and not settled([tried(unseen=0.2)])
    assert settled([tried(unseen=0.1)])
    assert settled([bad, unsure]) and settled([unsure, good])
    assert not settled([bad]) and not settled([bad, bad])
    assert not settled([])


def test_ways_that_disagree_settle_it_only_if_one_is_much_better():
    good, other = tried(misfit=-0.3), tried(misfit=0.6, category="skirt")
    assert settled([good, tried(misfit=0.6)]) and not settled([good, other])
    assert settled([tried(misfit=-0.6), other])
    assert settled([good, tried(misfit=1.5, category="skirt")])  # no rival: far worse
    assert settled([good, tried(misfit=0.6, category="unknown")])
    assert not settled([tried(misfit=-0.4, sure=0.85), tried(misfit=0.6)])
    assert settled([tried(misfit=-0.7, sure=0.85), tried(misfit=0.6)])


def test_groups_that_only_their_category_joins_are_believed_if_they_fit_well():
    bad = tried(misfit=0.5)
    assert settled([bad, tried(misfit=-0.3)]) and not settled([bad, tried(misfit=-0.3, parts=2)])
    assert settled([bad, tried(misfit=-0.6, parts=2)])


def test_two_ways_outvote_one_that_disagrees():
    good, like, other = tried(misfit=-0.3), tried(misfit=0.2), tried(misfit=0.6, category="skirt")
    assert not settled([good, other])
    assert settled([good, like, other])
    assert not settled([tried(misfit=0.0), like, like, other, other])
    assert not settled([good, tried(misfit=1.5), other])  # too bad a way to count
    assert not settled([tried(misfit=-0.3, sure=0.85), like, other])


def test_if_no_way_is_to_be_trusted_the_one_whose_sizes_others_agree_with_is_best():
    """A wrong way is wrong in its own manner; one that lies well needs no others."""
    short = tried(misfit=0.6, size_m=(0.4, 0.26))
    right = [tried(misfit=1.0, size_m=(0.4, 0.4)), tried(misfit=1.1, size_m=(0.41, 0.4))]

    def best(*ways):
        return judging.best_of([one.verdict for one in ways]).size_m

    assert best(short, *right) == (0.4, 0.4)
    assert best(short, right[0]) == (0.4, 0.26)  # nobody agrees with either
    assert best(short, right[0], tried(misfit=1.1, size_m=(0.5, 0.4))) == (0.4, 0.26)
    assert best(short, tried(misfit=2.0), tried(misfit=2.0)) == (0.4, 0.26)  # far worse
    assert best(short, right[0], tried(misfit=1.0, category="skirt")) == (0.4, 0.26)
    trusted = tried(misfit=0.1, size_m=(0.4, 0.26))
    assert best(trusted, *right, *right) == (0.4, 0.26)
    unlike = tried(misfit=1.0, category="unknown")  # sizes of nothing in particular
    assert best(tried(misfit=0.6, category="unknown", size_m=(0.4, 0.26)), unlike, unlike) == (
        0.4,
        0.26,
    )


def test_sizes_of_parts_that_only_the_category_joins_need_another_way_that_has_them():
    """Nothing else tells how far apart they lie."""
    long = tried(misfit=-0.6, parts=2, size_m=(0.4, 0.5))
    other = tried(misfit=3.0, size_m=(0.4, 0.4))
    assert settled([tried(misfit=9.0), long])  # nothing that it may be compared with
    assert settled([tried(misfit=0.9, category="unknown"), long])
    assert not settled([other, long]) and not contradicted(other, [other, long])
    assert contradicted(long, [other, long])
    assert settled([other, tried(misfit=3.0, size_m=(0.41, 0.51)), long])  # one confirms them
    assert settled([other, tried(misfit=-0.6, size_m=(0.4, 0.5))])  # of one piece
    assert not contradicted(long, [long]) and not contradicted(long, [long, long])
    text = replace(tried(), contradicted=True).untrusted
    assert "only its category joins its parts" in text and not tried().untrusted


def test_ways_of_one_piece_that_agree_outweigh_parts_whose_sizes_they_contradict():
    long = tried(misfit=-0.6, parts=2, size_m=(0.4, 0.5))
    whole = [tried(misfit=3.0, size_m=(0.4, 0.4)), tried(misfit=2.0, size_m=(0.405, 0.405))]

    def best(*ways):
        return judging.best_of([one.verdict for one in ways]).size_m

    assert best(long, *whole) == (0.405, 0.405)
    assert best(long, whole[0]) == best(long, whole[1]) == (0.4, 0.5)  # nobody agrees with it
    assert best(long, whole[0], tried(misfit=2.0, size_m=(0.4, 0.42))) == (0.4, 0.5)
    in_parts = [tried(misfit=2.0, size_m=(0.4, 0.4), parts=2)] * 2
    assert best(long, *in_parts) == (0.4, 0.5)
    bad = tried(misfit=0.6, parts=2, size_m=(0.4, 0.5))  # none is to be trusted: the vote counts
    assert best(bad, *[tried(misfit=1.0, size_m=(0.4, 0.4), parts=2)] * 2) == (0.4, 0.4)
    assert best(long, *whole, tried(misfit=1.0, size_m=(0.41, 0.49))) == (0.4, 0.5)


def test_a_way_is_as_sure_as_its_own_category_is_likely():
    """Parts may be placed as another than the likeliest category has them, and fit it better."""
    likely = tried(sure=0.9)
    less = replace(likely, found=SimpleNamespace(**{**vars(likely.found), "category": "skirt"}))
    assert likely.sure == 0.9 and less.sure == pytest.approx(0.1)
    assert less.badness == pytest.approx(likely.badness + 0.8, abs=0.01)
    unknown = SimpleNamespace(**{**vars(likely.found), "category": "unknown"})
    assert replace(likely, found=unknown).sure == 0.9


def test_the_best_way_is_of_the_category_that_most_speaks_for(method, monkeypatch):
    """Two ways to a towel count more than one to a skirt that is a little better, not much."""
    results = iter([tried(misfit=0.7, category="skirt"), tried(misfit=0.8), tried(misfit=0.9)])
    monkeypatch.setattr(ways._Draw, "tried", lambda *_: next(results))
    three = replace(Config(), rotation=RotationConfig(ways=3))
    best = hypotheses.likeliest(0, (), three, lambda *_: None)
    assert best.found.category == "towel" and best.found.fit.misfit == 0.8
    assert best.rival == "skirt"
    results = iter([tried(misfit=0.4, category="skirt"), tried(misfit=1.2), tried(misfit=1.3)])
    best = hypotheses.likeliest(0, (), three, lambda *_: None)
    assert best.found.category == "skirt" and best.rival == ""


def test_parts_whose_sizes_other_ways_contradict_are_not_trusted(method, monkeypatch):
    long = tried(misfit=-0.2, parts=2, size_m=(0.4, 0.5))
    three = replace(Config(), rotation=RotationConfig(ways=3))
    for sizes, wrong in (((0.4, 0.4), True), ((0.4, 0.5), False)):
        others = [tried(misfit=2.0, size_m=sizes), tried(misfit=2.0, size_m=(0.5, 0.4))]
        results = iter([*others, long])
        monkeypatch.setattr(ways._Draw, "tried", lambda *_, left=results: next(left))
        best = hypotheses.likeliest(0, (), three, lambda *_: None)
        assert best.found is long.found and best.contradicted == wrong


def test_a_category_weighed_again_is_the_one_that_counts():
    """Trousers whose legs were turned may turn out to be shorts."""
    one, none = tried(), np.zeros((0, 2))
    found = Recognition("skirt", {}, {"skirt": 0.6, "towel": 0.4}, one.found.fit, none, none, {})
    before = replace(one, found=found, rival="towel")
    after = before.weighed_again(replace(found, category="towel"))
    assert after.found.category == "towel" and after.found.fit is found.fit
    assert (before.sure, after.sure) == (0.6, 0.4) and (before.rival, after.rival) == ("towel", "")
    assert before.weighed_again(found).rival == "towel"


def test_the_more_ways_were_tried_the_less_a_dispute_counts():
    placed, hopeless = tried(misfit=-0.3, parts=2), tried(misfit=2.0)
    assert not settled([placed, hopeless]) and settled([placed, hopeless, hopeless])
    unsure = tried(misfit=-0.45, sure=0.85)
    assert not settled([unsure, hopeless]) and not settled([unsure, *[hopeless] * 2])
    assert settled([unsure, *[hopeless] * 3])
    assert not settled([tried(misfit=0.28, parts=2), *[hopeless] * 5])


def test_an_outline_that_lies_deep_inside_its_category_is_odd():
    assert tried(dent_m=0.02).badness == tried().badness
    gone = (0.06 / 0.4 - judging.MISSING) / judging.MOSTLY_MISSING  # of its area
    assert tried(dent_m=0.06).badness == pytest.approx(tried().badness + gone + 0.5, abs=0.1)
    there = tried(unseen=1.0).badness  # no edge was seen
    assert tried(dent_m=0.06, unseen=1.0).badness == pytest.approx(there + gone, abs=0.1)


def test_a_bad_way_and_a_near_tie_of_categories_are_not_to_be_trusted():
    assert not tried().untrusted and not tried(sure=0.92).untrusted
    assert "does not lie flat" in tried(overlap=0.2).untrusted
    assert "85% likely" in tried(sure=0.85, misfit=-0.9).untrusted
    near, farther = tried(misfit=-0.4, category="skirt"), tried(misfit=-0.2, category="skirt")
    assert rival([tried(), near]) == "skirt"
    assert rival([tried(), farther, tried(misfit=-0.4, category="unknown")]) == ""
    assert rival([tried()]) == rival([tried(), tried(misfit=-0.4)]) == ""
    assert "nearly as good a skirt" in replace(tried(), rival="skirt").untrusted


@dataclass(frozen=True)
class Linked:
    draw: int
    doubt: float = 0.0


@pytest.fixture
def method(monkeypatch):
    """The stages replaced by notes of what they were called with."""
    noted = SimpleNamespace(ramps=[], found=[], drawn=[], misfit={}, configs=[])

    def drawn_again(fused, draw, *_):
        noted.drawn.append(draw)
        return draw

    def linked(fused, config, *_):
        noted.configs.append(config)
        return Linked(fused)

    def recognised(surface, *_):
        noted.found.append(surface)
        return tried(misfit=noted.misfit.get(surface.draw, 0.5))

    monkeypatch.setattr(ways, "drawn_again", drawn_again)
    monkeypatch.setattr(ways, "link_surface", linked)
    monkeypatch.setattr(ways, "doubts", lambda *_: noted.ramps.append(1) or 2.0)
    monkeypatch.setattr(ways, "unfold_surface", lambda surface, *_: surface)
    monkeypatch.setattr(ways, "group_pieces", lambda surface, *_: surface)
    monkeypatch.setattr(ways, "cut_at_neck", lambda surface, *_: surface)
    monkeypatch.setattr(ways, "_recognised", recognised)
    monkeypatch.setattr(ways, "hem_within", lambda *_: None)
    monkeypatch.setattr(ways._Draw, "_from_groups", lambda _, one, progress: recognised(one))
    return noted


@pytest.mark.parametrize(("misfit", "looked"), [(-0.5, 0), (0.5, 1)])
def test_ramps_are_looked_for_once_and_only_where_the_first_way_does_not_settle_it(
    method, misfit, looked
):
    method.misfit = {0: misfit}
    four = replace(Config(), rotation=RotationConfig(ways=4))
    hypotheses.likeliest(0, (), four, lambda *_: None)
    assert len(method.ramps) == looked
    doubts = [0.0, 0.0, 2.0, 2.0]  # the second way cuts what nobody doubts
    assert [surface.doubt for surface in method.found] == doubts[: len(method.found)]
    assert len(method.found) == 1 + 3 * looked


def test_samples_are_drawn_again_once_and_only_where_those_before_do_not_settle_it(
    monkeypatch, method
):
    method.misfit = {0: 0.5, 1: 0.4, 2: -0.5}
    order = ((0, np.inf), (1, np.inf), (1, 1.0), (2, np.inf), (3, np.inf))
    monkeypatch.setattr(ways, "WAYS", order)
    five = replace(Config(), rotation=RotationConfig(ways=5))
    best = hypotheses.likeliest(0, (), five, lambda *_: None)
    assert method.drawn == [1, 2]
    assert [surface.draw for surface in method.found] == [0, 1, 1, 2]
    assert best.found.fit.misfit == -0.5


def test_what_is_drawn_again_is_denser_and_flattened_further_as_such(method):
    method.misfit = {0: 0.5, 1: -0.5}
    best = hypotheses.likeliest(0, (), Config(), lambda *_: None)
    first = RotationConfig()
    denser = replace(
        first,
        spacing_m=ways.FINER * first.spacing_m,
        link_m=ways.FINER * first.link_m,
    )
    assert best.found.fit.misfit == -0.5
    assert method.configs == [first, denser]
    least = ways.finer(RotationConfig(spacing_m=0.001, link_m=0.0021))
    assert (least.spacing_m, least.link_m) == (0.001, 0.002)


def test_no_more_ways_are_tried_than_asked(method):
    few = replace(Config(), rotation=RotationConfig(ways=3))
    hypotheses.likeliest(0, (), few, lambda *_: None)
    assert len(method.found) == 3
    hypotheses.likeliest(0, (), Config(), lambda *_: None)
    assert len(method.found) == 3 + len(ways.WAYS)


def test_all_ways_can_be_asked_for():
    (option,) = (f for f in dataclasses.fields(RotationConfig) if f.name == "ways")
    assert option.metadata["high"] == option.default == len(ways.WAYS)


@dataclass
class Beside:
    """A helper that is through with a way whenever it was asked some times; or gone after some."""

    misfits: dict[int, float]
    lives: int = 99  # ways that it gets through
    slow: int = 1  # questions for each
    ready: bool = True
    hears: bool = True  # what it is not to try
    gives: bool = True  # what it laid flat
    fails: tuple[int, ...] = ()

    def begin(self, task, order):
        self.order, self.done, self.log, self.asked = list(order), {}, ["begin"], 0

    def said(self):
        self.asked += 1
        if self.at() is not None and self.asked % self.slow == 0:
            self.lives -= 1
            way = self.order.pop(0)
            failure = DisconnectedSurface(f"way {way}")
            misfit = self.misfits.get(way, 0.5)
            self.done[way] = failure if way in self.fails else tried(misfit=misfit).verdict
        return self.done

    def at(self):
        return self.order[0] if self.ready and self.order and self.lives > 0 else None

    def leave(self, way):
        if self.hears and way in self.order:
            self.order.remove(way)

    def wait(self):
        self.log.append("wait")
        return "unfold", 0.5

    def laid_flat(self, way):
        self.log.append(way)
        return tried(misfit=self.misfits.get(way, 0.5)) if self.gives else None

    def end(self):
        self.log.append("end")


@pytest.fixture
def numbered(monkeypatch):
    """Ways that are good or bad as said by their numbers, and which were tried."""
    noted = SimpleNamespace(misfits={}, fails=(), tried=[])

    def verdict(_, way, progress):
        noted.tried.append(way)
        progress("unfold", 0.0)
        if way in noted.fails:
            return DisconnectedSurface(f"way {way}")
        return tried(misfit=noted.misfits.get(way, 0.5)).verdict

    def laid_flat(_, way, progress):
        progress("unfold", 1.0)
        return tried(misfit=noted.misfits.get(way, 0.5))

    monkeypatch.setattr(hypotheses.Ways, "verdict", verdict)
    monkeypatch.setattr(hypotheses.Ways, "laid_flat", laid_flat)
    return noted


def search(helper, progress=lambda *_: None):
    return hypotheses.likeliest(0, (), Config(), progress, helper)


@pytest.mark.parametrize("good", range(6))
@pytest.mark.parametrize(
    "how",
    [{}, {"lives": 0}, {"lives": 1}, {"lives": 3}, {"ready": False}, {"hears": False},
     {"gives": False}],
)  # fmt: skip
def test_a_helper_changes_nothing_but_who_does_what(numbered, good, how):
    """Way `good` settles it; ways after it are better, and would win if they counted."""
    numbered.misfits = {way: -0.6 - 0.01 * way if way >= good else 0.5 for way in range(6)}
    numbered.misfits[0] = -0.6 if good == 0 else 0.6
    alone = search(None)
    assert alone.found.fit.misfit == numbered.misfits[good]
    assert numbered.tried == list(range(good + 1))
    numbered.tried.clear()
    beside = Beside(numbered.misfits, **how)
    both = search(beside)
    assert both.found.fit.misfit == alone.found.fit.misfit and both.rival == alone.rival
    assert beside.log[-1] == "end"
    assert len(set(numbered.tried)) == len(numbered.tried)
    if not how and good > 2:
        assert len(numbered.tried) < good + 1  # it did some


def test_ways_that_lead_nowhere_count_for_nothing_whoever_tried_them(numbered):
    numbered.misfits, numbered.fails = {4: -0.6}, (0, 1, 2, 3)
    assert search(None).found.fit.misfit == -0.6
    assert search(Beside(numbered.misfits, fails=(2, 3))).found.fit.misfit == -0.6
    numbered.fails = range(len(ways.WAYS))
    for helper in (None, Beside({}, fails=range(len(ways.WAYS)))):
        with pytest.raises(DisconnectedSurface, match="way 0"):
            search(helper)


def test_what_the_helper_settles_ends_the_way_that_is_being_tried(numbered, monkeypatch):
    """The caller is at way 4, since the helper is at 3, which turns out to be good."""
    misfits, ended = {3: -0.9}, []

    def verdict(_, way, progress):
        numbered.tried.append(way)
        for _ in range(9):
            progress("unfold", 0.0)
        ended.append(way)
        return tried(misfit=misfits.get(way, 0.5)).verdict

    monkeypatch.setattr(hypotheses.Ways, "verdict", verdict)
    assert search(Beside(misfits, slow=15)).found.fit.misfit == -0.9
    assert numbered.tried == [0, 2, 4] and ended == [0, 2]


def test_what_the_caller_tries_is_left_to_it(numbered):
    """While the helper is at a way, the caller goes on to the next: seven ways, each tried once."""
    helper = Beside({}, slow=3)
    search(helper)
    assert sorted([*numbered.tried, *helper.done]) == list(range(len(ways.WAYS)))
    assert numbered.tried == [0, 3, 4, 6]


def test_the_helper_is_stopped_when_the_caller_stops(numbered):
    helper = Beside({}, lives=0)

    def cancel(*_):
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        search(helper, cancel)
    assert helper.log == ["begin", "end"]


def placed(monkeypatch, costs, legs=False, even=0.0):
    """The best that comes of two groups, and by which categories they were laid beside."""
    known = {template.category: template for template in load_templates()}
    placings = [
        SimpleNamespace(
            template=known[name],
            cost=cost,
            motions=(),
            outline=np.zeros((4, 2)),
            pose=np.zeros(3),
            state=np.zeros(known[name].dimensions),
        )
        for name, cost in costs.items()
    ]
    seen = []

    def recognised(unfolded, templates, config, progress, begin=None):
        seen.append(tuple(t.category for t in templates))
        one = tried(category=templates[0].category, misfit=-0.4 if begin else 0.5)
        none = np.zeros((0, 2))
        found = Recognition(
            **vars(one.found), scores={}, template_uv=none, template_seen=none > 0, fits={}
        )
        return replace(one, found=found)

    monkeypatch.setattr(ways, "link_surface", lambda *_: SimpleNamespace(even=even))
    group = SimpleNamespace(points=None, side=None, outline=None)
    monkeypatch.setattr(ways, "unfold_group", lambda *_: group)
    monkeypatch.setattr(ways, "Group", lambda *_: None)
    monkeypatch.setattr(ways, "place_groups", lambda *_: placings)
    monkeypatch.setattr(ways, "turned_over", lambda *_: [])
    monkeypatch.setattr(ways, "put_beside", lambda *_: "beside")
    monkeypatch.setattr(ways, "axes_of", lambda *_: ())
    monkeypatch.setattr(ways, "parted", lambda *_: ("parted", 0.9) if legs else None)
    monkeypatch.setattr(ways, "_recognised", recognised)
    draw = ways._Draw(ways.Task(0, tuple(known.values()), Config()), 0, lambda *_: None)
    grouped = SimpleNamespace(masks=(np.ones(9, dtype=bool), np.ones(9, dtype=bool)))
    return draw._from_groups(grouped, lambda *_: None), seen


@pytest.mark.parametrize("legs", [False, True])
def test_groups_that_lie_like_a_skirt_and_are_legs_are_none(monkeypatch, legs):
    """A category that they rule out takes no probability from the others either."""
    best, seen = placed(monkeypatch, {"skirt": 0.0, "shorts": 1.0}, legs)
    shorts = best.found.probabilities.get("shorts", 0.0)
    if legs:
        assert ("skirt",) not in seen and shorts == pytest.approx(1.0)
    else:
        assert ("skirt",) in seen and shorts == pytest.approx(1.0 / (1.0 + np.e))


def test_groups_of_one_cloth_are_a_towel_though_they_lie_as_well_like_a_skirt(monkeypatch):
    costs = {"skirt": 0.0, "towel": 2.0}
    assert placed(monkeypatch, costs)[0].found.category == "skirt"
    best, seen = placed(monkeypatch, costs, even=0.83)
    assert ("skirt",) not in seen  # it could be the less bad
    assert best.found.category == "towel"
    assert best.sure == best.found.probabilities["towel"] > 0.9
