"""Slits between parts that lie side by side, told from sheets that hang together."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.distances import pieces
from vflatten_ros.core.geometry import twice_area
from vflatten_ros.core.outline import outline_of
from vflatten_ros.core.sheets import Links
from vflatten_ros.core.slits import AWAY, slits, stretches

CONFIG = RotationConfig()
STEP_M, SIDE_M, AT_M = CONFIG.spacing_m, 0.2, 0.101
TEAR_AT_M = 0.058


def cloth(slit_m, up=1.0, hole_m=0.0, tear_m=0.0):
    """Samples of a square, slit from its lower edge at u = AT_M; edges; pairs that are linked.

    A tear leads from the middle of the slit to its right.
    """
    uv = np.mgrid[0:SIDE_M:STEP_M, 0:SIDE_M:STEP_M].reshape(2, -1).T
    uv = uv[np.linalg.norm(uv - [0.05, 0.15], axis=1) > hole_m]
    a, b = cKDTree(uv).query_pairs(CONFIG.link_m, output_type="ndarray").T
    low = (uv[a] + uv[b])[:, 1] / 2 < slit_m
    across = ((uv[a] - AT_M) * (uv[b] - AT_M))[:, 0] < 0
    far = np.linalg.norm(uv[a] - uv[b], axis=1) > 1.5 * hole_m if hole_m else np.zeros(len(a), bool)
    kept = ~(across & low) & ~far
    over = ((uv[a] - TEAR_AT_M) * (uv[b] - TEAR_AT_M))[:, 1] < 0
    right = np.abs((uv[a] + uv[b])[:, 0] / 2 - AT_M - tear_m / 2) < tear_m / 2
    kept &= ~(over & right)
    border = (uv < STEP_M / 2).any(1) | (uv > SIDE_M - 1.5 * STEP_M).any(1)
    border |= (np.abs(uv[:, 0] - AT_M) < STEP_M) & (uv[:, 1] < slit_m)
    border |= np.linalg.norm(uv - [0.05, 0.15], axis=1) < hole_m + STEP_M
    along = np.abs(uv[:, 0] - AT_M - tear_m / 2) < tear_m / 2
    border |= along & (np.abs(uv[:, 1] - TEAR_AT_M) < STEP_M)
    return uv, np.full(len(uv), up), border.astype(int), a[kept], b[kept]


def layers(*each):
    """Several layers as one."""
    first = np.cumsum([0, *(len(uv) for uv, *_ in each)])
    uv, side, edge = (np.concatenate([layer[k] for layer in each]) for k in range(3))
    a, b = (np.concatenate([x[k] + n for x, n in zip(each, first)]) for k in (3, 4))
    length = np.linalg.norm(uv[a] - uv[b], axis=1)
    links = Links(a, b, length, np.zeros(len(a), dtype=bool), np.zeros(len(a)))
    return uv, side, edge, links


@pytest.mark.parametrize("spread_m", [0.0, 0.002, 0.02])
def test_stretches_are_what_all_pairs_within_reach_join(spread_m):
    """Thousands of points in a few clumps, chains between them, and some alone."""
    rng = np.random.default_rng(3)
    clumps = np.repeat(rng.uniform(-0.1, 0.1, (40, 2)), 60, axis=0)
    chain = np.column_stack([np.arange(0.2, 0.3, 0.0099), np.zeros(11)])  # just near enough
    apart = np.column_stack([np.arange(0.2, 0.3, 0.0101), np.ones(10)])  # just not
    clumps = clumps + rng.normal(0, spread_m, clumps.shape)
    sparse = np.vstack([rng.uniform([0, k], [0.2, k + 0.2], (50 * k, 2)) for k in (2, 4, 8)])
    inner = [[0.95, 0], [0.94, 0.5], [0.1, 0.9], [2.06, 0.99], [2.07, 0.5], [2.9, 0.1]]  # its
    # second joins the three before the gap with those after it, and is no outermost one
    points = np.vstack([clumps, chain, apart, sparse, [-0.7, -0.7] + 0.007 * np.array(inner)])
    points = points[rng.permutation(len(points))]
    i, j = cKDTree(points).query_pairs(0.01, output_type="ndarray").T
    found = stretches(points, 0.01)
    assert found.tolist() == pieces(i, j, np.ones(len(points), dtype=bool)).tolist()
    at = {tuple(p): label for p, label in zip(points.round(9), found, strict=True)}
    assert len({at[tuple(p)] for p in chain.round(9)}) == 1
    assert len({at[tuple(p)] for p in apart.round(9)}) == len(apart)


def test_nothing_has_no_stretches():
    assert stretches(np.zeros((0, 2)), 0.01).shape == (0,)


def test_a_slit_is_found_along_its_whole_length_and_nowhere_else():
    (found,) = slits(*layers(cloth(0.12)), CONFIG)
    assert len(found) > 30
    assert np.abs(found[:, 0] - AT_M).max() < 2 * STEP_M
    assert found[:, 1].min() < 0.01 and found[:, 1].max() == pytest.approx(0.12, abs=0.02)


def test_a_slit_with_strays_beside_it_is_one():
    (found,) = slits(*layers(cloth(0.12, tear_m=0.048)), CONFIG)
    off = np.abs(found[:, 0] - AT_M)
    assert off.max() < AWAY * STEP_M
    assert np.median(off) < STEP_M / 2
    assert np.ptp(found[off < STEP_M, 1]) > 0.09


def test_a_slit_of_which_little_is_closed_is_one():
    uv, *rest = cloth(0.15)
    uv[(uv[:, 0] > AT_M) & (uv[:, 1] < 0.078), 0] += 2 * STEP_M
    (found,) = slits(*layers((uv, *rest)), CONFIG)
    assert found[:, 1].min() < 0.01 and found[:, 1].max() == pytest.approx(0.15, abs=0.02)
    uv[(uv[:, 0] > AT_M) & (uv[:, 1] < 0.078), 0] += 2 * STEP_M  # too wide: a notch
    assert not slits(*layers((uv, *rest)), CONFIG)


@pytest.mark.parametrize(
    "whole", [{"slit_m": 0.0}, {"slit_m": 0.05}, {"slit_m": 0, "hole_m": 0.008}]
)
def test_a_sheet_a_notch_and_a_hole_are_none(whole):
    assert not slits(*layers(cloth(**whole)), CONFIG)


def test_an_item_has_a_slit_where_all_of_its_layers_do():
    (found,) = slits(*layers(cloth(0.12), cloth(0.12, up=-1.0)), CONFIG)
    assert len(found) > 60
    assert not slits(*layers(cloth(0.12), cloth(0.0, up=-1.0)), CONFIG)


def test_the_outline_goes_in_and_out_of_a_slit():
    uv, side, edge, links = layers(cloth(0.12), cloth(0.12, up=-1.0))
    sigma = np.full(len(uv), 0.002)
    shut = outline_of(uv, sigma, edge, CONFIG).uv
    line = outline_of(uv, sigma, edge, CONFIG, slits(uv, side, edge, links, CONFIG)).uv
    within = np.array([AT_M, 0.06])
    assert np.linalg.norm(shut - within, axis=1).min() > 0.05
    assert np.linalg.norm(line - within, axis=1).min() < 0.006
    assert twice_area(line) > 0.94 * twice_area(shut)


def test_the_outline_does_not_follow_what_runs_along_it():
    uv, _, edge, _ = layers(cloth(0.0), cloth(0.0, up=-1.0))
    sigma = np.full(len(uv), 0.002)
    along = np.column_stack([np.full(40, 0.006), np.linspace(0.0, SIDE_M, 40)])
    shut, line = (outline_of(uv, sigma, edge, CONFIG, cuts).uv for cuts in ((), (along,)))
    assert np.array_equal(shut, line)


def test_the_outline_follows_a_slit_that_is_known_wherever_it_runs():
    uv, _, edge, _ = layers(cloth(0.0), cloth(0.0, up=-1.0))
    sigma = np.full(len(uv), 0.002)
    line = np.column_stack([np.full(80, 0.012), np.linspace(-0.01, 0.12, 80)])
    shut, taken, known = (
        outline_of(uv, sigma, edge, CONFIG, cuts, slit=slit).uv
        for cuts, slit in (((), None), ((line,), None), ((), line))
    )
    assert np.array_equal(shut, taken)  # for the edge along the side of a rim
    assert twice_area(known) < twice_area(shut) - 0.002


def test_a_slit_may_go_on_among_strays_beyond_the_outline():
    uv, side, edge, links = layers(cloth(0.12), cloth(0.12, up=-1.0))
    sigma = np.full(len(uv), 0.002)
    (found,) = slits(uv, side, edge, links, CONFIG)
    longer = np.vstack([found, found - [0.0, 0.11]])
    line, same = (outline_of(uv, sigma, edge, CONFIG, (cut,)).uv for cut in (found, longer))
    assert abs(twice_area(line) / twice_area(same) - 1) < 0.02
