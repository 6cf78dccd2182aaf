"""Distances along linked samples, on surfaces whose distances are known."""

from __future__ import annotations

import numpy as np
import pytest

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.distances import largest_pieces, link_steps, surface_distances
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.sheets import Links, link_samples

CONFIG = RotationConfig(landmarks=60)


def rolled(radius_m: float, width_m: float = 0.2, height_m: float = 0.2, seed: int = 3):
    """Samples, normals and flat places of a sheet rolled round a cylinder, unevenly spread."""
    rng = np.random.default_rng(seed)
    grid = np.mgrid[0:width_m:0.004, 0:height_m:0.004].reshape(2, -1).T
    flat = grid + rng.uniform(-0.001, 0.001, grid.shape)
    angle = flat[:, 0] / radius_m
    normal = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    xyz = radius_m * normal + flat[:, 1:] * [0.0, 0.0, 1.0]
    return xyz, normal, flat


def measured(xyz, normal, config=CONFIG, passable=None):
    links = link_samples(xyz, normal, config)
    passable = np.ones(len(xyz), dtype=bool) if passable is None else passable
    return surface_distances(xyz, normal, links, passable, config)


@pytest.mark.parametrize("radius_m", [0.05, 0.1, 10.0])
def test_straightened_paths_have_the_length_of_the_unrolled_sheet(radius_m):
    xyz, normal, flat = rolled(radius_m)
    found = measured(xyz, normal)
    at = flat[found.chosen]
    true = np.linalg.norm(at[:, None] - at[None], axis=2)
    near = found.same_sheet & (true > 0.03)
    ratio = found.bound_m[near] / true[near]
    assert near.sum() > 200
    assert abs(np.median(ratio) - 1) < 0.003  # paths over links alone are 3-4 % long
    assert np.quantile(np.abs(ratio - 1), 0.95) < 0.015


def test_far_distances_over_landmarks_are_hardly_too_long():
    xyz, normal, flat = rolled(10.0, width_m=0.4)
    found = measured(xyz, normal, RotationConfig(landmarks=150))
    at = flat[found.chosen]
    true = np.linalg.norm(at[:, None] - at[None], axis=2)
    ratio = found.bound_m[true > 0.25] / true[true > 0.25]
    assert 0.995 < np.median(ratio) < 1.01


def test_a_string_of_samples_is_no_surface():
    n = 200
    xyz = np.column_stack([np.arange(n) * 0.008, np.zeros((n, 2))])
    normal = np.tile([0.0, 0.0, 1.0], (n, 1))
    at = np.arange(n - 1)
    along = Links(at, at + 1, np.full(n - 1, 0.008), np.zeros(n - 1, dtype=bool), np.zeros(n - 1))
    with pytest.raises(DisconnectedSurface, match="0 of 200 samples hang on others"):
        surface_distances(xyz, normal, along, np.ones(n, dtype=bool), CONFIG)


def test_two_sheets_far_apart_raise():
    xyz, normal, _ = rolled(10.0, width_m=0.1)
    twice = np.vstack([xyz + np.array([x, 0.0, 0.0]) for x in (0.0, 1.0, 2.0)])
    with pytest.raises(DisconnectedSurface, match="pieces"):
        measured(twice, np.vstack([normal] * 3))


def test_distances_past_samples_in_doubt_are_those_of_the_sheet():
    xyz, normal, flat = rolled(0.1, width_m=0.2, height_m=0.2)
    wall = (np.abs(flat[:, 0] - 0.1) < 0.007) & (flat[:, 1] < 0.12)
    found = measured(xyz, normal, passable=~wall)
    at = flat[found.chosen]
    assert not wall[found.chosen].any()
    left = np.argmin(np.linalg.norm(at - [0.05, 0.05], axis=1))
    right = np.argmin(np.linalg.norm(at - [0.15, 0.05], axis=1))
    tip = np.array([0.1, 0.12])
    round_it = np.linalg.norm(at[left] - tip) + np.linalg.norm(at[right] - tip)
    straight = np.linalg.norm(at[left] - at[right])
    assert round_it > 1.2 * straight  # the path went round, and was laid out
    assert found.same_sheet[left, right]
    assert 0.98 < found.bound_m[left, right] / straight < 1.02
    rim_of_wall = wall & (np.abs(flat[:, 0] - 0.1) > 0.004)
    assert found.inside[rim_of_wall].mean() > 0.9
    assert np.isfinite(found.around_m[found.inside]).any(1).all()


def test_paths_that_may_end_in_doubt_do_not_meet_there():
    """A sheet rolled to a tube that does not quite close, with samples in doubt in the gap."""
    radius_m, gap_m = 0.05, 0.012
    length_m = 2 * np.pi * radius_m
    xyz, normal, flat = rolled(radius_m, width_m=length_m, height_m=0.08)
    gap = (flat[:, 0] < gap_m / 2) | (flat[:, 0] > length_m - gap_m / 2)
    found = measured(xyz, normal, passable=~gap)
    u = flat[found.chosen, 0]
    assert not gap[found.chosen].any()
    one, other = u < 0.03, u > length_m - 0.03
    assert one.any() and other.any()
    assert found.inside[gap].mean() > 0.9  # paths end there
    assert found.bound_m[np.ix_(one, other)].min() > 0.95 * (length_m - 0.06)


def test_links_among_some_samples_are_those_of_these_samples_alone():
    xyz, normal, flat = rolled(10.0, width_m=0.1, height_m=0.1)
    some = flat[:, 0] < 0.05
    among = link_samples(xyz, normal, CONFIG).among(some)
    assert len(among.a) > 500
    length = np.linalg.norm(xyz[some][among.a] - xyz[some][among.b], axis=1)
    assert np.abs(length - among.length_m).max() < 1e-3


def test_steps_among_some_samples_are_those_of_these_samples_alone():
    xyz, normal, _ = rolled(0.05)
    some = np.random.default_rng(4).random(len(xyz)) < 0.7
    links = link_samples(xyz, normal, CONFIG)
    steps = link_steps(xyz, normal, links).among(some)
    alone = link_steps(xyz[some], normal[some], links.among(some))
    for one, other in zip(vars(steps).values(), vars(alone).values(), strict=True):
        assert np.array_equal(one, other)


def test_pieces_on_both_sides_of_a_strip_come_largest_first():
    xyz, normal, flat = rolled(10.0)
    links = link_samples(xyz, normal, CONFIG)
    passable = np.abs(flat[:, 0] - 0.08) > 0.012
    one, other = largest_pieces(links, passable, least=100)
    assert one.sum() > other.sum() > 500
    assert (flat[one, 0] > 0.08).all() and (flat[other, 0] < 0.08).all()
    assert len(largest_pieces(links, passable, least=int(other.sum()))) == 1
    assert len(largest_pieces(links, passable | True, least=100)) == 1
