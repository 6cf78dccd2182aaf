"""Pieces with a known place, parted and put together again."""

from __future__ import annotations

import numpy as np
import pytest

from vflatten_ros.core.puzzle import Motion, Ties, agreeing, overlap, put_together

STEP_M = 0.006
SLACK_M = 0.004


def plane(low, high):
    """Places of a rectangle's samples."""
    u, v = np.meshgrid(np.arange(low[0], high[0], STEP_M), np.arange(low[1], high[1], STEP_M))
    return np.column_stack([u.ravel(), v.ravel()])


def shirt():
    """Front 0.3 x 0.4 m; behind it its back, in two parts; all hems meet."""
    front = plane((0.0, 0.0), (0.3, 0.4))
    left, right = plane((0.0, 0.0), (0.14, 0.4)), plane((0.16, 0.0), (0.3, 0.4))
    flat = np.vstack([front, left, right])
    number = np.repeat([0, 1, 2], [len(front), len(left), len(right)])
    side = np.where(number == 0, 1.0, -1.0)
    return flat, number, side


def laid_apart(flat, number, side):
    """Every piece in a plane of its own, seen from its outside."""
    motions = [
        Motion(False, 1.0, 0.0),
        Motion(True, np.exp(2.1j), 0.3 - 0.2j),
        Motion(True, np.exp(-0.7j), -0.1 + 0.5j),
    ]
    uv, up = [], []
    for k, motion in enumerate(motions):
        own = np.full((len(flat), 2), np.nan)
        z = motion(flat[number == k] @ np.array([1, 1j]))
        own[number == k] = np.column_stack([z.real, z.imag])
        uv.append(own)
        up.append(np.where(number == k, -side if motion.mirrored else side, 0.0))
    return uv, up


def hem_ties(flat, number, outer_only=True):
    """Front samples at the edge with the back sample below them."""
    at_edge = (np.abs(flat[:, 0] - 0.15) > 0.143) | (np.abs(flat[:, 1] - 0.2) > 0.193)
    one = np.flatnonzero((number == 0) & at_edge)
    other = []
    for i in one:
        away = np.where(number > 0, np.abs(flat - flat[i]).max(axis=1), np.inf)
        other.append(int(away.argmin()) if away.min() < STEP_M else -1)
    keep = np.array(other) >= 0
    return one[keep], np.array(other)[keep]


def wrong_ties(number, count, seed=5):
    rng = np.random.default_rng(seed)
    return rng.choice(np.flatnonzero(number == 0), count), rng.choice(
        np.flatnonzero(number == 2), count
    )


def put(flat, number, side, one, other, least=12):
    uv, up = laid_apart(flat, number, side)
    ties = Ties(one, other, np.full(len(one), SLACK_M))
    return put_together([number == k for k in range(3)], uv, up, ties, least)


def test_front_and_back_of_a_shirt_are_put_together_by_their_hems():
    flat, number, side = shirt()
    one, other = hem_ties(flat, number)
    bad_one, bad_other = wrong_ties(number, 40)
    found = put(flat, number, side, np.r_[one, bad_one], np.r_[other, bad_other])
    assert (found.group == 0).all()
    assert np.abs(found.z - flat @ np.array([1, 1j])).max() < 0.004
    assert (found.side == side).all()
    assert found.met[: len(one)].mean() > 0.97
    assert found.met[len(one) :].mean() < 0.1


def test_round_a_straight_rim_lies_the_other_side_of_the_cloth():
    flat, number, side = shirt()
    one, other = hem_ties(flat, number)
    bottom = (number[other] == 1) & (flat[one, 1] < 0.003)
    found = put(flat, number, side, one[bottom], other[bottom], least=8)
    back = number == 1
    assert (found.group[back] == 0).all()
    assert (found.side[back] == -1.0).all()
    assert np.abs(found.z[back] - flat[back] @ np.array([1, 1j])).max() < 0.02


def test_a_short_contact_joins_nothing():
    flat, number, side = shirt()
    one, other = hem_ties(flat, number)
    short = (number[other] == 1) | (np.abs(flat[one, 1] - 0.2) < 0.03)
    assert (number[other[short]] == 2).sum() > 5
    found = put(flat, number, side, one[short], other[short])
    assert (found.group[number < 2] == 0).all()
    assert (found.group[number == 2] == 2).all()


def test_a_piece_does_not_come_to_lie_on_the_same_side_of_another():
    flat, number, side = shirt()
    one, other = hem_ties(flat, number)
    left = number[other] == 1
    # where the left back is, the right back fits as well
    false = [
        int(
            np.where(number == 2, np.abs(flat - [0.16, 0.0] - flat[i]).max(axis=1), np.inf).argmin()
        )
        for i in other[left][::2]
    ]
    found = put(flat, number, side, np.r_[one[left], one[left][::2]], np.r_[other[left], false])
    assert (found.group[number == 1] == 0).all()
    assert (found.group[number == 2] == 2).all()


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_motion_that_most_ties_agree_on_is_found(mirrored):
    rng = np.random.default_rng(11)
    one = np.linspace(0, 0.3, 80) + 0.01j * rng.normal(size=80)
    true = Motion(mirrored, np.exp(2.0j), 0.3 - 0.2j)
    back = (one - true.shift) / true.turn
    other = back.conj() if mirrored else back
    wrong = np.arange(80) % 3 == 0
    other[wrong] = rng.uniform(-0.3, 0.3, wrong.sum()) + 1j * rng.uniform(-0.3, 0.3, wrong.sum())
    met, motion, places = agreeing(one, other, np.full(80, SLACK_M), mirrored)
    assert met[~wrong].all() and met[wrong].mean() < 0.2
    assert motion.mirrored == mirrored
    assert np.abs(motion(other[~wrong]) - one[~wrong]).max() < 0.003
    assert places > 15


def test_ties_in_one_place_tell_no_direction():
    one = np.zeros(6, dtype=complex) + 0.001 * np.arange(6)
    assert agreeing(one, one + 0.1, np.full(6, SLACK_M), False)[2] == 0


def test_overlap_counts_the_same_side_only():
    sheet = plane((0.0, 0.0), (0.2, 0.2)) @ np.array([1, 1j])
    up = np.ones(len(sheet))
    assert overlap(sheet, up, sheet + 0.1, up) > 0.3
    assert overlap(sheet, up, sheet + 0.1, -up) == 0.0
    assert overlap(sheet, up, sheet + 0.5, up) == 0.0
