"""Every request gets an answer with its code; absurd ones change nothing."""

import numpy as np
import pytest
from geometry_msgs.msg import Point
from ros_rig import RECORDING
from vflatten_ros.msg import Correspondence, Status

CENTRE = [240, 180]


@pytest.fixture
def turned(rig):
    """The shared node with a complete rotation."""
    rig.turn()
    rig.until(rig.complete, "the rotation")
    return rig


def protocol_pairs():
    import json

    protocol = json.loads((RECORDING / "protocol.json").read_text())
    a, b = protocol["views"]
    return [
        Correspondence(view_a=a, view_b=b, pixel_a=pair["a"], pixel_b=pair["b"])
        for pair in protocol["pairs"]
    ]


def test_pairs_are_added_listed_and_cleared(turned):
    pairs = protocol_pairs()
    added = turned.ask("add_correspondences", pairs=pairs)
    assert added.status.code == Status.OK
    assert list(added.accepted) == [True] * len(pairs)
    listed = turned.ask("list_correspondences").pairs
    assert [pair.id for pair in listed] == list(added.ids)
    assert turned.buffer().correspondences == len(pairs)
    again = Correspondence(view_a=listed[0].view_a, view_b=listed[0].view_b)
    again.given_a = again.given_b = Correspondence.POINT
    again.point_a, again.point_b = listed[0].point_a, listed[0].point_b
    answer = turned.ask("add_correspondences", pairs=[again])
    assert answer.reasons == ["the same pair is already there"]
    cleared = turned.ask("clear_correspondences", ids=[added.ids[0], 4_000_000_000])
    assert (cleared.status.code, cleared.removed) == (Status.PARTLY, 1)
    assert turned.ask("clear_correspondences").removed == len(pairs) - 1
    assert turned.ask("clear_correspondences", ids=[1]).status.code == Status.INVALID_ARGUMENT


def absurd_pairs():
    nan, far = Point(x=np.nan, y=np.inf, z=0.0), Point(x=1e300, y=-1e300, z=1e300)
    point = {"given_a": 1, "given_b": 1}
    yield {"view_a": 4_294_967_295, "view_b": 0}
    yield {"view_a": 3, "view_b": 3, "pixel_a": CENTRE, "pixel_b": CENTRE}
    yield {"view_a": 3, "view_b": 4, "pixel_a": [-(2**31), 2**31 - 1], "pixel_b": CENTRE}
    yield {"view_a": 3, "view_b": 4, "pixel_a": [0, 0], "pixel_b": CENTRE}
    yield {"view_a": 3, "view_b": 4, "point_a": nan, "point_b": nan} | point
    yield {"view_a": 3, "view_b": 4, "point_a": far, "point_b": far} | point
    yield {"view_a": 3, "view_b": 4, "given_a": 255, "given_b": 7}
    yield {"view_a": 3, "view_b": 4, "confidence": float("nan")}
    yield {"view_a": 3, "view_b": 4, "confidence": -1e30}


def test_absurd_pairs_are_refused_one_by_one_with_a_reason(turned):
    pairs = [Correspondence(**fields) for fields in absurd_pairs()]
    answer = turned.ask("add_correspondences", pairs=[*pairs, protocol_pairs()[0]])
    assert answer.status.code == Status.PARTLY
    assert list(answer.accepted) == [False] * len(pairs) + [True]
    assert all(reason for reason in list(answer.reasons)[:-1])
    assert not any(list(answer.ids)[:-1])
    none = turned.ask("add_correspondences", pairs=pairs)
    assert none.status.code == Status.INVALID_ARGUMENT
    assert turned.ask("add_correspondences").status.code == Status.INVALID_ARGUMENT


def test_views_are_listed_selected_and_cleared(turned):
    views = turned.ask("list_views").views
    assert [view.id for view in views] == list(range(24))
    assert all(view.selected and view.points > 1000 for view in views)
    turns = np.diff([view.item_angle for view in views])
    assert np.abs(np.abs(turns) - np.radians(15)).max() < np.radians(0.5)
    assert list(turned.ask("select_views", ids=[5, 3]).selected) == [5, 3]
    assert list(turned.flatten().result.flattened.view_ids) == [5, 3]
    unknown = turned.ask("select_views", ids=[5, 99])
    assert unknown.status.code == Status.UNKNOWN_VIEW and "99" in unknown.status.message
    assert len(turned.ask("select_views").selected) == 24
    cleared = turned.ask("clear_views", ids=[0, 1, 2**32 - 1])
    assert (cleared.status.code, cleared.removed) == (Status.PARTLY, 2)
    assert turned.drops() == {"cleared": 2}
    assert turned.ask("clear_views", ids=[0]).status.code == Status.UNKNOWN_VIEW
    item = turned.buffer().item
    assert turned.ask("clear_views").removed == 22
    assert turned.buffer().item == item + 1


def test_absurd_goals_end_with_their_code(turned):
    for goal, code in (
        ({"method": "magic"}, Status.UNKNOWN_NAME),
        ({"method": "x" * 100_000}, Status.UNKNOWN_NAME),
        ({"view_ids": [2**32 - 1]}, Status.UNKNOWN_VIEW),
        ({"view_ids": [1] * 200_000}, Status.INVALID_ARGUMENT),
    ):
        answer = turned.flatten(**goal)
        assert answer.result.status.code == code
        assert answer.status == 6  # action_msgs/GoalStatus.STATUS_ABORTED
        assert len(answer.result.status.message) < 300
    turned.ask("new_item")
    assert turned.flatten().result.status.code == Status.NO_VIEWS


def test_absurd_angles_and_frames_of_landmarks_are_refused(turned):
    assert turned.flatten().result.status.code == Status.OK
    for angle in (np.nan, np.inf, 1e300):
        answer = turned.ask(
            "locate_landmark", name="left_top_corner", at_angle=True, item_angle=angle
        )
        assert answer.status.code == Status.INVALID_ARGUMENT
    assert turned.ask("locate_landmark").status.code == Status.UNKNOWN_NAME
