"""Pieces of a sheet that are parted by what is in doubt."""

from __future__ import annotations

import numpy as np
import pytest

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.joining import agreeing, find_ties, largest_pieces, near_paths
from vflatten_ros.core.sheets import link_samples

UP = np.array([0.0, 0.0, 1.0])


def sheet(seed=7):
    rng = np.random.default_rng(seed)
    grid = np.mgrid[0:0.2:0.004, 0:0.1:0.004].reshape(2, -1).T
    flat = grid + rng.uniform(-0.0004, 0.0004, grid.shape)
    xyz = np.column_stack([flat, np.zeros(len(flat))])
    return xyz, link_samples(xyz, np.tile(UP, (len(xyz), 1)), RotationConfig())


def test_pieces_on_both_sides_of_a_doubtful_strip_are_tied_across_it():
    xyz, links = sheet()
    passable = np.abs(xyz[:, 0] - 0.08) > 0.008
    one, other = largest_pieces(links, passable, least=100)
    assert one.sum() > other.sum() > 400
    assert (xyz[one, 0] > 0.08).all() and (xyz[other, 0] < 0.08).all()
    ties = find_ties(links, one, other)
    assert len(ties.one) > 15
    assert one[ties.one].all() and other[ties.other].all()
    assert (np.abs(xyz[ties.one, 1] - xyz[ties.other, 1]) < 0.012).all()
    near = near_paths(xyz, ties.along(np.arange(len(ties.one))))
    assert len(largest_pieces(links, passable | near, least=100)) == 1


@pytest.mark.parametrize("mirrored", [False, True])
def test_right_ties_outvote_wrong_ones(mirrored):
    rng = np.random.default_rng(11)
    one = np.column_stack([np.linspace(0, 0.15, 40), 0.01 * rng.normal(size=40)])
    turn = np.array([[np.cos(2.0), -np.sin(2.0)], [np.sin(2.0), np.cos(2.0)]])
    if mirrored:
        turn = turn @ np.diag([1.0, -1.0])
    other = one @ turn.T + [0.3, -0.2] + 0.001 * rng.normal(size=(40, 2))
    wrong = np.arange(40) % 3 == 0
    other[wrong] = rng.uniform(-0.3, 0.3, (wrong.sum(), 2))
    met = agreeing(one, other, np.full(40, 0.005))
    assert met[~wrong].mean() > 0.9
    assert met[wrong].mean() < 0.2


def test_ties_in_one_place_alone_tell_no_direction():
    one = np.zeros((5, 2)) + 0.001 * np.arange(5)[:, None]
    assert not agreeing(one, one + 0.1, np.full(5, 0.005)).any()
