"""Whether what faces opposite ways is one cloth."""

from __future__ import annotations

import numpy as np
import pytest
from flat import lying_at

from vflatten_ros.categories import load_templates
from vflatten_ros.core.config import RecognitionConfig, RotationConfig
from vflatten_ros.core.faces import MOST, ONE_CLOTH, evenly_apart
from vflatten_ros.core.recognition import MOST_OF_ONE_CLOTH, of_one_cloth, recognise
from vflatten_ros.core.values import Outline
from vflatten_ros.core.ways import _chance

CONFIG = RotationConfig()
WIDE_M, LONG_M, WAVE_M = 0.3, 0.5, 0.02


def hanging(thick_m, gap_m=0.0, noise_m=0.0003, share=1.0):
    """Both faces of waving cloth, of two layers if there is a gap, which opens downwards."""
    rng = np.random.default_rng(5)
    xyz, normal = [], []
    for out in (1.0, -1.0):
        step = CONFIG.spacing_m
        u, v = np.mgrid[0:WIDE_M:step, 0 : LONG_M * (1.0 if out > 0 else share) : step]
        u, v = (x.ravel() + rng.normal(0.0, 0.1 * step, x.size) for x in (u, v))
        wave, slope = WAVE_M * np.sin(u / 0.05), WAVE_M / 0.05 * np.cos(u / 0.05)
        outward = np.column_stack([-slope, np.zeros_like(u), np.ones_like(u)])
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        off = thick_m / 2 + gap_m * v / LONG_M / 2 + out * rng.normal(0.0, noise_m, len(u))
        xyz.append(np.column_stack([u, v, wave]) + out * off[:, None] * outward)
        normal.append(out * outward)
    return np.vstack(xyz), np.vstack(normal), CONFIG


@pytest.mark.parametrize("thick_m", [0.0, 0.001, 0.004])
def test_the_faces_of_one_cloth_are_as_far_apart_as_it_is_thick(thick_m):
    assert len(hanging(thick_m)[0]) > 3 * MOST  # not all are asked
    assert evenly_apart(*hanging(thick_m)) > 0.95


def test_what_hangs_behind_the_other_face_does_not_count():
    xyz, normal, config = hanging(0.001)
    behind = xyz - [0.0, 0.0, 0.012]
    assert evenly_apart(np.vstack([xyz, behind]), np.vstack([normal, normal]), config) > 0.95


def test_two_layers_are_not_though_they_touch_for_a_third_of_their_length():
    assert 0.1 < evenly_apart(*hanging(0.001, gap_m=0.012)) < 0.6
    assert evenly_apart(*hanging(0.001, gap_m=0.03)) < ONE_CLOTH


def test_errors_only_make_one_cloth_seem_more():
    shares = [evenly_apart(*hanging(0.001, noise_m=m)) for m in (0.0005, 0.001, 0.002)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.9 and shares[-1] < ONE_CLOTH


def test_of_what_was_hardly_seen_from_both_sides_nothing_is_said():
    assert evenly_apart(*hanging(0.001, share=0.4)) > 0.95
    assert evenly_apart(*hanging(0.001, share=0.05)) == 0.0
    xyz, normal, config = hanging(0.001)
    assert evenly_apart(xyz[:100], normal[:100], config) == 0.0
    assert evenly_apart(xyz[:1], normal[:1], config) == 0.0


def test_one_cloth_that_lies_askew_is_a_towel_and_no_skirt():
    """As narrow at one end as a skirt: by its outline alone it is one."""
    corners = np.array([[0, 0], [0.44, 0], [0.425, 0.62], [0.015, 0.62]])
    share = np.arange(0.0, 1.0, 0.01)[:, None]
    ends = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    line = np.vstack([a + share * (b - a) for a, b in ends])
    outline = Outline(line, np.full(len(line), 0.004), np.zeros(len(line), dtype=bool))
    templates, points = load_templates(), lying_at(line, 0.004)

    def found(even):
        return recognise(outline, points, templates, RecognitionConfig(), even=even)

    assert found(0.0).category == "skirt" and found(0.0).probabilities["skirt"] > 0.9
    assert found(0.0).probabilities == pytest.approx(found(ONE_CLOTH).probabilities)
    assert found(0.95).category == "towel" and found(0.95).probabilities["towel"] > 0.9
    assert found(0.95).one_cloth and not found(0.0).one_cloth


def test_one_cloth_costs_a_garment_odds_but_is_no_proof():
    known = {template.category: template for template in load_templates()}
    towel, shorts = known["towel"], known["shorts"]
    assert of_one_cloth(towel, 1.0) == of_one_cloth(shorts, ONE_CLOTH) == 0.0
    assert 0.0 < of_one_cloth(shorts, ONE_CLOTH + 0.03) < of_one_cloth(shorts, 1.0)
    assert of_one_cloth(shorts, 0.95) == of_one_cloth(shorts, 1.0) == MOST_OF_ONE_CLOTH


def test_of_one_cloth_only_clear_signs_of_a_slit_count():
    templates = load_templates()
    assert _chance(0.9, templates, 0.5) == pytest.approx(0.9)
    assert _chance(0.9, templates, 1.0) == pytest.approx(9.0 / (9.0 + np.exp(MOST_OF_ONE_CLOTH)))
    assert _chance(0.9999, templates, 1.0) > 0.5
    assert [_chance(p, templates, 1.0) for p in (0.0, 1.0)] == [0.0, 1.0]
