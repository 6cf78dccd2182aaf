"""Every request gets an answer with its code; absurd ones change nothing."""

import numpy as np
import pytest
import slow_work
from geometry_msgs.msg import Point
from ros_rig import LATCHED, RECORDING, recorded
from sensor_msgs.msg import Image, JointState
from vflatten_ros.msg import Correspondence, GarmentEstimate, Status

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
    assert turned.ask("clear_correspondences", ids=[1]).status.code == Status.UNKNOWN_ID


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
    assert turned.ask("clear_views", ids=[0]).status.code == Status.UNKNOWN_ID
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
    few = turned.flatten(method="rotation", view_ids=[3]).result.status
    assert few.code == Status.NO_VIEWS and "got 1; turn the item" in few.message
    turned.ask("new_item")
    assert turned.flatten().result.status.code == Status.NO_VIEWS
    refused = "method 'magic'", "view 4294967295 is not", "method rotation", "the buffer holds no"
    for reason in refused:
        assert f"a goal was refused: {reason}" in turned.node.log()
    shown = turned.diagnostics()["flattening"]
    assert int(shown["refused"]) >= 6 and "no views" in shown["last refusal"]


def test_a_rotation_that_cannot_be_flattened_by_itself_is_told(rig):
    rig.set_parameter("auto_flatten", True)
    half_ns = recorded()[len(recorded()) // 2].log_ns
    rig.turn(keep=lambda message: message.log_ns < half_ns)
    rig.until(lambda: len(rig.ask("list_views").views) > 5, "half of the views")
    assert list(rig.ask("select_views", ids=[3]).selected) == [3]
    rig.turn(keep=lambda message: message.log_ns >= half_ns)
    reason = "not flattened by itself: method rotation needs two views or more, got 1"
    rig.until(lambda: reason in rig.node.log(), "the reason")
    assert "got 1" in rig.diagnostics()["flattening"]["last refusal"]


def test_absurd_angles_and_frames_of_landmarks_are_refused(turned):
    assert turned.flatten().result.status.code == Status.OK
    for angle in (np.nan, np.inf, 1e300):
        answer = turned.ask(
            "locate_landmark", name="left_top_corner", at_angle=True, item_angle=angle
        )
        assert answer.status.code == Status.INVALID_ARGUMENT
    assert turned.ask("locate_landmark").status.code == Status.UNKNOWN_NAME


MARK = "left_top_corner"


def later(seconds, **positions):
    """A joint state stamped so long after those of the recording."""
    stamp_ns = recorded()[-1].log_ns + int(seconds * 1e9)
    message = JointState(name=list(positions), position=list(positions.values()))
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    return message


def test_a_landmark_is_located_by_the_newest_joint_state_and_stamped_as_that(turned):
    turned.set_parameter("no_data_warning_s", 3600.0)
    none = turned.ask("locate_landmark", name=MARK).status
    assert none.code == Status.NO_RESULT
    assert f"nothing of item {turned.buffer().item} has been flattened yet" in none.message
    result = turned.flatten().result
    assert result.status.code == Status.OK
    newest = later(1.0, wrist_roll=0.25)
    turned.publish(newest)
    answer = turned.until(
        lambda: (
            (now := turned.ask("locate_landmark", name=MARK)).position.header.stamp
            == newest.header.stamp
            and now
        ),
        "the newest joint state",
    )
    assert answer.status.code == Status.OK
    assert answer.trusted == result.estimate.trusted
    given = turned.ask("locate_landmark", name=MARK, at_angle=True, item_angle=0.0)
    assert given.status.code == Status.OK
    stamp = given.position.header.stamp
    assert (stamp.sec, stamp.nanosec) == (0, 0)  # of no moment
    turned.set_parameter("no_data_warning_s", 5.0)


@pytest.mark.parametrize(
    ("nodes", "trusted"), [(slow_work.GOOD, True), (slow_work.UNTRUSTED, False)]
)
def test_a_landmark_is_trusted_as_the_result_is(turned, nodes, trusted):
    assert turned.set_parameter("geodesics.nodes", nodes).successful
    result = turned.flatten().result
    given = turned.ask("locate_landmark", name=MARK, at_angle=True, item_angle=0.0)
    assert given.status.code == Status.OK
    assert (result.estimate.trusted, given.trusted) == (trusted, trusted)


def test_a_landmark_is_not_located_by_a_joint_state_that_came_long_ago(turned):
    assert turned.flatten().result.status.code == Status.OK
    turned.set_parameter("no_data_warning_s", 0.5)
    old = turned.until(
        lambda: (now := turned.ask("locate_landmark", name=MARK).status).code != Status.OK and now,
        "a refusal",
    )
    assert old.code == Status.NO_JOINT_STATE
    assert "no_data_warning_s allows 0.5 s" in old.message
    given = turned.ask("locate_landmark", name=MARK, at_angle=True, item_angle=0.0)
    assert given.status.code == Status.OK
    turned.set_parameter("no_data_warning_s", 5.0)


def test_an_item_that_was_let_go_hangs_nowhere(turned):
    turned.set_parameter("no_data_warning_s", 3600.0)
    assert turned.flatten().result.status.code == Status.OK
    turned.publish(later(2.0, wrist_roll=0.25, finger_left=0.04, finger_right=0.04))
    gone = turned.until(
        lambda: (now := turned.ask("locate_landmark", name=MARK).status).code != Status.OK and now,
        "a refusal",
    )
    assert gone.code == Status.NOT_HELD and "the fingers are open" in gone.message
    given = turned.ask("locate_landmark", name=MARK, at_angle=True, item_angle=0.0)
    assert given.status.code == Status.NOT_HELD
    turned.publish(later(2.1, wrist_roll=0.25, finger_left=0.0, finger_right=0.0))
    turned.until(
        lambda: turned.ask("locate_landmark", name=MARK).status.code == Status.NO_RESULT,
        "the next item",
    )
    turned.set_parameter("no_data_warning_s", 5.0)


def heard(rig, kind, topic):
    """What comes on a topic of results from now on, what is there already among it."""
    messages = []
    rig.planner.create_subscription(kind, f"vflatten/{topic}", messages.append, LATCHED)
    return messages


def test_a_result_of_an_item_that_is_past_goes_to_its_caller_only(turned):
    published = heard(turned, GarmentEstimate, "garment")
    item = turned.buffer().item
    assert turned.flatten().result.item == item
    turned.until(lambda: any(message.item == item for message in published), "the result")
    turned.ask("new_item")
    turned.turn()
    turned.until(turned.complete, "the rotation")
    turned.set_parameter("geodesics.nodes", slow_work.SLOW)
    goal = turned.send_goal()
    turned.until(lambda: turned.ask("state").flattening, "the work to begin")
    turned.ask("new_item")
    result = turned.result_of(goal.get_result_async()).result
    assert result.status.code == Status.OK
    present = turned.buffer().item
    assert present == result.item + 1
    assert result.estimate.item == result.flattened.item == result.item
    turned.until(lambda: f"item {present} has begun" in turned.node.log(), "a line")
    turned.set_parameter("geodesics.nodes", slow_work.GOOD)
    turned.turn()
    turned.until(turned.complete, "the rotation")
    last = turned.flatten().result.item
    turned.until(lambda: published[-1].item == last, "the result")
    assert result.item not in {message.item for message in published}


def test_an_output_that_is_switched_on_again_comes_with_the_next_goal(turned):
    images = heard(turned, Image, "image")
    turned.until(lambda: turned.planner.count_publishers("vflatten/image"), "the topic")
    turned.set_parameter("outputs.image", False)
    estimates = heard(turned, GarmentEstimate, "garment")
    item = turned.flatten().result.item
    turned.until(lambda: estimates and estimates[-1].item == item, "the result")
    before = len(images)
    turned.set_parameter("outputs.image", True)
    assert turned.flatten().result.item == item  # of the same views: it is remembered
    turned.until(lambda: len(images) > before, "the image")


@pytest.mark.parametrize(
    "work, code, reason",
    [
        (slow_work.MISTAKE, Status.FAILED, "internal error, please report it:"),
        (slow_work.WRONG, Status.NO_VIEWS, "three views are needed"),
        (slow_work.CRASH, Status.FAILED, "the flattening process ended (exit code 7)"),
    ],
)
def test_a_goal_that_fails_leaves_a_line_and_its_reason_in_the_diagnostics(
    turned, work, code, reason
):
    failed = int(turned.diagnostics()["flattening"]["failed"])
    turned.set_parameter("geodesics.nodes", work)
    answer = turned.flatten().result
    assert answer.status.code == code and reason in answer.status.message
    assert f"item {answer.item} not flattened: {reason}" in turned.node.log()
    shown = turned.until(
        lambda: "the last one failed" in (now := turned.diagnostics()["flattening"])[""] and now,
        "the reason",
    )
    assert reason in shown[""]
    assert int(shown["failed"]) == failed + 1
