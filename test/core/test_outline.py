"""Outlines of flat samples: where they end the cloth, and where it goes on unseen."""

from __future__ import annotations

import numpy as np
import pytest

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.distances import link_steps
from vflatten_ros.core.fusion import Samples
from vflatten_ros.core.geometry import twice_area
from vflatten_ros.core.rotation import Surface, edges_laid, outline_of
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
