"""A slit up the middle of legs that links join: by its folds and tears, against what is beside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flat import lying_at
from scipy.spatial import cKDTree

from vflatten_ros.categories import load_templates
from vflatten_ros.core import ways
from vflatten_ros.core.config import Config, RotationConfig
from vflatten_ros.core.geometry import twice_area
from vflatten_ros.core.middle_slit import OPEN_M, Axis, axes_of, banks_of, between, middle_slit
from vflatten_ros.core.outline import outline_of
from vflatten_ros.core.rotation import Surface, Unfolded
from vflatten_ros.core.sheets import Links
from vflatten_ros.core.template_fit import place
from vflatten_ros.core.values import no_progress

CONFIG = RotationConfig()
STEP_M, WIDTH_M, HEIGHT_M, CROTCH_M = CONFIG.spacing_m, 0.36, 0.40, 0.18
FROM_HEM = Axis(np.array([WIDTH_M / 2, 0.0]), np.array([0.0, 1.0]), HEIGHT_M, WIDTH_M)
FROM_WAIST = Axis(np.array([WIDTH_M / 2, HEIGHT_M]), np.array([0.0, -1.0]), HEIGHT_M, WIDTH_M)
BOTH_ENDS = FROM_HEM, FROM_WAIST


def legs(at_m=WIDTH_M / 2, folded=True, joined=0.5, speckle=0.0, both_faces=True):
    """Shorts whose legs touch: samples of both faces, edges, links, of which some lead across.

    Parameters
    ----------
    at_m : float
        Where the slit is.
    folded : bool
        Whether front and back hang together along it.
    joined : float
        Share of the links across it that were not told from cloth.
    speckle : float
        Share of the samples at which noise joins front and back.
    both_faces : bool
        Whether the slit is in both.
    """
    rng = np.random.default_rng(3)
    face = np.mgrid[STEP_M / 2 : WIDTH_M : STEP_M, STEP_M / 2 : HEIGHT_M : STEP_M].reshape(2, -1).T
    face = face + rng.normal(0.0, 0.15 * STEP_M, face.shape)
    count = len(face)
    a, b = cKDTree(face).query_pairs(CONFIG.link_m, output_type="ndarray").T
    across = ((face[a] - at_m) * (face[b] - at_m))[:, 0] < 0
    across &= (face[a] + face[b])[:, 1] / 2 < CROTCH_M
    beside = (np.abs(face[:, 0] - at_m) < STEP_M) & (face[:, 1] < CROTCH_M)
    rim = np.minimum(face, [WIDTH_M, HEIGHT_M] - face).min(axis=1) < STEP_M
    loose = rng.random(count) < speckle
    links = []
    for first, slit in ((0, True), (count, both_faces)):
        kept = ~across | (rng.random(len(a)) < joined) | (not slit)
        links.append((a[kept] + first, b[kept] + first))
    round_rims = np.flatnonzero(rim | loose | (beside & folded))
    links.append((round_rims, round_rims + count))
    one, other = (np.concatenate([pair[k] for pair in links]) for k in (0, 1))
    uv = np.vstack([face, face])
    length = np.linalg.norm(uv[one] - uv[other], axis=1)
    of_rim = np.arange(len(one)) >= len(one) - len(round_rims)
    edge = np.tile(rim | loose | beside, 2).astype(int)
    side = np.repeat([1.0, -1.0], count)
    return uv, side, edge, Links(one, other, length, of_rim, np.zeros(len(one)))


def found(*item, axes=BOTH_ENDS):
    return middle_slit(*item, axes, CONFIG)


@pytest.mark.parametrize("speckle, off_m", [(0.0, 0.012), (0.04, 0.05)])
def test_the_slit_between_legs_that_links_join_is_found(speckle, off_m):
    mouth, end = found(*legs(speckle=speckle)).line
    assert mouth == pytest.approx([WIDTH_M / 2, 0.0], abs=0.008)
    assert end == pytest.approx([WIDTH_M / 2, CROTCH_M], abs=off_m)


def test_it_is_found_from_either_end_and_however_the_item_lies():
    uv, *rest = legs()
    turned = np.array([WIDTH_M, HEIGHT_M]) - uv
    mouth, end = found(turned, *rest).line
    assert mouth[1] > 0.38 and end[1] == pytest.approx(HEIGHT_M - CROTCH_M, abs=0.015)
    lean = np.radians(4.0)
    turn = np.array([[np.cos(lean), -np.sin(lean)], [np.sin(lean), np.cos(lean)]])
    leant = (uv - FROM_HEM.start) @ turn.T + FROM_HEM.start
    mouth, end = found(leant, *rest).line
    along = turn @ [0.0, CROTCH_M]
    assert end == pytest.approx(FROM_HEM.start + along, abs=0.015)


@pytest.mark.parametrize(
    "item",
    [
        {"folded": False, "joined": 1.0},  # a skirt
        {"folded": False, "joined": 1.0, "speckle": 0.3},  # of which noise joins front and back
        {"folded": False, "joined": 0.0, "both_faces": False},  # with a vent
        {"at_m": 0.12},  # some fold, not between legs
    ],
)
def test_what_is_no_slit_between_legs_is_hardly_one(item):
    slit = found(*legs(**item))
    assert slit is None or slit.probability < 0.3


def test_an_item_shorter_than_a_slit_has_none():
    short = Axis(FROM_HEM.start, FROM_HEM.ahead, 0.06, WIDTH_M)
    assert found(*legs(), axes=(short,)) is None


def test_a_slit_goes_with_its_banks_as_the_legs_are_turned():
    uv, *rest = legs()
    slit = found(uv, *rest).line
    banks = banks_of(uv, slit, CONFIG)
    assert set(banks.side) == {-1, 0, 1}
    assert np.abs(uv[banks.side != 0, 0] - WIDTH_M / 2).max() < 4 * STEP_M
    line = between(uv, banks, CONFIG)
    assert np.abs(line[:, 0] - WIDTH_M / 2).max() < STEP_M
    assert line[:, 1].min() < 0.0 and line[:, 1].max() == pytest.approx(CROTCH_M, abs=0.02)
    assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() < 0.004

    def swung(angle_rad):
        crotch, leg = np.array([WIDTH_M / 2, CROTCH_M]), (uv[:, 0] > WIDTH_M / 2)
        leg &= uv[:, 1] < CROTCH_M
        turn = np.array(
            [[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]]
        )
        return np.where(leg[:, None], (uv - crotch) @ turn.T + crotch, uv)

    a_little = between(swung(0.05), banks, CONFIG)
    lowest = a_little[a_little[:, 1].argmin()]
    assert lowest[0] == pytest.approx(WIDTH_M / 2 + 0.025 * CROTCH_M, abs=0.003)
    far = between(swung(0.5), banks, CONFIG)  # open from where the banks are OPEN_M apart
    assert far[:, 1].min() > CROTCH_M - OPEN_M / 0.5 - 3 * STEP_M


def test_nothing_lies_between_banks_of_which_one_is_missing():
    uv, *rest = legs()
    banks = banks_of(uv, found(uv, *rest).line, CONFIG)
    left = np.flatnonzero(banks.side <= 0)
    assert between(uv[left], banks.of(left), CONFIG).shape == (0, 2)


@pytest.mark.parametrize("apart_m", [0.0, 0.012])
def test_the_outline_goes_in_and_out_of_it(apart_m):
    """Though the legs may be apart at their ends, so that it is not deep in what was seen."""
    uv, side, edge, links = legs()
    sigma = np.full(len(uv), 0.002)
    banks = banks_of(uv, found(uv, side, edge, links).line, CONFIG)
    low = (uv[:, 0] > WIDTH_M / 2) & (uv[:, 1] < 0.7 * CROTCH_M)
    uv = uv + np.column_stack([apart_m * low, np.zeros(len(uv))])
    line = between(uv, banks, CONFIG)
    shut = outline_of(uv, sigma, edge, CONFIG).uv
    slit = outline_of(uv, sigma, edge, CONFIG, slit=line).uv
    within = np.array([WIDTH_M / 2, 0.85 * CROTCH_M])
    assert np.linalg.norm(shut - within, axis=1).min() > 0.015
    assert np.linalg.norm(slit - within, axis=1).min() < 0.006
    assert twice_area(slit) > 0.95 * twice_area(shut)


def test_axes_lead_from_either_end_of_a_category_up_its_middle():
    (skirt,) = (t for t in load_templates() if t.category == "skirt")
    state, pose = np.zeros(skirt.dimensions), np.array([0.4, 1.0, -2.0])
    points = place(skirt, pose, state)[0]
    low, high = axes_of(points[: skirt.vertices], pose)
    at = skirt.landmarks
    assert low.start == pytest.approx(points[at["hem_middle"]])
    assert high.start == pytest.approx(points[at["waist_front"]])
    assert low.start + low.length_m * low.ahead == pytest.approx(high.start)
    assert high.ahead == pytest.approx(-low.ahead)
    hem = points[at["left_hem_corner"]] - points[at["right_hem_corner"]]
    assert low.width_m == pytest.approx(np.linalg.norm(hem))


def test_a_rectangle_has_a_middle_across_too():
    (towel,) = (t for t in load_templates() if t.category == "towel")
    state, pose = np.zeros(towel.dimensions), np.array([0.4, 1.0, -2.0])
    points = place(towel, pose, state)[0]
    low, _, left, right = axes_of(points[: towel.vertices], pose, across=True)
    corner = {name: points[towel.landmarks[name]] for name in towel.landmarks}
    sides = [
        (corner[f"{side}_bottom_corner"] + corner[f"{side}_top_corner"]) / 2
        for side in ("left", "right")
    ]
    assert left.start == pytest.approx(sides[0]) and right.start == pytest.approx(sides[1])
    assert left.start + left.length_m * left.ahead == pytest.approx(right.start)
    assert right.ahead == pytest.approx(-left.ahead)
    assert (left.length_m, left.width_m) == pytest.approx((low.width_m, low.length_m))


def laid(uv, side, edge, links, flare=0.2, wide=1.0):
    """An item laid flat, wider at the hem: its samples in any order, without some."""
    wider = wide + flare * (1.0 - uv[:, 1] / HEIGHT_M)
    uv = np.column_stack([WIDTH_M / 2 + (uv[:, 0] - WIDTH_M / 2) * wider, uv[:, 1]])
    row = np.random.default_rng(5).permutation(len(uv))[: int(0.98 * len(uv))]
    nothing = np.zeros(len(uv))
    surface = Surface(None, links, None, edge, nothing, nothing, nothing)
    outline = outline_of(uv, np.full(len(uv), 0.002), edge, CONFIG)
    points = lying_at(uv[row], sigma_m=0.002)
    points.xyz_hanger[:, 2] = 0.01 * side[row]
    everywhere = np.ones(len(row), dtype=bool)
    return Unfolded(surface, (), points, row, side[row], everywhere, 0.0, 0.0, (), outline)


def called(item):
    return ways._recognised(item, tuple(load_templates()), Config(), no_progress)


def test_legs_that_links_join_are_legs_and_what_is_of_one_piece_is_not(monkeypatch):
    fit = called(laid(*legs())).found.fit
    assert fit.template.category == "shorts"
    inseam_m = fit.template.measure(fit.state, fit.covariance[3:, 3:])["inseam"][0]
    assert inseam_m == pytest.approx(CROTCH_M, abs=0.02)
    whole = called(laid(*legs(folded=False, joined=1.0)))
    assert whole.found.category == "skirt"
    assert whole.unfolded.surface.banks is None
    monkeypatch.setattr(ways, "parted", lambda *_: None)
    assert called(laid(*legs())).found.category == whole.found.category


@pytest.mark.parametrize("wide", [1.0, 1.25])
def test_legs_that_make_a_rectangle_are_no_towel(monkeypatch, wide):
    """Whichever way it is longer: a rectangle has two middles."""
    fit = called(laid(*legs(), flare=0.0, wide=wide)).found.fit
    assert fit.template.category == "shorts"
    inseam_m = fit.template.measure(fit.state, fit.covariance[3:, 3:])["inseam"][0]
    assert inseam_m == pytest.approx(CROTCH_M, abs=0.02)
    monkeypatch.setattr(ways, "parted", lambda *_: None)
    assert called(laid(*legs(), flare=0.0, wide=wide)).found.category == "towel"


def test_a_towel_stays_whole():
    towel = called(laid(*legs(folded=False, joined=1.0), flare=0.0))
    assert towel.found.category == "towel"
    assert towel.unfolded.surface.banks is None


@pytest.mark.parametrize("chance", [0.1, 0.9])
def test_a_doubtful_slit_makes_the_category_doubtful(monkeypatch, chance):
    parted = ways.parted
    monkeypatch.setattr(ways, "parted", lambda *item: (parted(*item)[0], chance))
    best = called(laid(*legs()))
    assert best.found.category == ("shorts" if chance > 0.5 else "skirt")
    assert (best.unfolded.surface.banks is not None) == (chance > 0.5)
    assert best.found.probabilities["shorts"] == pytest.approx(chance, abs=0.1)
    assert best.found.probabilities["skirt"] == pytest.approx(1.0 - chance, abs=0.1)


def test_an_item_with_a_slit_has_legs_whatever_else_it_looks_like():
    skirt = called(laid(*legs(folded=False, joined=1.0))).found
    still = dict.fromkeys(skirt.probabilities, 0.0) | {"skirt": 0.99, "shorts": 0.01}
    cut = replace(skirt, probabilities=still)
    whole = replace(skirt, probabilities=still | {"skirt": 1.0, "shorts": 0.0})
    told = ways._slit_or_not(whole, cut, 0.2, load_templates())
    assert told["shorts"] == pytest.approx(0.2)
    assert told["skirt"] == pytest.approx(0.8)


def test_the_more_noise_joins_the_faces_the_less_likely_is_a_slit():
    sure, doubtful, gone = (found(*legs(speckle=share)) for share in (0.0, 0.1, 0.2))
    assert sure.probability > 0.99
    assert 0.02 < doubtful.probability < 0.5
    assert gone is None


def test_what_was_parted_stays_so_when_it_is_laid_out_anew():
    item = called(laid(*legs())).unfolded
    banks = item.surface.banks.of(item.row)
    moved = replace(item.points, uv=item.points.uv + np.array([0.5, 0.0]))
    line = between(moved.uv, banks, CONFIG)
    assert np.abs(line[:, 0] - WIDTH_M / 2 - 0.5).max() < STEP_M
