"""Two views of a bent sheet of which each hides a part: laid flat together, they give it whole."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import sheet
from sheet import ANGLES_RAD, HEIGHT_M, WIDTH_M, seen_from

from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import InvalidCorrespondence, NotEnoughViews
from vflatten_ros.core.two_views import creases, flatten_two_views
from vflatten_ros.core.values import Correspondence

VIEWS, FLAT = zip(*(seen_from(k, angle) for k, angle in enumerate(ANGLES_RAD)), strict=True)


def pair_at(u: float, v: float, slip_m: float = 0.0) -> Correspondence:
    return sheet.pair_at(VIEWS, FLAT, u, v, slip_m)


PAIRS = [pair_at(u, v) for u, v in ((0.0, -0.03), (0.02, -0.2), (-0.02, -0.12))]


def test_neither_view_shows_the_whole_sheet():
    for flat in FLAT:
        assert np.ptp(flat[:, 0]) < 0.93 * WIDTH_M


def test_two_views_give_the_rectangle():
    done = flatten_two_views(VIEWS, PAIRS, Config())
    assert np.ptp(done.outline.uv, axis=0) == pytest.approx([WIDTH_M, HEIGHT_M], abs=0.006)
    assert set(done.points.view_id.tolist()) == {0, 1}
    assert done.correspondences == tuple(PAIRS)


@pytest.mark.parametrize("solver", ["majorization", "springs"])
def test_so_does_the_paper_s_evidence_with_points_on_the_boundary_but_less_well(solver):
    """At the silhouette some lines leave what is observed; they must not count as distances."""
    config = Config()
    config = dataclasses.replace(
        config,
        integration=dataclasses.replace(config.integration, evidence="boundary"),
        flattening=dataclasses.replace(config.flattening, solver=solver),
    )
    edge = [pair_at(u, v) for v in (-0.002, -0.248) for u in (-0.04, 0.0, 0.04)]
    done = flatten_two_views(VIEWS, edge, config)
    spacing = config.boundary.spacing_m
    assert np.ptp(done.outline.uv, axis=0) == pytest.approx([WIDTH_M, HEIGHT_M], abs=spacing)


def test_every_point_comes_to_lie_at_its_place():
    done = flatten_two_views(VIEWS, PAIRS, Config())
    true = {
        (view.view_id, *pixel): uv
        for view, flat in zip(VIEWS, FLAT, strict=True)
        for pixel, uv in zip(view.pixel.tolist(), flat, strict=True)
    }
    keys = zip(done.points.view_id.tolist(), done.points.pixel.tolist(), strict=True)
    goal = np.array([true[(view, *pixel)] for view, pixel in keys])
    a, b = done.points.uv - done.points.uv.mean(0), goal - goal.mean(0)
    left, _, right = np.linalg.svd(a.T @ b)
    off = np.linalg.norm(a @ left @ right - b, axis=1)
    assert np.median(off) < 0.001 and off.max() < 0.004
    assert done.notices == ()


def test_the_order_of_the_views_makes_no_difference():
    swapped = [Correspondence(1, 0, p.pixel_b, p.pixel_a) for p in PAIRS]
    one = flatten_two_views(VIEWS, PAIRS, Config())
    other = flatten_two_views(VIEWS, swapped, Config())
    np.testing.assert_array_equal(one.points.uv, other.points.uv)


def test_a_pair_that_contradicts_the_others_is_left_out_and_named():
    wrong = pair_at(0.0, -0.15, slip_m=0.05)
    done = flatten_two_views(VIEWS, [*PAIRS, wrong], Config())
    assert done.correspondences == tuple(PAIRS)
    assert [notice.code for notice in done.notices] == ["correspondence_rejected"]
    assert str(wrong.pixel_a) in done.notices[0].text


def test_what_cannot_be_joined_is_refused():
    config = Config()
    with pytest.raises(InvalidCorrespondence, match="two corresponding points or more"):
        flatten_two_views(VIEWS, PAIRS[:1], config)
    with pytest.raises(NotEnoughViews, match="needs two views, got 1"):
        flatten_two_views(VIEWS[:1], PAIRS, config)
    elsewhere = [dataclasses.replace(pair, view_b=7) for pair in PAIRS]
    with pytest.raises(NotEnoughViews, match="name view 7; there are views 0, 1"):
        flatten_two_views(VIEWS, elsewhere, config)


@pytest.mark.parametrize(
    ("loose", "codes"),
    [(2, []), (30, ["hidden_crease"]), (60, ["hidden_crease", "untrusted"])],
)
def test_cloth_behind_creases_is_told_and_most_of_it_is_not_trusted(loose, codes):
    joint = SimpleNamespace(piece=np.zeros(100))
    main = SimpleNamespace(points=SimpleNamespace(uv=np.zeros((100 - loose, 2))))
    assert [notice.code for notice in creases(joint, (main,))] == codes
