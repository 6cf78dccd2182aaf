"""Items of which a part came off are put together as the category has them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from vflatten_ros.categories import load_templates
from vflatten_ros.core import placing
from vflatten_ros.core.config import Config
from vflatten_ros.core.placing import Group, place_groups, turned_over
from vflatten_ros.core.puzzle import Motion
from vflatten_ros.core.values import FlatPoints, Outline

STEP_M = 0.004
NO_ODDS = 7.0  # beyond the least cost: less likely than one in a thousand
CUT_M = 0.05  # of the second leg, below the crotch, that no view shows


def trousers():
    """Template and outline of trousers 0.40 m wide, not quite the typical cut."""
    template = next(t for t in load_templates() if t.category == "trousers")
    state = np.zeros(template.dimensions)
    state[0], state[1], state[2] = 0.3, -0.3, 0.4
    return template, state, template.outline(state)


def group(polygon, hidden, motion):
    """Both sides of a part of the item; its outline is inferred where `hidden` says so.

    Before the motion front and back lay upon each other, and so they hang.
    """
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    u, v = np.meshgrid(np.arange(low[0], high[0], STEP_M), np.arange(low[1], high[1], STEP_M))
    uv = np.column_stack([u.ravel(), v.ravel()])
    corners = polygon.astype(np.float32)
    inside = [cv2.pointPolygonTest(corners, (float(a), float(b)), False) > 0 for a, b in uv]
    uv = np.repeat(uv[np.array(inside)], 2, axis=0)
    side = np.tile([1.0, -1.0], len(uv) // 2)
    after = np.roll(polygon, -1, axis=0)
    share = np.linspace(0, 1, 60, endpoint=False)[:, None]
    edge = np.concatenate([a + share * (b - a) for a, b in zip(polygon, after, strict=True)])
    inferred = hidden(edge)

    def moved(points):
        z = motion(points @ np.array([1, 1j]))
        return np.column_stack([z.real, z.imag])

    n = len(uv)
    points = FlatPoints(
        uv=moved(uv),
        xyz_hanger=np.column_stack([uv, np.zeros(n)]),
        view_id=np.zeros(n, dtype=np.int64),
        pixel=np.zeros((n, 2), dtype=np.int64),
        sigma_m=np.full(n, 0.004),
        stress=np.zeros(n),
        inferred=np.zeros(n, dtype=bool),
    )
    ccw = slice(None, None, -1 if motion.mirrored else 1)
    outline = Outline(moved(edge)[ccw], np.full(len(edge), 0.004), inferred[ccw])
    return Group(points, -side if motion.mirrored else side, outline)


def parted(motion, hem_m=0.0):
    """The trousers without their left leg, and the leg below the cut, moved.

    Of the leg hem_m above its hem are not shown, either.
    """
    template, state, outline = trousers()
    names = list(template.points[: template.vertices])
    crotch = outline[names.index("crotch")]
    height = crotch[1] - CUT_M
    left = [outline[names.index(f"left_{name}")] for name in ("thigh", "hem_outer", "hem_inner")]
    thigh, hem_outer, hem_inner = left

    def at_height(a, b, v):
        return a + (b - a) * (v - a[1]) / (b[1] - a[1])

    outer = at_height(thigh, hem_outer, height)
    inner = at_height(crotch, hem_inner, height)
    at = names.index("left_hem_outer"), names.index("left_hem_inner")
    rest = np.array([outline[k] for k in range(len(names)) if k not in at])
    where = [n for n in names if n not in ("left_hem_outer", "left_hem_inner")]
    first = group(
        rest,
        lambda edge: (
            (
                np.abs(np.cross(edge - crotch, thigh - crotch) / np.linalg.norm(thigh - crotch))
                < 1e-6
            )
            & (edge[:, 0] < -1e-6)
        ),
        Motion(False, 1.0, 0.0),
    )
    assert "left_thigh" in where
    if hem_m:
        hem_outer, hem_inner = (
            at_height(a, b, hem_m) for a, b in ((thigh, hem_outer), (crotch, hem_inner))
        )
    leg = np.array([inner, outer, hem_outer, hem_inner])
    if np.cross(leg[1] - leg[0], leg[2] - leg[1]) < 0:
        leg = leg[::-1]
    cuts = [height, hem_m] if hem_m else [height]
    second = group(
        leg, lambda edge: np.any([np.abs(edge[:, 1] - v) < 0.01 for v in cuts], axis=0), motion
    )
    return template, state, first, second


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_second_leg_is_put_where_it_was(mirrored):
    motion = Motion(mirrored, np.exp(1.9j), 0.8 - 0.4j)
    template, state, first, second = parted(motion)
    placings = place_groups([first, second], load_templates(), Config())
    best = placings[0]
    assert best.template.category == "trousers"
    assert placings[1].cost > best.cost + 3.0
    # what the first group alone rules out need not be placed; what may win is
    placed = [len(p.motions) == 2 for p in placings]
    assert all(done for done, p in zip(placed, placings) if p.cost < best.cost + NO_ODDS)
    assert not all(placed)
    z = best.motions[1](second.points.uv @ np.array([1, 1j]))
    true = second.points.uv @ np.array([1, 1j])
    true = (true - motion.shift) / motion.turn
    true = true.conj() if mirrored else true
    # a leg laid flat is nearly alike from front and back: turned over, it leans the other way
    assert abs(z.mean() - true.mean()) < 0.04
    assert best.motions[0] == Motion(False, 1.0, 0.0)
    nothing = np.zeros((template.dimensions,) * 2)
    found, known = (
        t.measure(s, nothing) for t, s in ((best.template, best.state), (template, state))
    )
    for name in ("width", "length"):
        assert abs(found[name][0] / known[name][0] - 1) < 0.03


def test_a_part_of_a_leg_lies_about_as_far_down_as_it_hangs():
    """Neither hem nor crotch tells, and chords alone would let it lie anywhere farther down."""
    motion = Motion(False, np.exp(1.9j), 0.8 - 0.4j)
    *_, first, second = parted(motion, hem_m=0.25)
    best = place_groups([first, second], load_templates(), Config())[0]
    assert best.template.category == "trousers"
    z = best.motions[1](second.points.uv @ np.array([1, 1j]))
    hangs = second.points.xyz_hanger @ np.array([1, 1j, 0])
    assert abs(z.mean() - hangs.mean()) < 0.05


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_leg_may_lie_turned_over_unless_where_it_hangs_tells(monkeypatch, mirrored):
    *_, first, second = parted(Motion(mirrored, np.exp(1.9j), 0.8 - 0.4j))
    best = place_groups([first, second], load_templates(), Config())[0]
    assert turned_over(best, [first, second], Config()) == [None, None]  # it hangs as it lies
    narrow = [1.0 / 3.0, 1.0, 1.0]  # gathered: either seam hangs near everything
    groups = [
        replace(g, points=replace(g.points, xyz_hanger=g.points.xyz_hanger * narrow))
        for g in (first, second)
    ]
    best = place_groups(groups, load_templates(), Config())[0]
    monkeypatch.setattr(placing, "STEPS", 0.0 * placing.STEPS)  # no search: that is where it lies
    stays, other = turned_over(best, groups, Config())
    assert stays is None and other.mirrored != best.motions[1].mirrored
    here, there = (m(second.points.uv @ np.array([1, 1j])) for m in (best.motions[1], other))
    # in the same place, with the seams exchanged
    assert abs(here.mean() - there.mean()) < 0.03
    across = np.abs(here - there)
    assert across.max() > 0.08 and np.quantile(across, 0.05) < 0.02
    assert np.abs((here - there).imag).max() < 0.03  # as far down the leg


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("right", [False, True])
def test_a_corner_of_a_hem_is_put_where_it_hangs_from(right, mirrored):
    """The left one is like the right one turned over, but for where it hangs."""
    template = next(t for t in load_templates() if t.category == "t_shirt")
    outline = template.outline(np.zeros(template.dimensions))
    names = list(template.points[: template.vertices])
    armpits = [outline[names.index(f"{of}_armpit")] for of in ("left", "right")]
    left = armpits[0]
    side = np.abs(left[0])
    above, below = left[1] - 0.05, left[1] - 0.15
    shirt = [p for p in outline if p[1] > 0.01]
    at = next(k for k, p in enumerate(shirt) if (p == left).all())
    shirt[at + 1 : at + 1] = [np.array([u, above]) for u, _ in armpits]
    first = group(
        np.array(shirt),
        lambda edge: np.abs(edge[:, 1] - above) < 1e-6,
        Motion(False, 1.0, 0.0),
    )
    corner = np.array([[left[0], 0.0], [-0.02, 0.0], [-0.10, below], [left[0], below]])
    motion = Motion(mirrored, np.exp(1.9j), 0.8 - 0.4j)
    second = group(
        corner,
        lambda edge: (np.abs(edge[:, 0]) < side - 1e-6) & (edge[:, 1] > 1e-6),
        motion,
    )
    if right:
        hangs = second.points.xyz_hanger * [-1.0, 1.0, 1.0]
        second = replace(second, points=replace(second.points, xyz_hanger=hangs))
    best = place_groups([first, second], load_templates(), Config())[0]
    assert best.template.category == "t_shirt"
    z = best.motions[1](second.points.uv @ np.array([1, 1j]))
    hangs = second.points.xyz_hanger @ np.array([1, 1j, 0])
    assert np.abs(z - hangs).max() < 0.06 and np.median(np.abs(z - hangs)) < 0.02
    # and its front is not taken for its back, nor might it be
    assert best.motions[1].mirrored == (mirrored != right)
    assert turned_over(best, [first, second], Config()) == [None, None]


@pytest.mark.parametrize("leg_first", [False, True])
def test_what_is_not_placed_would_not_have_been_likely(monkeypatch, leg_first):
    """A leg alone may be many things, so the likeliest of it are placed, not only the first."""
    _, _, first, second = parted(Motion(False, np.exp(1.9j), 0.8 - 0.4j))
    groups = [second, first] if leg_first else [first, second]
    best = place_groups(groups, load_templates(), Config())[0]
    monkeypatch.setattr(placing, "WORTH_PLACING", np.inf)
    thorough = place_groups(groups, load_templates(), Config())[0]
    assert best.template.category == thorough.template.category == "trousers"
    assert best.cost == thorough.cost and best.motions == thorough.motions


def test_what_is_placed_comes_first_however_badly_it_fits_when_placed_again(monkeypatch):
    _, _, first, second = parted(Motion(False, np.exp(1.9j), 0.8 - 0.4j))
    fitted = placing._fitted
    turns = {}

    def worse_the_second_time(placed, *args):
        turns[placed.template.category] = turns.get(placed.template.category, 0) + 1
        again = fitted(placed, *args)
        late = turns[placed.template.category] > placing.WAYS
        return replace(again, energy=again.energy + 20.0 * late)

    monkeypatch.setattr(placing, "_fitted", worse_the_second_time)
    placings = place_groups([first, second], load_templates(), Config())
    assert max(turns.values()) > placing.WAYS
    placed = [bool(p.motions) for p in placings]
    assert placed == sorted(placed, reverse=True) and placed[0] and not placed[-1]
    least = min(p.cost for p in placings if p.motions)
    assert all(p.cost >= least + placing.WORTH_PLACING for p in placings if not p.motions)
