"""Whether what lies flat is one sheet, or a front and a back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flat import lying_at

from vflatten_ros.categories import load_templates
from vflatten_ros.core.config import RecognitionConfig
from vflatten_ros.core.doubled import APART_M, AROUND, doubled_share
from vflatten_ros.core.errors import InvalidConfig
from vflatten_ros.core.recognition import recognise
from vflatten_ros.core.templates import templates_from
from vflatten_ros.core.values import Outline

STEP_M = 0.005
WIDE_M, LONG_M = 0.40, 0.45


def faces(apart_m, below_m=LONG_M):
    """Both faces of a rectangle; below a height they hang apart, above it on each other."""
    front = np.mgrid[0:WIDE_M:STEP_M, 0:LONG_M:STEP_M].reshape(2, -1).T
    points = lying_at(np.vstack([front, front + STEP_M / 2]))
    back = np.arange(len(points.uv)) >= len(front)
    points.xyz_hanger[back, 2] = np.where(points.uv[back, 1] < below_m, apart_m, 0.002)
    return points


def test_two_faces_of_one_sheet_are_not_doubled_though_it_hangs_in_a_roll():
    points = faces(0.002)
    u, v = points.uv.T
    radius = 0.05 + points.xyz_hanger[:, 2]
    rolled = np.column_stack([radius * np.cos(u / 0.05), radius * np.sin(u / 0.05), v])
    assert doubled_share(replace(points, xyz_hanger=rolled)) == 0.0


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_layers_that_hang_apart_are_doubled(share):
    points = faces(2 * APART_M, share * LONG_M)
    assert doubled_share(points) == pytest.approx(share, abs=0.03)
    assert doubled_share(faces(APART_M / 2, share * LONG_M)) == 0.0


def test_what_was_not_seen_does_not_count_nor_do_a_few_points():
    points = faces(2 * APART_M)
    back = np.arange(len(points.uv)) >= len(points.uv) // 2
    assert doubled_share(replace(points, inferred=back)) == 0.0
    few = lying_at(np.zeros((AROUND, 2)))
    few.xyz_hanger[:, 2] = np.arange(AROUND)
    assert doubled_share(few) == 0.0


def test_a_rectangle_of_two_layers_is_no_towel():
    corners = np.array([[0, 0], [WIDE_M, 0], [WIDE_M, LONG_M], [0, LONG_M]])
    share = np.arange(0.0, 1.0, 0.01)[:, None]
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    line = np.vstack([a + share * (b - a) for a, b in sides])
    outline = Outline(line, np.full(len(line), 0.004), np.zeros(len(line), dtype=bool))
    templates, config = load_templates(), RecognitionConfig()
    one, two = (recognise(outline, faces(m), templates, config) for m in (0.002, 0.04))
    assert one.category == "towel" and one.probabilities["towel"] > 0.9
    assert two.category != "towel" and two.probabilities["towel"] < 0.01
    only = [t for t in templates if t.single_sheet]
    assert [t.category for t in only] == ["towel"]


def test_whether_an_item_is_one_sheet_is_yes_or_no():
    cloth = {
        "category": "cloth",
        "sizes": {"side": {"typical": 0.3, "spread": 0.2}},
        "half": [{"at": at} for at in ([0, 0], ["side", 0], ["side", "side"], [0, "side"])],
        "measurements": {"width": [[0, 0], ["side", 0]], "length": [[0, 0], [0, "side"]]},
    }
    assert not templates_from([cloth])[0].single_sheet
    assert templates_from([cloth | {"single_sheet": True}])[0].single_sheet
    with pytest.raises(InvalidConfig, match=r"cloth.*single_sheet: expected true or false"):
        templates_from([cloth | {"single_sheet": "no"}])
