"""Gaps in a flat item, into which its outline goes if it is known there."""

from __future__ import annotations

import numpy as np
import pytest
from flat import lying_at

from vflatten_ros.core.config import RecognitionConfig
from vflatten_ros.core.evidence import evidence_from
from vflatten_ros.core.values import Outline

SIDE_M, STEP_M, DEEP_M = 0.3, 0.005, 0.2


@pytest.mark.parametrize("hidden", [False, True])
def test_a_gap_that_opens_where_the_outline_is_inferred_is_hidden_cloth(hidden):
    u, v = np.meshgrid(np.arange(0, SIDE_M, STEP_M), np.arange(0, SIDE_M, STEP_M))
    uv = np.column_stack([u.ravel(), v.ravel()])
    gap = (uv[:, 0] < DEEP_M) & (np.abs(uv[:, 1] - SIDE_M / 2) < 0.02)
    points = lying_at(uv[~gap])
    points.xyz_hanger[:, :2] = points.uv
    corners = np.array([[0, 0], [SIDE_M, 0], [SIDE_M, SIDE_M], [0, SIDE_M]])
    share = np.arange(0.0, 1.0, 0.01)[:, None]
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    line = np.vstack([a + share * (b - a) for a, b in sides])
    mouth = (line[:, 0] < 0.001) & (np.abs(line[:, 1] - SIDE_M / 2) < 0.03)
    outline = Outline(line, np.full(len(line), 0.004), mouth & hidden)
    seen = evidence_from(outline, points, RecognitionConfig())
    deep = np.minimum(seen.outline, SIDE_M - seen.outline).min(axis=1)
    assert (deep.max() < 0.01) if hidden else (deep.max() > 0.1)
    # what stays of the outline is where it was
    assert seen.weight[deep < 0.01].astype(bool).mean() == pytest.approx(
        0.95 if hidden else 1, abs=0.06
    )


@pytest.mark.parametrize("another_gap", [False, True])
def test_a_slit_of_the_outline_stays_whatever_other_gaps_there_are(another_gap):
    u, v = np.meshgrid(np.arange(0, SIDE_M, STEP_M), np.arange(0, SIDE_M, STEP_M))
    uv = np.column_stack([u.ravel(), v.ravel()])
    gap = (uv[:, 0] < DEEP_M / 2) & (np.abs(uv[:, 1] - 0.7 * SIDE_M) < 0.02)
    points = lying_at(uv[~(gap & another_gap)])
    at = SIDE_M / 2
    corners = [[0, 0], [at - 0.001, 0], [at - 0.001, 0.12], [at + 0.001, 0.12], [at + 0.001, 0]]
    corners = np.array([*corners, [SIDE_M, 0], [SIDE_M, SIDE_M], [0, SIDE_M]])
    share = np.arange(0.0, 1.0, 0.02)[:, None]
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    line = np.vstack([a + share * (b - a) for a, b in sides])
    outline = Outline(line, np.full(len(line), 0.004), np.zeros(len(line), dtype=bool))
    seen = evidence_from(outline, points, RecognitionConfig()).outline
    assert np.linalg.norm(seen - [at, 0.1], axis=1).min() < 0.015
    into_gap = (np.abs(seen[:, 1] - 0.7 * SIDE_M) < 0.03) & (np.abs(seen[:, 0] - 0.08) < 0.02)
    assert into_gap.any() == another_gap
