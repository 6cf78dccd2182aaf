"""Which of several ways to lay an item flat is the better one."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from vflatten_ros.core import hypotheses
from vflatten_ros.core.config import Config
from vflatten_ros.core.hypotheses import Tried, settled


def tried(
    share=1.0,
    overlap=0.0,
    category="towel",
    misfit=-0.5,
    explained=1.0,
    aside=0.0,
    sure=1.0,
    unseen=0.0,
):
    outline = SimpleNamespace(inferred=np.arange(100) < 100 * unseen)
    unfolded = SimpleNamespace(share=share, overlap=overlap, outline=outline)
    found = SimpleNamespace(
        category=category,
        probabilities={"towel": sure, "skirt": 1.0 - sure, "unknown": 0.0},
        fit=SimpleNamespace(misfit=misfit, explained=explained),
    )
    return Tried(unfolded, found, aside)


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
    ]
    assert all(way.badness > good + 0.4 for way in worse)
    assert tried(share=0.95, overlap=0.04, explained=0.96).badness == good  # as any result has


def test_a_large_piece_left_aside_is_worse_than_as_many_shreds():
    shreds, piece = tried(share=0.75), tried(share=0.75, aside=0.2)
    assert piece.badness > shreds.badness + 0.3


def test_a_way_that_fits_nothing_is_the_worst():
    nothing = Tried(
        SimpleNamespace(share=1.0, overlap=0.0),
        SimpleNamespace(category="unknown", probabilities={"unknown": 1.0}, fit=None),
    )
    assert nothing.badness == float("inf")


def test_one_good_way_settles_it_unless_the_category_or_much_of_the_outline_is_unsure():
    good, unsure, bad = tried(misfit=-0.5), tried(misfit=-0.5, sure=0.9), tried(misfit=0.5)
    assert settled([good], -0.15)
    assert not settled([unsure], -0.15) and not settled([tried(unseen=0.2)], -0.15)
    assert settled([tried(unseen=0.1)], -0.15)
    assert settled([bad, unsure], -0.15) and settled([unsure, good], -0.15)
    assert not settled([bad], -0.15) and not settled([bad, bad], -0.15)
    assert not settled([], -0.15)


def test_a_bad_way_and_a_near_tie_of_categories_are_not_to_be_trusted():
    assert not tried().untrusted and not tried(sure=0.75).untrusted
    assert "does not lie flat" in tried(overlap=0.2).untrusted
    assert "60% likely" in tried(sure=0.6, misfit=-0.9).untrusted


@dataclass(frozen=True)
class Linked:
    doubt: float = 0.0


@pytest.mark.parametrize(("misfit", "looked"), [(-0.5, 0), (0.5, 1)])
def test_ramps_are_looked_for_once_and_only_where_the_first_way_does_not_settle_it(
    monkeypatch, misfit, looked
):
    made, found = [], []
    monkeypatch.setattr(hypotheses, "link_surface", lambda *_: Linked())
    monkeypatch.setattr(hypotheses, "doubts", lambda *_: made.append(1) or 2.0)
    monkeypatch.setattr(hypotheses, "unfold_surface", lambda surface, *_: found.append(surface))
    monkeypatch.setattr(hypotheses, "_recognised", lambda *_: tried(misfit=misfit))
    whole = [way for way in hypotheses.WAYS if way[0] == hypotheses.WHOLE]
    monkeypatch.setattr(hypotheses, "WAYS", (*whole, whole[-1]))
    hypotheses.likeliest(None, (), Config(), lambda *_: None)
    assert len(made) == looked
    assert [surface.doubt for surface in found] == [0.0, 2.0, 2.0][: len(found)]
    assert len(found) == 1 + 2 * looked
