"""Outlines of flat samples: where they end the cloth, and where it goes on unseen."""

from __future__ import annotations

import numpy as np
import pytest
from flat import lying_at

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.distances import link_steps
from vflatten_ros.core.fusion import Samples
from vflatten_ros.core.geometry import twice_area
from vflatten_ros.core.outline import outline_of
from vflatten_ros.core.rotation import Laid, Surface, edges_laid, together
from vflatten_ros.core.sheets import Links

CONFIG = RotationConfig()
STEP_M, SIDE_M, SLIT_M = CONFIG.spacing_m, 0.2, 0.016


def square(keep):
    """Samples of two layers where `keep` of (n, 2) places says so; edges at their border."""
    u, v = np.meshgrid(np.arange(0, SIDE_M, STEP_M), np.arange(0, SIDE_M, STEP_M))
    uv = np.column_stack([u.ravel(), v.ravel()])
    inside = keep(uv)
    around = [
        keep(uv + shift) & ((uv + shift) > -1e-9).all(1) & ((uv + shift) < SIDE_M).all(1)
        for shift in STEP_M * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    ]
    edge = inside & ~np.all(around, axis=0)
    return np.repeat(uv[inside], 2, axis=0), np.repeat(edge[inside].astype(int), 2)


def inferred(uv, edge):
    outline = outline_of(uv, np.full(len(uv), 0.002), edge, CONFIG)
    assert twice_area(outline.uv) > 0
    return outline.uv, outline.inferred


def test_a_square_ends_where_its_samples_do():
    uv, edge = square(lambda p: np.ones(len(p), dtype=bool))
    line, flags = inferred(uv, edge)
    assert twice_area(line) / 2 == pytest.approx(SIDE_M**2, rel=0.05)
    assert not flags.any()


def test_a_bite_is_inferred_where_the_cloth_goes_on():
    def keep(p):
        return (p[:, 0] < 0.1) | (p[:, 1] < 0.1)

    uv, edge = square(keep)
    bitten = (uv > 0.085).all(1) & (edge > 0)
    line, flags = inferred(uv, np.where(bitten, 2, edge))
    bite = (line > 0.085).all(1) & (line.max(1) < 0.18)
    assert flags[bite].mean() > 0.8
    assert not flags[line.min(1) < 0.05].any()
    assert not inferred(uv, edge)[1].any()


def test_what_lies_between_groups_is_hidden_cloth_of_the_item_that_placed_them():
    """Two strips, at the bottom and at the top of an item that is a little larger."""

    def keep(p):
        return np.abs(p[:, 1] - SIDE_M / 2) > 0.04

    uv, edge = square(keep)
    low, high = -0.004, SIDE_M + 0.004
    item = np.array([[low, low], [high, low], [high, high], [low, high]])
    sigma = np.full(len(uv), 0.002)
    ends = edge
    facing = np.abs(uv[:, 1] - SIDE_M / 2) < 0.04 + 1.5 * STEP_M
    edge = np.where(facing & (edge > 0), 2, edge)
    outline = outline_of(uv, sigma, edge, CONFIG, (), item)
    assert twice_area(outline.uv) / 2 == pytest.approx(SIDE_M**2, rel=0.05)
    between = np.abs(outline.uv[:, 1] - SIDE_M / 2) < 0.02
    seen = np.abs(outline.uv[:, 1] - SIDE_M / 2) > 0.06
    assert between.sum() > 8 and outline.inferred[between].all()
    assert not outline.inferred[seen].any()
    # without it only one strip would be left; and where cloth ends, none is hidden beyond
    for strip in (
        outline_of(uv, sigma, edge, CONFIG),
        outline_of(uv, sigma, ends, CONFIG, (), item),
    ):
        assert twice_area(strip.uv) / 2 < SIDE_M**2 / 2


@pytest.mark.parametrize(("other", "goes_on"), [(1, False), (2, True)])
def test_one_side_of_a_slit_tells_what_the_other_is(other, goes_on):
    """Between two legs one hangs before the edge of the other."""

    def keep(p):
        return (np.abs(p[:, 0] - 0.1) > SLIT_M / 2) | (p[:, 1] > 0.12)

    uv, edge = square(keep)
    slit = (np.abs(uv[:, 0] - 0.1) < SLIT_M) & (edge > 0) & (uv[:, 1] < 0.11)
    one = slit & (uv[:, 0] < 0.1)
    edge = np.where(one, 2, np.where(slit, other, edge))
    line, flags = inferred(uv, edge)
    inside = (np.abs(line[:, 0] - 0.1) < 0.015) & (line[:, 1] > 0.02) & (line[:, 1] < 0.1)
    assert inside.sum() > 20
    assert flags[inside].mean() == pytest.approx(float(goes_on), abs=0.1)


def test_where_both_sides_of_a_rim_lie_side_by_side_the_cloth_ends():
    xyz = np.array([[0.0, 0, 0], [0.003, 0, 0], [0.1, 0, 0], [0.103, 0, 0], [0.2, 0, 0]])
    normal = np.array([[-1.0, 0, 0], [1, 0, 0], [-1, 0, 0], [1, 0, 0], [1, 0, 0]])
    rim = np.array([True, True])
    links = Links(np.array([0, 2]), np.array([1, 3]), np.full(2, 0.003), rim, np.array([0.2, 0.2]))
    samples = Samples(xyz, normal, np.full(5, 3e-4), np.arange(5), np.ones((5, 1), dtype=bool))
    none = np.zeros(5, dtype=np.int64)
    steps = link_steps(xyz, normal, links)
    edge = np.full(5, 2)
    surface = Surface(samples, links, steps, edge, np.zeros(5), none, np.column_stack([none, none]))
    uv = np.array([[0.0, 0.0], [0.004, 0.0], [0.1, 0.0], [0.15, 0.0], [0.2, 0.0]])
    assert list(edges_laid(surface, np.arange(5), uv)) == [1, 1, 2, 2, 2]
    assert list(edges_laid(surface, np.array([1, 2, 4]), uv[[1, 2, 4]])) == [2, 2, 2]
    assert (edge == 2).all()


@pytest.mark.parametrize(("gap_m", "told"), [(0.0, False), (0.05, True)])
def test_a_group_that_lies_apart_from_the_rest_is_told(gap_m, told):
    uv, edge = square(lambda uv: np.ones(len(uv), dtype=bool))
    apart = np.array([SIDE_M + gap_m, 0.0])
    small = uv[:, 0] < SIDE_M / 2
    places, edges = np.vstack([uv, uv[small] + apart]), np.r_[edge, edge[small]]
    n, first = len(places), len(uv)
    xyz = np.column_stack([places, np.zeros(n)])
    normal = np.tile([0.0, 0.0, 1.0], (n, 1))
    none, flags = np.zeros(0, dtype=np.int64), np.ones((n, 1), dtype=bool)
    links = Links(none, none, np.zeros(0), none > 0, np.zeros(0))
    samples = Samples(xyz, normal, np.full(n, 3e-4), np.arange(n), flags)
    steps, zero = link_steps(xyz, normal, links), np.zeros(n, dtype=np.int64)
    pixel = np.column_stack([zero, zero])
    surface = Surface(samples, links, steps, edges, np.zeros(n), zero, pixel)
    groups = []
    for row in (np.arange(first), np.arange(first, n)):
        points, up = lying_at(places[row]), np.ones(len(row))
        firm = np.ones(len(row), dtype=bool)
        groups.append(Laid(surface, (), points, row, up, firm, 0.0, 0.0, ()))
    both = together(groups, (), [g.points for g in groups], [g.side for g in groups], CONFIG)
    assert [notice.code for notice in both.notices] == ["untrusted"] * told
    assert all("33 %" in notice.text for notice in both.notices)
