"""A tube seen from a part of the turn, and a sheet before another: where more would be seen."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from garments import CALIBRATION, example_garment

from vflatten_ros.core.config import RotationConfig, ViewsConfig
from vflatten_ros.core.distances import link_steps
from vflatten_ros.core.fusion import Samples
from vflatten_ros.core.geometry import inverse
from vflatten_ros.core.rotation import Surface
from vflatten_ros.core.sheets import link_samples, sheet_edges
from vflatten_ros.core.unseen import advice, coverage, enough, notice_of
from vflatten_ros.core.values import Coverage, Notice, Unseen, View

CONFIG = RotationConfig()
RADIUS_M, SPACING_M = 0.08, 0.004


def view(view_id, angle_rad):
    points = np.zeros((0, 3))
    pixel = np.zeros((0, 2), dtype=np.int32)
    return View(view_id, 0, angle_rad, points, pixel, None, (480, 360), CALIBRATION)


def facing(view, xyz, normal):
    camera = inverse(CALIBRATION.T_rig_hanger(view.angle_rad))[:3, 3]
    toward = camera - xyz
    return (toward * normal).sum(1) / np.linalg.norm(toward, axis=1)


def surface_of(xyz, normal, seen):
    shown = seen.any(1)
    xyz, normal, seen = xyz[shown], normal[shown], seen[shown]
    links = link_samples(xyz, normal, CONFIG)
    sheet = ~links.rim
    edge = sheet_edges(xyz, normal, links.a[sheet], links.b[sheet], CONFIG)
    n = len(xyz)
    samples = Samples(xyz, normal, np.full(n, 3e-4), np.arange(n), seen)
    none = np.zeros(n, dtype=np.int64)
    steps = link_steps(xyz, normal, links)
    return Surface(samples, links, steps, edge, np.zeros(n), none, np.column_stack([none, none]))


def tube(angles_deg):
    """What views at these item angles show of a tube round the axis, and the views."""
    step = SPACING_M / RADIUS_M
    angle, height = (
        v.ravel()
        for v in np.meshgrid(np.arange(0, 2 * np.pi, step), np.arange(-0.3, -0.05, SPACING_M))
    )
    normal = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    xyz = normal * RADIUS_M + np.column_stack([np.zeros((len(angle), 2)), height])
    views = [view(k, np.radians(a)) for k, a in enumerate(angles_deg)]
    seen = np.column_stack([facing(v, xyz, normal) > 0.3 for v in views])
    return surface_of(xyz, normal, seen), views


def between(a_rad, b_deg):
    return abs((np.degrees(a_rad) - b_deg + 180) % 360 - 180)


def test_a_whole_turn_leaves_nothing_to_turn_to():
    found = coverage(*tube(range(0, 360, 30)))
    assert found.turn_to_rad is None
    assert found.open_share == 0.0


@pytest.mark.parametrize("first", [0, 100, 250])
def test_the_other_side_of_a_tube_is_where_to_turn_to(first):
    found = coverage(*tube([first, first + 30, first + 60]))
    assert between(found.turn_to_rad, first + 30 + 180) < 50
    assert found.open_share > 0.05


def test_a_single_angle_that_was_left_out_is_found():
    angles = [a for a in range(0, 360, 20) if not 120 < a < 240]
    found = coverage(*tube(angles))
    assert between(found.turn_to_rad, 180) < 20


@pytest.mark.parametrize("side", [1, -1])
def test_cloth_beneath_another_sheet_is_seen_from_the_side_that_lies_open(side):
    """A sheet hangs 6 mm before another and hides how that goes on to one side."""
    y, z = np.meshgrid(np.arange(-0.1, 0.0, SPACING_M), np.arange(-0.3, -0.1, SPACING_M))
    behind = np.column_stack([np.zeros(y.size), side * y.ravel(), z.ravel()])
    before = behind + np.array([0.006, side * 0.097, 0.0])
    xyz = np.vstack([behind, before])
    normal = np.tile([1.0, 0.0, 0.0], (len(xyz), 1))
    views = [view(k, np.radians(a)) for k, a in enumerate((0, *range(90, 271, 20)))]
    seen = np.zeros((len(xyz), len(views)), dtype=bool)
    seen[:, 0] = True
    found = coverage(surface_of(xyz, normal, seen), views)
    # as much is unknown on either side; the camera faces the open one from 45 degrees beside it
    assert between(found.turn_to_rad, side * 45) < 20
    there = [*views, view(50, np.radians(side * 45))]
    again = coverage(surface_of(xyz, normal, np.column_stack([seen, seen[:, 1]])), there)
    assert again.open_share < 0.3 * found.open_share
    assert again.unseen_share == pytest.approx(found.unseen_share)


def test_shares_of_views():
    xyz = np.column_stack(
        [np.zeros(100), np.repeat(np.arange(10), 10) * 0.004, np.tile(np.arange(10), 10) * 0.004]
    )
    normal = np.tile([1.0, 0.0, 0.0], (100, 1))
    seen = np.zeros((100, 3), dtype=bool)
    seen[:60, 0] = seen[40:80, 1] = seen[40:100, 2] = True
    views = [view(7, 0.0), view(2, 0.5), view(4, 1.0)]
    shares = coverage(surface_of(xyz, normal, seen), views).shares
    assert [s.view_id for s in shares] == [2, 4, 7]
    assert [s.shows for s in shares] == pytest.approx([0.4, 0.6, 0.6])
    assert [s.only for s in shares] == pytest.approx([0.0, 0.2, 0.4])
    assert [s.first for s in shares] == pytest.approx([0.4, 0.2, 0.4])
    assert sum(s.first for s in shares) == pytest.approx(1.0)


def garment(**changes):
    plain = example_garment()
    sizes = tuple(dataclasses.replace(m, inferred=False) for m in plain.measurements)
    outline = dataclasses.replace(
        plain.outline, inferred=np.zeros(len(plain.outline.uv), dtype=bool)
    )
    good = {"measurements": sizes, "notices": (), "outline": outline, "score_kind": "probability"}
    good["scores"] = {"towel": 0.95, "skirt": 0.05}
    return dataclasses.replace(plain, **{**good, **changes})


COVERED = Coverage((), 0.1, 0.0, 1.5)


def test_nothing_is_advised_where_nothing_that_matters_is_missing():
    assert advice(garment(), COVERED, 0.75) is None


@pytest.mark.parametrize(
    "changes",
    [
        {"category": "unknown"},
        {"coverage": 0.5},
        {"measurements": example_garment().measurements},
        {
            "outline": dataclasses.replace(
                example_garment().outline, inferred=np.ones(80, dtype=bool)
            )
        },
    ],
    ids=["category", "coverage", "size", "outline"],
)
def test_what_is_missing_is_worth_a_turn_or_a_regrasp(changes):
    assert advice(garment(**changes), COVERED, 0.75) == Unseen(1.5)
    everywhere = dataclasses.replace(COVERED, turn_to_rad=None)
    assert advice(garment(**changes), everywhere, 0.75) == Unseen(None)


def test_ends_that_another_angle_shows_are_worth_a_turn():
    assert advice(garment(), dataclasses.replace(COVERED, open_share=0.1), 0.75) == Unseen(1.5)


def test_the_advice_in_words():
    assert "turn to 90 degrees" in notice_of(Unseen(np.pi / 2)).text
    assert "grasp the item elsewhere" in notice_of(Unseen(None)).text
    assert notice_of(Unseen(None)).code == "unseen"


def test_a_certain_answer_is_enough():
    assert enough(garment(), ViewsConfig())
    assert enough(garment(unseen=Unseen(None)), ViewsConfig())


@pytest.mark.parametrize(
    "changes",
    [
        {"category": "unknown"},
        {"scores": {"towel": 0.8, "skirt": 0.2}},
        {"score_kind": "R"},
        {"measurements": example_garment().measurements},
        {"measurements": ()},
        {"unseen": Unseen(1.0)},
        {"notices": (Notice("untrusted", ""),)},
        {
            "measurements": tuple(
                dataclasses.replace(m, inferred=False, sigma_m=0.05)
                for m in example_garment().measurements
            )
        },
    ],
    ids=["unknown", "category", "score", "inferred", "no sizes", "turn", "untrusted", "vague"],
)
def test_whatever_is_uncertain_wants_more_views(changes):
    assert not enough(garment(**changes), ViewsConfig())
