"""An item that lies askew is turned upright with everything that is drawn on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from garments import example_garment

from vflatten_ros.core.upright import upright

POSE = np.array([2.3, 0.4, -0.7])


def askew(uv):
    """As the category has it -> as a category fitted with POSE lies."""
    turn = np.array([[np.cos(2.3), -np.sin(2.3)], [np.sin(2.3), np.cos(2.3)]])
    return np.asarray(uv) @ turn.T + POSE[1:]


def places(garment):
    """Every place in the flat frame."""
    return {
        "points": garment.points.uv,
        "start": garment.start_uv,
        "outline": garment.outline.uv,
        "template": garment.template_uv,
        "sizes": np.array([m.ends_uv for m in garment.measurements if m.ends_uv]),
        "landmarks": np.array([mark.uv for mark in garment.landmarks]),
    }


def lying_askew():
    garment = example_garment()
    return replace(
        garment,
        points=replace(garment.points, uv=askew(garment.points.uv)),
        start_uv=askew(garment.start_uv),
        outline=replace(garment.outline, uv=askew(garment.outline.uv)),
        template_uv=askew(garment.template_uv),
        measurements=tuple(
            replace(m, ends_uv=tuple(map(tuple, askew(m.ends_uv)))) for m in garment.measurements
        ),
        landmarks=tuple(replace(m, uv=tuple(askew(m.uv))) for m in garment.landmarks),
    )


def test_all_places_are_turned_back():
    found, true = places(upright(lying_askew(), POSE)), places(example_garment())
    for name, uv in true.items():
        assert found[name] == pytest.approx(uv, abs=1e-9), name


def test_what_is_not_there_stays_so():
    garment = lying_askew()
    sizes = tuple(replace(m, ends_uv=None) for m in garment.measurements)
    found = upright(replace(garment, start_uv=None, measurements=sizes), POSE)
    assert found.start_uv is None
    assert all(m.ends_uv is None for m in found.measurements)
