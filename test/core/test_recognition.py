"""Which category an outline is."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from flat import lying_at

from vflatten_ros.categories import load_templates
from vflatten_ros.core.config import RecognitionConfig
from vflatten_ros.core.recognition import recognise, recognise_again
from vflatten_ros.core.values import Outline

STEP_M = 0.004
TEMPLATES = load_templates()


def along(corners):
    """Evenly spaced points of a polygon."""
    after = np.roll(corners, -1, axis=0)
    length = np.linalg.norm(after - corners, axis=1)
    return np.vstack(
        [
            a + np.arange(0.0, 1.0, STEP_M / n)[:, None] * (b - a)
            for a, b, n in zip(corners, after, length, strict=True)
        ]
    )


def drawn(corners):
    """A seen outline, and points on it."""
    line = along(np.array(corners))
    n = len(line)
    outline = Outline(line, np.full(n, 0.004), np.zeros(n, dtype=bool))
    return outline, lying_at(line, 0.004)


def found(corners):
    return recognise(*drawn(corners), TEMPLATES, RecognitionConfig())


def test_a_wide_notch_between_straight_legs_is_no_error_of_a_skirt():
    skirt = [[0, 0], [0.37, 0], [0.355, 0.38], [0.015, 0.38]]
    shorts = [
        [0, 0],
        [0.145, 0],
        [0.185, 0.14],
        [0.225, 0],
        [0.37, 0],
        [0.355, 0.38],
        [0.015, 0.38],
    ]
    assert found(skirt).category == "skirt"
    assert found(shorts).category == "shorts"


def test_a_fit_goes_on_from_where_it_was_when_its_notch_has_closed():
    """The waist, which is narrower in most shorts, is the wider end here."""
    shorts = [[0, 0], [0.14, 0], [0.17, 0.14], [0.2, 0], [0.34, 0], [0.36, 0.38], [-0.02, 0.38]]
    closed = [shorts[k] for k in (0, 4, 5, 6)]
    before = found(shorts)
    fit = recognise_again(before, *drawn(closed), TEMPLATES, RecognitionConfig()).fits["shorts"]
    crotch, waist = (fit.template.landmarks[name] for name in ("crotch", "waist_front"))
    up = fit.points()[waist] - fit.points()[crotch]
    assert up[1] > 0.1  # as it was; alone it would be fitted the other way round
    anew = recognise(*drawn(closed), TEMPLATES, RecognitionConfig()).fits["shorts"]
    assert (anew.points()[waist] - anew.points()[crotch])[1] < 0


@pytest.mark.parametrize("turned", [0.0, np.pi])
def test_a_category_is_fitted_from_where_its_groups_were_placed(turned):
    """Legs that touch look alike either way up; where the groups met, the placing knows."""
    closed = drawn([[0, 0], [0.34, 0], [0.36, 0.38], [-0.02, 0.38]])
    only = tuple(t for t in TEMPLATES if t.category == "shorts")
    anyhow = recognise(*closed, only, RecognitionConfig()).fits["shorts"]
    middle = np.array([0.17, 0.19])
    turn = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
    pose = np.r_[anyhow.pose[0] + turned, turn @ (anyhow.pose[1:] - middle) + middle]
    begin = {"shorts": (pose, anyhow.state)}
    fit = recognise(*closed, only, RecognitionConfig(), begin=begin).fits["shorts"]
    off = (fit.pose[0] - pose[0] + np.pi) % (2 * np.pi) - np.pi
    assert abs(off) < 0.2


def two_legs(inseam_m):
    """Shorts or trousers with a waist of 0.32 m and a rise of 0.22 m, by the length of the legs."""
    top = inseam_m + 0.22
    corners = [[0, 0], [0.16, 0], [0.17, inseam_m], [0.18, 0], [0.34, 0], [0.33, top], [0.01, top]]
    return drawn(corners)


def test_sizes_tell_shorts_from_trousers_once_the_legs_lie_right():
    config = RecognitionConfig()
    for was, length_m, then in (("shorts", 0.45, "trousers"), ("trousers", 0.2, "shorts")):
        before = recognise(*two_legs(0.32), TEMPLATES, config)
        both = {**before.probabilities, "shorts": 0.5, "trousers": 0.5}
        before = replace(before, category=was, fit=before.fits[was], probabilities=both)
        again = recognise_again(before, *two_legs(length_m), TEMPLATES, config)
        assert again.category == then
        assert again.probabilities[then] > 0.9
        assert sum(again.probabilities.values()) == pytest.approx(sum(both.values()))
        assert again.fit is again.fits[then]
        inseam = again.fit.template.size_values(again.fit.state)[2]
        assert inseam == pytest.approx(length_m, rel=0.05)


def test_what_another_process_recognised_is_recognised_again_to_the_same_bits():
    """Its templates are copies of ours."""
    config, item = RecognitionConfig(), two_legs(0.24)
    before = recognise(*two_legs(0.32), TEMPLATES, config)
    here = recognise_again(before, *item, TEMPLATES, config)
    there = recognise_again(deepcopy(before), *item, TEMPLATES, config)
    assert before.category in ("shorts", "trousers")  # with parts: fitted from where they were
    for name, fit in here.fits.items():
        assert there.fits[name].state.tobytes() == fit.state.tobytes()
        assert there.fits[name].pose.tobytes() == fit.pose.tobytes()
    assert there.probabilities == here.probabilities


def test_what_was_taken_for_an_item_without_parts_is_recognised_anew():
    """The slit between legs that lay together came out when the surface settled."""
    config = RecognitionConfig()
    closed = drawn([[0, 0], [0.34, 0], [0.36, 0.38], [-0.02, 0.38]])
    before = recognise(*closed, TEMPLATES, config)
    assert before.category == "skirt"
    legs = [[0, 0], [0.16, 0], [0.17, 0.18], [0.18, 0], [0.34, 0], [0.36, 0.38], [-0.02, 0.38]]
    again = recognise_again(before, *drawn(legs), TEMPLATES, config)
    assert again.category == "shorts" and again.fit.template.parts
    assert recognise_again(before, *closed, TEMPLATES, config).category == "skirt"


def test_a_category_that_was_out_of_the_question_does_not_come_back():
    config = RecognitionConfig()
    before = recognise(*two_legs(0.2), TEMPLATES, config)
    assert before.probabilities["trousers"] < 1e-4
    again = recognise_again(before, *two_legs(0.45), TEMPLATES, config)
    assert again.category == "shorts"


def test_only_categories_of_one_build_take_over_sizes_and_angles():
    known = {template.category: template for template in TEMPLATES}
    shorts, trousers = known["shorts"], known["trousers"]
    assert shorts.same_build(trousers)
    assert known["t_shirt"].same_build(known["long_sleeve_shirt"])
    assert not shorts.same_build(known["skirt"])
    state = np.linspace(-1.0, 1.0, shorts.dimensions)
    taken = trousers.state_of(shorts, state)
    assert not np.allclose(taken, state)
    assert np.allclose(trousers.place(taken)[0], shorts.place(state)[0], atol=1e-12)
    rigid = replace(trousers, spread=np.zeros(1), swing=np.zeros(1))
    assert np.allclose(rigid.state_of(shorts, state)[len(rigid.sizes) :], 0.0)
