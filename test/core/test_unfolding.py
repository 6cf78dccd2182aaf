"""Distances to plane: sheets, tubes and parts whose flat shape is known."""

from __future__ import annotations

import numpy as np
import pytest

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.unfolding import (
    carry,
    creased,
    orientation,
    place_samples,
    relaxed,
    settle,
    unfold,
)

CONFIG = RotationConfig(unfold_rounds=8)


def aligned(points, true):
    """Points moved rigidly, mirror images allowed, onto the truth."""
    a, b = points - points.mean(0), true - true.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    return a @ u @ vt + true.mean(0)


def plane_of(count, width, height, seed=0):
    return np.random.default_rng(seed).uniform(0, 1, (count, 2)) * [width, height]


def test_a_sheet_comes_out_as_it_is():
    true = plane_of(120, 0.3, 0.5)
    bound = np.linalg.norm(true[:, None] - true[None], axis=2)
    found = aligned(unfold(bound, bound < 0.15, CONFIG), true)
    assert np.abs(found - true).max() < 1e-4


def test_a_tube_creases_to_half_its_girth():
    girth, height = 0.3, 0.4
    at = plane_of(300, girth, height, seed=4)
    along = np.abs(at[:, None, 0] - at[None, :, 0])
    bound = np.hypot(np.minimum(along, girth - along), at[:, None, 1] - at[None, :, 1])
    plane = unfold(bound, bound < 0.08, CONFIG)
    extent = np.ptp(aligned(plane, np.c_[np.zeros(300), at[:, 1]]), axis=0)
    assert extent[0] == pytest.approx(girth / 2, rel=0.08)
    assert extent[1] == pytest.approx(np.ptp(at[:, 1]), rel=0.03)


def test_a_round_tube_creases_sharply():
    """It is one sheet all around: only pairs across two lines give way, and nothing stretches."""
    girth, height = 0.6, 0.3
    at = plane_of(300, girth, height, seed=7)
    along = np.abs(at[:, None, 0] - at[None, :, 0])
    bound = np.hypot(np.minimum(along, girth - along), at[:, None, 1] - at[None, :, 1])
    near = bound < 0.25
    plane = unfold(bound, near, CONFIG)
    flat = np.linalg.norm(plane[:, None] - plane[None], axis=2)
    assert (flat - bound)[near].max() < 0.008
    extent = np.ptp(aligned(plane, np.c_[np.zeros(300), at[:, 1]]), axis=0)
    assert extent[0] == pytest.approx(girth / 2, rel=0.02)
    assert extent[1] == pytest.approx(np.ptp(at[:, 1]), rel=0.02)
    assert 0.1 < creased(plane, bound, near) < 0.3


def sleeve(seed=3):
    """A sleeve on a body, and the same bent upwards along its length, by 0.3 rad at its end."""
    rng = np.random.default_rng(seed)
    body = rng.uniform([-0.3, -0.4], [0.0, 0.0], (120, 2))
    arm = rng.uniform([0.0, -0.09], [0.35, 0.0], (80, 2))
    true = np.vstack([body, arm])
    bent = true.copy()
    angle = np.maximum(true[:, 0], 0.0) / 0.35 * 0.3
    bent[:, 1] += np.maximum(true[:, 0], 0.0) * angle / 2
    bent += true[:, 1:] * np.column_stack([-np.sin(angle), np.cos(angle) - 1.0])
    bound = np.linalg.norm(true[:, None] - true[None], axis=2)
    bound *= 1.0 + np.triu(rng.normal(0, 0.003, bound.shape), 1)
    return true, bent, np.triu(bound) + np.triu(bound).T


def test_a_bent_sleeve_is_straight_once_relaxed():
    true, bent, bound = sleeve()
    near = bound < 0.1
    off = {
        name: np.linalg.norm(aligned(plane, true) - true, axis=1).max()
        for name, plane in (
            ("bent", bent),
            ("settled", settle(bent, bound, near, CONFIG)),
            ("relaxed", relaxed(bent, bound, near)),
        )
    }
    assert off["bent"] > 0.03
    assert off["settled"] > 0.01  # as majorisation leaves it
    assert off["relaxed"] < 0.003


def test_what_lies_right_stays_where_it_is_when_relaxed():
    true = np.add(plane_of(120, 0.3, 0.5), [3.0, -2.0])
    bound = np.linalg.norm(true[:, None] - true[None], axis=2)
    assert np.abs(relaxed(true, bound, bound < 0.15) - true).max() < 1e-9


def test_what_is_relaxed_neither_spreads_nor_closes_up():
    """Two sheets with upper bounds between them only."""
    true = plane_of(160, 0.2, 0.3, seed=5) + np.repeat([[0.0, 0.0], [0.25, 0.0]], 80, axis=0)
    bound = np.linalg.norm(true[:, None] - true[None], axis=2)
    sheet = np.repeat([0, 1], 80)
    same = sheet[:, None] == sheet
    found = relaxed(true, np.where(same, bound, bound + 0.05), same & (bound < 0.1))
    assert np.abs(found - true).max() < 1e-6


def test_a_sheet_has_no_creases_and_one_folded_over_has():
    true = plane_of(200, 0.3, 0.4)
    bound = np.linalg.norm(true[:, None] - true[None], axis=2)
    assert creased(true, bound, bound < 0.15) == 0.0
    folded = np.c_[np.abs(true[:, 0] - 0.15), true[:, 1]]
    across = (true[:, None, 0] < 0.15) != (true[None, :, 0] < 0.15)
    share = creased(folded, bound, bound < 0.15)
    assert 0.5 * across[bound < 0.15].mean() < share < across[bound < 0.15].mean()
    assert creased(true, bound, np.zeros_like(across)) == 0.0


def test_some_wrong_bounds_that_are_too_long_do_no_harm():
    true = plane_of(150, 0.3, 0.4)
    bound = np.linalg.norm(true[:, None] - true[None], axis=2)
    far = np.triu(np.random.default_rng(1).random(bound.shape) < 0.1, 1) & (bound > 0.15)
    loose = np.where(far | far.T, bound * 1.5, bound)
    found = aligned(unfold(loose, bound < 0.15, CONFIG), true)
    assert np.median(np.linalg.norm(found - true, axis=1)) < 0.003


def test_settling_keeps_what_is_right():
    true = plane_of(80, 0.3, 0.4)
    bound = np.linalg.norm(true[:, None] - true[None], axis=2)
    assert np.abs(settle(true, bound, bound < 0.15, CONFIG) - true).max() < 1e-4


def test_samples_are_placed_by_their_distances():
    rng = np.random.default_rng(2)
    marks, true = plane_of(60, 0.3, 0.3), plane_of(200, 0.26, 0.26, seed=3) + 0.02
    distance = np.linalg.norm(true[:, None] - marks[None], axis=2)
    around = np.argsort(distance, axis=1)[:, :10]
    near = np.take_along_axis(distance, around, 1) + rng.normal(0, 0.0005, around.shape)
    uv, misfit = place_samples(around, near, np.ones_like(near, dtype=bool), marks)
    assert np.quantile(np.linalg.norm(uv - true, axis=1), 0.9) < 0.002
    assert np.median(misfit) < 0.001
    blind = np.full_like(near, np.inf)
    uv, misfit = place_samples(around, blind, np.ones_like(near, dtype=bool), marks)
    assert np.isnan(uv).all() and np.isinf(misfit).all()


def test_a_mirrored_part_lies_with_its_outside_down():
    flat = np.mgrid[0:0.1:0.005, 0:0.1:0.005].reshape(2, -1).T
    xyz, normal = np.c_[flat, np.zeros(len(flat))], np.tile([0.0, 0.0, 1.0], (len(flat), 1))
    apart = np.linalg.norm(flat[:, None] - flat[None], axis=2)
    a, b = np.nonzero(np.triu(apart < 0.008, 1))
    assert (orientation(flat, xyz, normal, a, b) == 1).all()
    assert (orientation(flat * [-1, 1], xyz, normal, a, b) == -1).all()


def test_a_sample_with_two_landmarks_near_lies_nowhere_and_its_neighbours_lie_on():
    marks = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])
    at = np.array([[0.04, 0.04], [0.05, 0.05], [0.06, 0.03]])
    around = np.tile(np.arange(3), (3, 1))
    near = np.linalg.norm(at[:, None] - marks, axis=2)
    near[1, 2] = np.inf
    uv, misfit = place_samples(around, near, np.ones((3, 3), dtype=bool), marks)
    assert np.isnan(uv[1]).all() and np.isinf(misfit[1])
    assert uv[[0, 2]] == pytest.approx(at[[0, 2]], abs=1e-4)


def test_which_way_up_what_lies_beside_the_unplaced_is_clear():
    flat = np.stack(np.meshgrid(np.arange(6), np.arange(6)), -1).reshape(-1, 2) * 0.01
    xyz, normal = np.c_[flat, np.zeros(36)], np.tile([0.0, 0.0, 1.0], (36, 1))
    a, b = np.nonzero(np.triu(np.linalg.norm(flat[:, None] - flat, axis=2) < 0.015, 1))
    uv = flat.copy()
    uv[:12] = np.nan  # the cloth there belongs to another group
    up = orientation(uv, xyz, normal, a, b)
    assert (up[12:] == 1).all() and (up[:12] == 0).all()


def test_points_follow_the_part_of_the_outline_that_turns():
    """An L whose long arm turns by 40 degrees about the corner."""
    outline = np.array([[0, 0], [0.1, 0], [0.1, -0.5], [0.2, -0.5], [0.2, 0.1], [0, 0.1]])
    angle = np.radians(40)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    arm = [2, 3]
    moved = outline.copy()
    moved[arm] = (outline[arm] - outline[1]) @ turn.T + outline[1]
    points = np.array([[0.15, -0.45], [0.05, 0.05]])
    found = carry(points, outline, moved)
    expected = (points[0] - outline[1]) @ turn.T + outline[1]
    assert np.linalg.norm(found[0] - expected) < 0.01
    assert np.linalg.norm(found[1] - points[1]) < 0.01
