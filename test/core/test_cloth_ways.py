"""Ways on flat items whose lengths are known: a tube, trousers, a towel."""

from __future__ import annotations

import numpy as np
import pytest

from vflatten_ros.categories import load_templates
from vflatten_ros.core.cloth_ways import CELL_M, FAR, cloth_ways
from vflatten_ros.core.errors import InvalidConfig
from vflatten_ros.core.templates import templates_from

TUBE = np.array([[0.0, 0.0], [0.4, 0.0], [0.4, 0.6], [0.0, 0.6]])
SIDES = np.array([False, True, False, True])  # closed at the sides, open at hem and waist


def way_m(ways, one, other):
    """Ways on the same side, and to the other."""
    return ways.to(np.array([other]))[:, ways.at(np.array([one]))[0], 0]


def test_a_way_to_the_back_of_a_tube_leads_round_a_side_and_not_round_the_hem():
    ways = cloth_ways(TUBE, SIDES, single_sheet=False)
    same, back = way_m(ways, 0.10 + 0.02j, 0.30 + 0.02j)
    assert same == pytest.approx(0.20, abs=CELL_M)
    assert back == pytest.approx(0.40, abs=CELL_M)  # 0.1 and 0.3 to the left side, or to the right
    # straight on over the side, as if the back were folded out
    _, back = way_m(ways, 0.10 + 0.10j, 0.10 + 0.40j)
    assert back == pytest.approx(np.hypot(0.2, 0.3), abs=CELL_M)


def test_a_sheet_is_its_own_other_side():
    same, back = way_m(cloth_ways(TUBE, SIDES, single_sheet=True), 0.1 + 0.1j, 0.3 + 0.4j)
    assert back == same == pytest.approx(np.hypot(0.2, 0.3), abs=CELL_M)


def test_where_no_opening_is_described_no_way_leads_to_the_back():
    same, back = way_m(cloth_ways(TUBE, np.zeros(4, dtype=bool), False), 0.1 + 0.1j, 0.3 + 0.4j)
    assert back == FAR > same


def test_no_way_is_known_beyond_the_item():
    ways = cloth_ways(TUBE, SIDES, single_sheet=False)
    assert (ways.at(np.array([0.2 - 0.1j, 5.0 + 5.0j, 0.2 + 0.3j])) < 0).tolist() == [1, 1, 0]
    assert (ways.to(np.array([0.2 + 0.3j]))[:, -1] == FAR).all()


def test_no_way_leads_from_leg_to_leg_though_they_touch():
    template = next(t for t in load_templates() if t.category == "trousers")
    state = np.zeros(template.dimensions)
    state[-2:] = -(template.angle[0] + np.radians(3.0)) / template.swing[0]  # legs side by side
    outline = template.outline(state)
    named = dict(zip(template.points, outline, strict=False))
    knee = 0.5 * named["crotch"][1]
    assert abs(named["left_hem_inner"][0] - named["right_hem_inner"][0]) < 0.03
    ways = cloth_ways(outline, template.seam, template.single_sheet)
    left, right = -0.05 + 1j * knee, 0.05 + 1j * knee
    assert way_m(ways, left, right)[0] == FAR
    assert way_m(ways, left, left.real + 0.7j * knee)[0] == pytest.approx(0.3 * knee, abs=CELL_M)
    waist = named["waist_front"][1] - 0.05
    assert way_m(ways, -0.05 + 1j * waist, 0.05 + 1j * waist)[0] == pytest.approx(0.1, abs=CELL_M)
    # front and back of a leg hang together along its seams: half its width away
    width = abs(named["left_hem_outer"][0] - named["left_hem_inner"][0])
    middle = named["left_hem_inner"][0] - 0.5 * width + 0.1j
    assert way_m(ways, middle, middle)[1] == pytest.approx(width, abs=2 * CELL_M)


def test_no_way_leads_round_the_ends_of_legs_that_touch():
    template = next(t for t in load_templates() if t.category == "trousers")
    state = np.zeros(template.dimensions)
    state[-2:] = -(template.angle[0] + np.radians(3.0)) / template.swing[0]
    outline = template.outline(state)
    ways = cloth_ways(outline, template.seam, template.single_sheet)
    hem, crotch = outline[:, 1].min(), outline[template.landmarks["crotch"], 1]
    left = -0.06 + 1j * (hem - 0.01)  # a hem that bulges beyond the category's
    for right in (0.06 + 1j * (hem + 0.02), 0.06 + 1j * (hem + 0.15)):
        same, back = way_m(ways, right, left)
        assert same == FAR
        assert back > 1.5 * (crotch - hem)  # up one leg, down the other


def test_every_garment_that_comes_with_the_program_has_openings_and_seams():
    for template in load_templates():
        assert len(template.seam) == template.vertices
        if not template.single_sheet:
            assert template.seam.any() and not template.seam.all()
            names = list(template.points[: template.vertices])
            for one, other in (("left_hem_outer", "left_hem_inner"), ("hem_middle",) * 2):
                if one in names:
                    assert not template.seam[names.index(one)] or one == other


def test_openings_are_read_from_the_half_outline_and_mirrored():
    half = [
        {"name": "hem_middle", "open": True, "at": [0, 0]},
        {"name": "hem_corner", "at": ["0.5 * wide", 0]},
        {"at": ["0.5 * wide", "wide"]},
        {"at": [0, "wide"]},
    ]
    bag = {
        "category": "bag",
        "sizes": {"wide": {"typical": 0.4, "spread": 0.2}},
        "half": half,
        "measurements": {m: ["left_hem_corner", "right_hem_corner"] for m in ("width", "length")},
    }
    # counter-clockwise from the middle of the hem, which is open on both halves
    assert templates_from([bag])[0].seam.tolist() == [False, True, True, True, True, False]
    closed = bag | {"half": [{k: v for k, v in p.items() if k != "open"} for p in half]}
    assert not templates_from([closed])[0].seam.any()
    wrong = bag | {"half": [half[0] | {"open": "wide"}, *half[1:]]}
    with pytest.raises(InvalidConfig, match=r"bag.*open: expected true or false, got 'wide'"):
        templates_from([wrong])
