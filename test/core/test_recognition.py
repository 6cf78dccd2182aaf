"""Which category an outline is."""

from __future__ import annotations

import numpy as np

from vflatten_ros.categories import load_templates
from vflatten_ros.core.config import RecognitionConfig
from vflatten_ros.core.recognition import recognise
from vflatten_ros.core.values import FlatPoints, Outline

STEP_M = 0.004
TEMPLATES = load_templates()


def along(corners):
    """Evenly spaced points of a polygon."""
    after = np.roll(corners, -1, axis=0)
    length = np.linalg.norm(after - corners, axis=1)
    return np.vstack(
        [
            a + np.arange(0.0, 1.0, STEP_M / n)[:, None] * (b - a)
            for a, b, n in zip(corners, after, length, strict=True)
        ]
    )


def found(corners):
    line = along(np.array(corners))
    n = len(line)
    points = FlatPoints(
        uv=line,
        xyz_hanger=np.column_stack([line, np.zeros(n)]),
        view_id=np.zeros(n, dtype=np.int64),
        pixel=np.zeros((n, 2), dtype=np.int64),
        sigma_m=np.full(n, 0.004),
        stress=np.zeros(n),
        inferred=np.zeros(n, dtype=bool),
    )
    outline = Outline(line, np.full(n, 0.004), np.zeros(n, dtype=bool))
    return recognise(outline, points, TEMPLATES, RecognitionConfig())


def test_a_wide_notch_between_straight_legs_is_no_error_of_a_skirt():
    skirt = [[0, 0], [0.37, 0], [0.355, 0.38], [0.015, 0.38]]
    shorts = [
        [0, 0],
        [0.145, 0],
        [0.185, 0.14],
        [0.225, 0],
        [0.37, 0],
        [0.355, 0.38],
        [0.015, 0.38],
    ]
    assert found(skirt).category == "skirt"
    assert found(shorts).category == "shorts"
