"""What a planner asks of the present item, without ROS."""

from __future__ import annotations

import dataclasses

import garments
import numpy as np
import pytest

from vflatten_ros import messages, session
from vflatten_ros.core.config import Config
from vflatten_ros.core.events import ItemStarted
from vflatten_ros.session import Refused, Session

PAIRS = garments.example_garment().correspondences


@pytest.fixture
def held():
    """A session that holds two views, as if clouds had given them."""
    item = Session(garments.CALIBRATION, Config())
    for view in garments.example_views():
        item.buffer._views[view.view_id] = view
        item.buffer._rates[view.view_id] = 0.0
    return item


def fields_of(pair):
    return messages.correspondence_fields(pair, 0)


def test_pairs_are_checked_one_by_one(held):
    wrong = fields_of(PAIRS[0]) | {"view_b": 77}
    off = fields_of(PAIRS[0]) | {"pixel_a": np.array([0, 0], np.int32)}
    answers = held.add_pairs([fields_of(PAIRS[0]), wrong, off, fields_of(PAIRS[1])])
    assert [number for number, _ in answers] == [1, 0, 0, 2]
    assert "view 77 is not in the buffer" in answers[1][1]
    assert "not on the item" in answers[2][1]
    assert held.add_pairs([fields_of(PAIRS[0])]) == [(0, "the same pair is already there")]


def test_a_pair_is_the_same_whichever_side_is_first_and_whoever_gave_it(held):
    pair = fields_of(PAIRS[0])
    turned = {
        f"{name}_{side}": pair[f"{name}_{other}"]
        for name in ("view", "given", "pixel", "point")
        for side, other in ("ab", "ba")
    }
    again = [pair | {"origin": messages.AUTOMATIC}, pair | {"confidence": 0.25}, pair | turned]
    answers = held.add_pairs([pair, *again])
    assert answers == [(1, ""), *[(0, "the same pair is already there")] * 3]
    assert held.add_pairs(again) == [(0, "the same pair is already there")] * 3


def test_pairs_go_with_their_views_and_numbers_are_not_used_twice(held):
    held.add_pairs(map(fields_of, PAIRS))
    assert held.clear_pairs([2, 9]) == (1, [9])
    removed, unknown, _ = held.clear_views([5, 4])
    assert (removed, unknown) == (1, [4])
    assert not held.pairs
    assert held.clear_pairs([]) == (0, [])


def test_a_selection_is_kept_until_its_views_go(held):
    assert held.selected() == (2, 5)
    assert held.select([5]) == (5,)
    with pytest.raises(Refused, match="view 3 is not in the buffer; views held: 2, 5") as error:
        held.select([3])
    assert error.value.code == session.UNKNOWN_VIEW
    assert held.selected() == (5,)
    held.clear_views([5])
    assert held.selected() == (2,)


def test_the_wrist_is_where_the_last_credible_joint_state_has_it(held):
    joint = held.calibration.joint
    for position in (0.5, float("nan"), float("inf"), 1e300):
        held.add_joint(0, (joint, "other"), (position, 1.0), 0)
    held.add_joint(0, ("other",), (2.0,), 0)
    assert held.wrist.position_rad == 0.5


def test_where_the_wrist_is_has_a_stamp_and_is_not_known_for_ever(held):
    with pytest.raises(Refused, match="no state of joint") as error:
        held.item_angle(0, 5.0)
    assert error.value.code == session.NO_JOINT_STATE
    came_ns = 1_000_000_000
    held.add_joint(7, (held.calibration.joint,), (0.5,), came_ns)  # stamps of another clock
    expected = held.calibration.item_angle_rad(0.5)
    assert held.item_angle(came_ns + 5 * 10**9, 5.0) == (expected, 7)
    held.add_joint(8, (held.calibration.joint,), (float("nan"),), came_ns + 5 * 10**9)
    with pytest.raises(Refused, match=r"came 6\.0 s ago, no_data_warning_s allows 5 s") as error:
        held.item_angle(came_ns + 6 * 10**9, 5.0)
    assert error.value.code == session.NO_JOINT_STATE


def test_pairs_are_bounded(held, monkeypatch):
    monkeypatch.setattr(session, "MAX_PAIRS", 1)
    assert held.add_pairs(map(fields_of, PAIRS[:2]))[1] == (
        0,
        "there are 1 pairs already; clear some",
    )


def test_a_new_item_has_no_pairs_and_no_selection(held):
    held.add_pairs(map(fields_of, PAIRS))
    held.select([2])
    events = held.new_item("requested")
    assert any(isinstance(event, ItemStarted) for event in events)
    assert not held.pairs
    assert held.selected() == ()


def turned(count, step_deg=15.0):
    """A session whose views cover a part of the turn."""
    item = Session(garments.CALIBRATION, Config())
    plain = garments.example_view(0, 0.0)
    for k in range(count):
        angle = np.radians(k * step_deg)
        item.buffer._views[k] = dataclasses.replace(plain, view_id=k, angle_rad=angle)
        item.buffer._rates[k] = 0.0
    return item


def test_early_looks_come_every_so_many_degrees_until_the_views_are_enough():
    item = turned(6)
    assert not item.due(0.0)  # not asked for
    assert item.due(45.0)
    item.looked()
    assert not item.due(45.0)
    for k, due in ((6, False), (7, False), (8, True)):
        item.buffer._views[k] = dataclasses.replace(
            item.buffer._views[0], view_id=k, angle_rad=np.radians(15.0 * k)
        )
        assert item.due(45.0) == due
    item.enough = True
    assert not item.due(45.0)
    item.new_item("requested")
    assert not item.enough and not item.due(45.0)


def test_too_few_views_are_not_looked_at():
    assert not turned(5, 40.0).due(45.0)


def test_a_task_holds_the_views_in_the_order_asked_for_and_their_pairs(held):
    held.add_pairs(map(fields_of, PAIRS))
    task = held.task(Config(), "kita2019", [5, 2])
    assert [view.view_id for view in task.views] == [5, 2]
    assert task.correspondences == PAIRS
    assert task.config.method == "kita2019"
    assert held.task(Config(), "kita2019", [2]).correspondences == ()


@pytest.mark.parametrize(
    "method, ids, code",
    [
        ("magic", [], session.UNKNOWN_NAME),
        ("", [4], session.UNKNOWN_VIEW),
        ("", [2] * (session.MAX_IDS + 1), session.INVALID_ARGUMENT),
    ],
)
def test_a_task_that_cannot_be_is_refused_with_its_code(held, method, ids, code):
    with pytest.raises(Refused) as error:
        held.task(Config(), method, ids)
    assert error.value.code == code


def test_one_view_is_too_few_for_a_rotation(held):
    with pytest.raises(Refused, match="needs two views or more, got 1; turn the item") as error:
        held.task(Config(), "rotation", [2])
    assert error.value.code == session.NO_VIEWS


def test_a_task_without_views_is_refused():
    with pytest.raises(Refused, match="no views") as error:
        Session(garments.CALIBRATION, Config()).task(Config())
    assert error.value.code == session.NO_VIEWS
