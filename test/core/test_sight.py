"""Sheets that end, and sheets that go on beneath another one, before a pinhole camera."""

from __future__ import annotations

import numpy as np
import pytest

from vflatten_ros.core.geometry import rigid, rotation_about
from vflatten_ros.core.raygrid import parallel_rays
from vflatten_ros.core.sight import PlacedSight, goes_on, sight_of

SHAPE, FOCAL_PX = (240, 320), 400.0
AWAY_M = 1.0
RIGHT, TOWARDS = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])


def image(*sheets):
    """What a camera at the origin, looking along z, sees of level rectangles.

    Each sheet is (x0, x1, z): from x0 to x1 and 0.2 m high, z away.
    """
    row, col = (v.ravel() for v in np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]])
    ray = np.c_[(col - 159.5) / FOCAL_PX, (row - 119.5) / FOCAL_PX, np.ones(len(row))]
    depth = np.full(len(row), np.inf)
    for x0, x1, z in sheets:
        on = (z * ray[:, 0] > x0) & (z * ray[:, 0] < x1) & (np.abs(z * ray[:, 1]) < 0.1)
        depth[on & (depth > z)] = z
    seen = np.isfinite(depth)
    pixel = np.c_[row, col][seen].astype(np.int32)
    return sight_of(depth[seen, None] * ray[seen], pixel, SHAPE)


def ends(x=0.0, z=AWAY_M):
    """Samples at the right end of a sheet that reaches from the left to x."""
    return np.column_stack([np.full(9, x - 0.002), np.linspace(-0.05, 0.05, 9), np.full(9, z)])


def told(*sights, xyz=None, normal=TOWARDS):
    xyz = ends() if xyz is None else xyz
    tile = np.ones((len(xyz), 1))
    placed = [PlacedSight(sight, np.eye(4)) for sight in sights]
    return goes_on(xyz, tile * normal, tile * RIGHT, placed)


SHEET = (-0.1, 0.0, AWAY_M)
# a slope of another depth far from the end: from one plane alone no camera can be found
ELSEWHERE = (-0.3, -0.2, 1.1)


@pytest.mark.parametrize("behind", [[], [(-0.1, 0.1, AWAY_M + 0.03)]])
def test_a_sheet_ends_where_the_camera_looks_past_it(behind):
    assert (told(image(SHEET, ELSEWHERE, *behind)) == 0).all()


def test_a_sheet_goes_on_beneath_another():
    over = (0.006, 0.1, AWAY_M - 0.01)
    assert (told(image(SHEET, ELSEWHERE, over)) == 1).all()


def test_a_sheet_goes_on_where_its_own_cloth_was_seen_but_not_linked():
    assert (told(image((-0.1, 0.1, AWAY_M), ELSEWHERE)) == 1).all()


def test_most_views_see_another_sheet_in_the_way_but_some_look_past():
    past, covered = image(SHEET, ELSEWHERE), image(SHEET, ELSEWHERE, (0.006, 0.1, AWAY_M - 0.01))
    assert (told(covered, covered, past) == 0).all()
    assert (told(covered, covered, covered, covered, past) == 1).all()


def test_views_that_do_not_see_the_end_tell_nothing():
    hidden = image(SHEET, ELSEWHERE, (-0.1, 0.1, AWAY_M - 0.1))
    assert (told(hidden) == -1).all()
    assert (told(image(SHEET, ELSEWHERE), normal=-TOWARDS) == -1).all()
    assert (told() == -1).all()


def test_views_are_placed_in_the_common_frame():
    turned = rigid(rotation_about(np.array([0.0, 1.0, 0.0]), 0.4), np.array([0.1, 0.0, -0.2]))
    sight = image(SHEET, ELSEWHERE)
    xyz = ends() @ turned[:3, :3].T + turned[:3, 3]
    normal, right = turned[:3, :3] @ TOWARDS, turned[:3, :3] @ RIGHT
    tile = np.ones((len(xyz), 1))
    placed = [PlacedSight(sight, turned)]
    assert (goes_on(xyz, tile * normal, tile * right, placed) == 0).all()
    assert (goes_on(xyz, tile * normal, -tile * right, placed) == 1).all()  # into the sheet


def test_beyond_the_image_a_view_tells_nothing():
    sight = image((-0.4, 0.0, AWAY_M), (0.2, 0.3, 1.1))  # the sheet leaves the image on its left
    left = -159.5 / FOCAL_PX * AWAY_M
    x = np.array([left + 0.002, left - 0.01, 0.1])
    at = np.column_stack([x, np.zeros(3), np.full(3, AWAY_M)])
    behind = sight.behind(at)
    assert abs(behind[0]) < 0.002 and np.isnan(behind[1]) and np.isinf(behind[2])


def test_a_sheet_does_not_end_where_the_image_does():
    whole, cut = image(SHEET, ELSEWHERE), image((0.1, 0.4, AWAY_M), ELSEWHERE)
    edge = 159.5 / FOCAL_PX * AWAY_M
    xyz = ends(edge)
    assert (told(cut, xyz=xyz) == 1).all()
    looks_past = PlacedSight(whole, rigid(np.eye(3), np.array([edge, 0.0, 0.0])))
    tile = np.ones((len(xyz), 1))
    placed = [PlacedSight(cut, np.eye(4)), looks_past]  # a view that shows it ending there
    assert (goes_on(xyz, tile * TOWARDS, tile * RIGHT, placed) == 0).all()


def test_parallel_rays():
    rays = parallel_rays(
        np.array([-0.15, -0.1, 0.0]), np.array([0, 0.002, 0]), np.array([0.002, 0, 0]), (100, 150)
    )
    row, col = (v.ravel() for v in np.mgrid[0:100, 0:75])
    depth = np.where(col < 20, 1.1, 1.0)
    points = rays.to_points(np.c_[row, col].astype(float), depth)
    sight = sight_of(points, np.c_[row, col].astype(np.int32), (100, 150))
    assert sight.grid.parallel
    end = points[(col == 74) & (row > 20) & (row < 80)]
    toward = points[0] - rays.to_points(np.zeros((1, 2)), np.array([2.0]))[0]
    assert (told(sight, xyz=end, normal=toward / np.linalg.norm(toward)) == 0).all()
    assert (told(sight, xyz=end, normal=-toward) == -1).all()


def test_an_unorganised_cloud_is_no_camera():
    points = np.random.default_rng(0).uniform(0, 0.1, (200, 3))
    pixel = np.column_stack([np.zeros(200), np.arange(200)]).astype(np.int32)
    assert sight_of(points, pixel, (1, 200)) is None
