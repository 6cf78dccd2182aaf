"""Lines on a recorded view, whose lengths on the flat item the simulation knows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mcap_ros2")

from vflatten_ros.bag import gather_views, open_recording
from vflatten_ros.core.config import Config
from vflatten_ros.core.geodesics import OK, geodesic_lines
from vflatten_ros.core.surface import fit_surface
from vflatten_ros.files import load_calibration

SHIRT = Path(__file__).parents[1] / "bags" / "SH1_1"


@pytest.fixture(scope="module")
def view():
    recording = open_recording(SHIRT)
    calibration = load_calibration(SHIRT / "calibration.yaml")
    return gather_views(recording, calibration, Config()).views()[0]


def test_lines_just_inside_the_rim_of_a_fold_do_not_climb_to_the_layer_behind(view):
    with np.load(SHIRT / "truth.npz") as truth:
        here = (truth["view"] == 0) & truth["outer"] & ~truth["flying"]
        flat = np.full((*view.shape, 2), np.nan)
        flat[truth["row"][here], truth["col"][here]] = np.c_[truth["u"][here], truth["v"][here]]
    points, pixel = view.points_rig, view.pixel
    toward = -points / np.linalg.norm(points, axis=1, keepdims=True)
    surface = fit_surface(points, Config().surface, toward, pixel, view.shape)
    index = np.full(view.shape, -1)
    index[pixel[:, 0], pixel[:, 1]] = np.arange(len(pixel))
    pairs = np.array([[(107, 243), (22, 181)], [(27, 188), (104, 233)]])
    rows, cols = pairs[..., 0], pairs[..., 1]
    a, b = index[rows, cols].T
    exact = np.linalg.norm(np.diff(flat[rows, cols], axis=1)[:, 0], axis=1)
    found = geodesic_lines(surface, points[a], points[b], Config().geodesics)
    # noise at both ends and pixels of 2.5 mm, of more than 200 mm
    assert np.abs(found.length_m / exact - 1).max() < 0.02
    assert (found.reason == OK).all()
