"""A column seen from all round by stereo that finds depths where there is nothing."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from round_column import COLS, FOCAL_PX, RADIUS_M, ROWS, VIEWS, column

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.fused import fuse_views
from vflatten_ros.core.geometry import inverse, transform_points
from vflatten_ros.core.looked_past import (
    NOTED,
    kept_rows,
    looked_past,
    notice_of,
    share_looked_past,
)
from vflatten_ros.core.registration import view_surface

APART_M = 0.0007
SPECK_PX = 5


def at_depth(view, pixel, depth_m):
    """The view with other points at some pixels."""
    old = {tuple(p): k for k, p in enumerate(view.pixel)}
    kept = np.ones(len(view.pixel), bool)
    kept[[old[tuple(p)] for p in pixel if tuple(p) in old]] = False
    row, col = pixel.T
    ray = np.column_stack(
        [(col - (COLS - 1) / 2) / FOCAL_PX, (row - 20.0) / FOCAL_PX, np.ones(len(pixel))]
    )
    return dataclasses.replace(
        view,
        points_rig=np.vstack([view.points_rig[kept], ray * depth_m]),
        pixel=np.vstack([view.pixel[kept], pixel]).astype(np.int32),
    )


def without(view, rows):
    kept = np.setdiff1d(np.arange(len(view.pixel)), rows)
    return dataclasses.replace(view, points_rig=view.points_rig[kept], pixel=view.pixel[kept])


def block(row, col, px=SPECK_PX):
    return np.array([row, col]) + np.argwhere(np.ones((px, px)))


@cache
def specked(specks=4):
    """Views, each with some square specks before or beside the column, and their surfaces."""
    random = np.random.default_rng(3)
    seen = []
    for k in range(VIEWS):
        view = dataclasses.replace(column(2 * np.pi * k / VIEWS, 0), view_id=k)
        for _ in range(specks):
            place = block(int(random.integers(5, ROWS - 10)), int(random.integers(0, COLS - 6)))
            view = at_depth(view, place, random.uniform(1.05, 1.17))
        seen.append(view)
    return seen, [view_surface(view, RotationConfig()) for view in seen]


def off_m(points_rig):
    """How far points are from the column, m."""
    return np.abs(np.hypot(points_rig[:, 0], points_rig[:, 2] - 1.3) - RADIUS_M)


def past(surfaces, apart_m=APART_M):
    return looked_past(surfaces, [np.eye(4)] * len(surfaces), apart_m)


def with_view(k, view):
    """The clean column's views, one of them another."""
    seen, surfaces = map(list, specked(0))
    seen[k], surfaces[k] = view, view_surface(view, RotationConfig())
    return seen, surfaces


def test_specks_are_looked_past_and_the_column_is_not():
    seen, surfaces = specked()
    off = np.concatenate(
        [off_m(v.points_rig[s.index]) for v, s in zip(seen, surfaces, strict=True)]
    )
    found = np.concatenate(past(surfaces))
    assert (off > 0.02).sum() > 1000
    assert found[off > 0.02].mean() > 0.95
    assert found[off < 0.004].mean() < 0.001


def test_of_a_clean_column_hardly_anything_is():
    assert np.concatenate(past(specked(0)[1])).mean() < 0.1 * NOTED


def test_holes_of_other_views_are_no_sight_past():
    clean, _ = specked(0)
    random = np.random.default_rng(1)
    seen = []
    for view in clean:
        hole = np.zeros((ROWS, COLS), bool)
        for _ in range(6):
            row, col = random.integers(0, ROWS - 18), random.integers(40, 90)
            hole[row : row + 18, col : col + 18] = True
        seen.append(without(view, np.flatnonzero(hole[tuple(view.pixel.T)])))
    assert sum(len(v.pixel) for v in seen) < 0.85 * sum(len(v.pixel) for v in clean)
    found = past([view_surface(view, RotationConfig()) for view in seen])
    assert np.concatenate(found).mean() < 0.01


def test_one_view_that_looks_past_is_not_believed():
    seen = [column(angle, 0) for angle in (0.0, np.radians(20.0))]
    seen[0] = at_depth(seen[0], block(40, 70), 1.12)
    found = past([view_surface(view, RotationConfig()) for view in seen])
    assert not np.concatenate(found).any()


@pytest.mark.parametrize(("apart_m", "told"), [(0.001, True), (0.01, False)])
def test_views_that_differ_more_tell_of_coarser_things_only(apart_m, told):
    hanging = block(40, COLS // 2 - 3)
    view = at_depth(specked(0)[0][0], hanging, 1.3 - RADIUS_M - 0.012)
    seen, surfaces = with_view(0, view)
    found = past(surfaces, apart_m)
    there = off_m(seen[0].points_rig[surfaces[0].index]) > 0.01
    assert there.sum() > 10
    assert found[0][there].all() == told == found[0].any()


def test_the_share_of_some_points_tells_that_of_all():
    _, surfaces = specked()
    told = share_looked_past(surfaces, [np.eye(4)] * len(surfaces), APART_M)
    assert told == pytest.approx(np.concatenate(past(surfaces)).mean(), rel=0.25)


def test_of_views_that_do_not_fit_together_nothing_is_taken():
    _, surfaces = specked()
    random = np.random.default_rng(5)
    poses = [np.eye(4) for _ in surfaces]
    for pose in poses:
        pose[:2, 3] = random.normal(0.0, 0.1, 2)
    assert np.concatenate(looked_past(surfaces, poses, APART_M)).mean() > 0.3
    assert kept_rows(surfaces, poses, APART_M) == (0.0, [])


def test_a_view_of_which_hardly_anything_is_borne_out_is_left():
    view = column(0.0, 0)
    view = dataclasses.replace(view, points_rig=0.9 * view.points_rig)
    _, surfaces = with_view(0, view)
    share, rows = kept_rows(surfaces, [np.eye(4)] * len(surfaces), APART_M)
    assert 0.02 < share < 0.05
    assert (rows[0] == surfaces[0].index).all()
    assert all(len(r) > 0.9 * len(s.index) for r, s in zip(rows, surfaces, strict=True))


def test_what_is_looked_past_leaves_no_samples():
    seen, surfaces = specked()
    prepared = dict(enumerate(surfaces))
    kept = fuse_views(seen, RotationConfig(trim_edges=False), prepared=prepared)
    cleared = fuse_views(seen, RotationConfig(), prepared=prepared)
    off = [np.abs(np.hypot(*f.samples.xyz[:, :2].T) - RADIUS_M) for f in (kept, cleared)]
    assert (off[0] > 0.01).mean() > 0.03
    assert (off[1] > 0.01).mean() < 0.002
    assert "looked_past" in {n.code for n in cleared.notices}
    for k, view in enumerate(seen):  # every point is that of its pixel
        at_pixel = {tuple(pixel): row for row, pixel in enumerate(view.pixel)}
        mine = cleared.points.view == k
        rows = [at_pixel[tuple(pixel)] for pixel in cleared.point_pixel[mine]]
        T_hanger_rig = inverse(view.calibration.T_rig_hanger(view.angle_rad))
        measured = transform_points(T_hanger_rig, view.points_rig[rows])
        assert np.linalg.norm(measured - cleared.points.xyz[mine], axis=1).max() < 0.01


def test_a_clean_rotation_is_left_as_it_is():
    seen, surfaces = specked(0)
    found = fuse_views(seen, RotationConfig(), prepared=dict(enumerate(surfaces)))
    assert "looked_past" not in {n.code for n in found.notices}


def test_the_notice_says_how_much():
    assert "7.0%" in notice_of(0.07).text
