"""One view alone: a bent sheet comes out as the rectangle that it is."""

import numpy as np
import pytest
from garments import HEIGHT_M, RADIUS_M, WIDTH_M, example_view
from sheet import seen_from

from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.one_view import flatten_one_view
from vflatten_ros.core.values import View


def seen_by_camera(rows=480, cols=360, focal=520.0, width_m=WIDTH_M):
    """The towel of garments.py, exactly where the camera's rays meet it, and its flat places."""
    return seen_from(3, 0.0, rows, cols, focal, size=(RADIUS_M, width_m, HEIGHT_M))


def test_a_bent_sheet_comes_out_as_its_rectangle():
    view, flat = seen_by_camera()
    done = flatten_one_view(view, Config())
    assert len(done.points.uv) > 200
    # the sheet turns away at its sides: a pixel there is 5 mm of cloth
    assert np.ptp(done.outline.uv, axis=0) == pytest.approx([WIDTH_M, HEIGHT_M], abs=0.006)
    # every point within a millimetre of its true place, turned and shifted as a whole
    true = {tuple(p): uv for p, uv in zip(view.pixel.tolist(), flat, strict=True)}
    goal = np.array([true[tuple(p)] for p in done.points.pixel.tolist()])
    a, b = done.points.uv - done.points.uv.mean(0), goal - goal.mean(0)
    left, _, right = np.linalg.svd(a.T @ b)
    assert np.linalg.norm(a @ left @ right - b, axis=1).max() < 0.001
    assert np.linalg.det(left @ right) > 0  # as the rig sees it, not mirrored
    assert set(done.points.view_id.tolist()) == {3}
    assert len(done.lines.length_m) > 10
    # its other side, and what hangs behind it, nobody saw
    assert [notice.code for notice in done.notices] == ["untrusted"]


def test_where_it_folds_away_only_what_is_seen_ends():
    view, _ = seen_by_camera(width_m=2.0 * np.pi * RADIUS_M)
    outline = flatten_one_view(view, Config()).outline
    low, high = outline.uv.min(axis=0), outline.uv.max(axis=0)
    inner = outline.uv[:, 1] > low[1] + 0.03, outline.uv[:, 1] < high[1] - 0.03
    side = inner[0] & inner[1]
    middle = np.abs(outline.uv[:, 0] - 0.5 * (low + high)[0]) < 0.25 * (high - low)[0]
    assert outline.inferred[side].mean() > 0.95
    assert outline.inferred[middle].mean() < 0.05  # the hems


def test_it_lies_as_it_hangs():
    view, _ = seen_by_camera()
    done = flatten_one_view(view, Config())
    height = view.points_view[:, 1]
    rows = {tuple(p): i for i, p in enumerate(view.pixel.tolist())}
    hanging = height[[rows[tuple(p)] for p in done.points.pixel.tolist()]]
    assert np.corrcoef(done.points.uv[:, 1], hanging)[0, 1] > 0.999


def test_a_few_specks_are_refused():
    view = example_view(0, 0.0)
    few = np.arange(0, len(view.points_rig), len(view.points_rig) // 20)
    specks = View(
        0, 0, 0.0, view.points_rig[few], view.pixel[few], None, view.shape, view.calibration
    )
    with pytest.raises(DisconnectedSurface, match="largest piece of cloth"):
        flatten_one_view(specks, Config())
