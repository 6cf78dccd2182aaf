"""Which category an outline is."""

from __future__ import annotations

import numpy as np
from flat import lying_at

from vflatten_ros.categories import load_templates
from vflatten_ros.core.config import RecognitionConfig
from vflatten_ros.core.recognition import fit_again, recognise
from vflatten_ros.core.values import Outline

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


def drawn(corners):
    """A seen outline, and points on it."""
    line = along(np.array(corners))
    n = len(line)
    outline = Outline(line, np.full(n, 0.004), np.zeros(n, dtype=bool))
    return outline, lying_at(line, 0.004)


def found(corners):
    return recognise(*drawn(corners), TEMPLATES, RecognitionConfig())


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


def test_a_fit_goes_on_from_where_it_was_when_its_notch_has_closed():
    """The waist, which is narrower in most shorts, is the wider end here."""
    shorts = [[0, 0], [0.14, 0], [0.17, 0.14], [0.2, 0], [0.34, 0], [0.36, 0.38], [-0.02, 0.38]]
    closed = [shorts[k] for k in (0, 4, 5, 6)]
    before = found(shorts).fits["shorts"]
    again = fit_again(before, *drawn(closed), RecognitionConfig())
    crotch, waist = (again.template.landmarks[name] for name in ("crotch", "waist_front"))
    up = again.points()[waist] - again.points()[crotch]
    assert up[1] > 0.1  # as it was; alone it would be fitted the other way round
    anew = recognise(*drawn(closed), TEMPLATES, RecognitionConfig()).fits["shorts"]
    assert (anew.points()[waist] - anew.points()[crotch])[1] < 0
