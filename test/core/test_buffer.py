"""The view buffer: every cloud is accounted for, whatever comes, in whatever order."""

import dataclasses

import numpy as np
import pytest

from vflatten_ros.core.buffer import (
    DROP_REASONS,
    ClockJumped,
    CloudDropped,
    ItemStarted,
    RotationComplete,
    Stage,
    ViewAdded,
    ViewBuffer,
    ViewReplaced,
    WristStill,
)
from vflatten_ros.core.config import config_from
from vflatten_ros.core.values import Calibration, Cloud

TURN = 2 * np.pi
S = 1_000_000_000
RATE = 0.5  # rad/s of the wrist
CALIBRATION = Calibration(
    "rig", (0.0, -0.4, 1.3), (0.0, -1.0, 0.0), (0.0, -0.4, 1.3), "wrist", -1.0, 0.3
)


def cloud(stamp_ns, *, rows=40, frame="rig", shift=0.0):
    """A strip of cloth below the tip, 4 mm between points."""
    row, col = np.mgrid[:rows, :20]
    xyz = np.stack(
        [0.004 * (col - 10) + shift, 0.004 * row - 0.39, np.full(row.shape, 1.3)], axis=2
    )
    return Cloud(stamp_ns, frame, xyz.astype(np.float32), None)


def joints(buffer, start_s, end_s, *, rate=RATE, received=0, names=("wrist",), extra=()):
    """50 Hz of a wrapped joint that turns at a constant rate."""
    events = []
    for k in range(round(start_s * 50), round(end_s * 50)):
        stamp = k * S // 50
        position = (rate * stamp / S) % TURN
        events += buffer.add_joint(stamp, names, (position, *extra), received)
    return events


def make(**options):
    return ViewBuffer(CALIBRATION, config_from(options))


def dropped(events):
    return [event.reason for event in events if isinstance(event, CloudDropped)]


def check_accounts(buffer):
    state = buffer.state()
    total = len(state.view_ids) + state.clouds_waiting + sum(state.drops.values())
    assert state.clouds_received == total, state
    assert set(state.drops) <= set(DROP_REASONS)
    return state


def test_a_cloud_between_joint_states_becomes_a_view_at_its_angle():
    buffer = make()
    joints(buffer, 0, 1)
    (added,) = buffer.add_cloud(cloud(int(0.503 * S)), 0)
    (view,) = buffer.views()
    assert added == ViewAdded(0, view.angle_rad, len(view.points_rig))
    assert view.angle_rad == pytest.approx(-(RATE * 0.503 - 0.3), abs=1e-9)  # sign and zero
    assert check_accounts(buffer).stage is Stage.GATHERING


def test_a_cloud_waits_for_its_joint_states_and_then_gives_the_same_view():
    early, late = make(), make()
    joints(late, 0, 1)
    late.add_cloud(cloud(int(0.503 * S)), 0)
    joints(early, 0, 0.5)
    assert early.add_cloud(cloud(int(0.503 * S)), 0) == ()
    assert check_accounts(early).clouds_waiting == 1
    assert [type(e) for e in joints(early, 0.5, 1)] == [ViewAdded]
    assert early.views()[0].angle_rad == late.views()[0].angle_rad  # to the last bit


@pytest.mark.parametrize("delay", [0, 1, 7, 40])
def test_views_do_not_depend_on_how_clouds_and_joint_states_interleave(delay):
    """Joint states lead or lag the clouds by some messages; the views are the same bits."""
    messages = [(k * S // 50, "joint") for k in range(700)]
    clouds = [(k * S // 2 + 7_000_000, "cloud") for k in range(1, 25)]
    views = []
    for late in (0, delay):
        key = lambda m, late=late: (m[0] + (late * S // 50 if m[1] == "joint" else 0), m[1])  # noqa: E731
        buffer = make()
        for stamp, kind in sorted(messages + clouds, key=key):
            if kind == "cloud":
                buffer.add_cloud(cloud(stamp), stamp)
            else:
                buffer.add_joint(stamp, ("wrist",), ((RATE * stamp / S) % TURN,), stamp)
        buffer.finish()
        assert check_accounts(buffer).drops == {}
        views.append(
            [(v.view_id, v.stamp_ns, v.angle_rad, v.points_rig.tobytes()) for v in buffer.views()]
        )
    assert len(views[0]) == 24
    assert views[0] == views[1]


def test_the_first_view_lies_within_half_a_turn_and_later_ones_are_unwrapped():
    buffer = make()
    joints(buffer, 0, 20)  # 10 rad
    for k in range(1, 10):
        buffer.add_cloud(cloud(2 * k * S), 0)
    angles = np.array([view.angle_rad for view in buffer.views()])
    assert abs(angles[0]) <= np.pi
    np.testing.assert_allclose(np.diff(angles), -2 * RATE, atol=1e-9)


def test_angles_have_the_same_bits_whenever_the_joint_states_began():
    angles = []
    for start_s in (0, 25):  # two turns earlier or not
        buffer = make(**{"joints.history_s": 100.0})
        joints(buffer, start_s, 40)
        for k in range(10):
            buffer.add_cloud(cloud(26 * S + k * S), 0)
        angles.append([view.angle_rad for view in buffer.views()])
    assert abs(angles[0][0]) <= np.pi
    assert angles[0] == angles[1]


def test_every_reason_to_drop_is_counted():
    buffer = make(**{"buffer.max_rate_rad_s": 1.0})
    joints(buffer, 10, 12)
    assert dropped(buffer.add_cloud(cloud(11 * S, frame="other"), 0)) == ["wrong_frame"]
    assert dropped(buffer.add_cloud(cloud(11 * S, rows=0), 0)) == ["empty_after_segmentation"]
    assert dropped(buffer.reject_cloud("lies", 0)) == ["invalid_cloud"]
    assert dropped(buffer.add_cloud(cloud(5 * S), 0)) == ["too_old"]
    assert dropped(buffer.add_cloud(cloud(11 * S), 0)) == []
    assert dropped(buffer.add_cloud(cloud(int(10.9 * S)), 0)) == ["time_went_backwards"]
    assert dropped(buffer.add_cloud(cloud(11 * S), 0)) == ["time_went_backwards"]
    joints(buffer, 12, 13, rate=3.0)
    assert dropped(buffer.add_cloud(cloud(int(12.9 * S)), 0)) == ["wrist_moving_too_fast"]
    assert dropped(buffer.clear_views([4, 99])) == ["cleared"]
    state = check_accounts(buffer)
    assert (state.clouds_received, state.view_ids) == (8, ())


def test_a_cloud_without_joint_states_is_dropped_once_it_has_waited():
    buffer = make(**{"joints.wait_s": 1.0})
    buffer.add_joint(0, ("finger",), (0.0,), 0)
    assert buffer.add_cloud(cloud(S), 0) == ()
    assert buffer.tick(int(0.9 * S)) == ()
    (event,) = buffer.tick(S)
    assert event.reason == "no_joint_state"
    assert "'wrist'" in event.text and "finger" in event.text  # what is wanted and what there is
    check_accounts(buffer)


def test_a_cloud_just_after_the_last_joint_state_is_used_at_the_end():
    buffer = make()
    joints(buffer, 0, 1)  # the last at 0.98 s
    buffer.add_cloud(cloud(int(0.99 * S)), 0)
    buffer.add_cloud(cloud(2 * S), 0)
    events = buffer.finish()
    assert [type(e) for e in events] == [ViewAdded, CloudDropped]
    assert dropped(events) == ["too_old"]
    assert check_accounts(buffer).clouds_waiting == 0


def test_joint_states_that_stop_and_resume_leave_a_gap_only():
    buffer = make()
    joints(buffer, 0, 1)
    joints(buffer, 5, 6)
    for stamp_s, reasons in ((0.5, []), (3.0, ["too_old"]), (5.5, [])):
        assert dropped(buffer.add_cloud(cloud(int(stamp_s * S)), 0)) == reasons
    state = check_accounts(buffer)
    assert (state.clock_jumps, state.view_ids) == (0, (0, 2))


def turn_round(buffer, views, start_s=0.0, period_s=0.5, skip=()):
    """Stop-and-go: a view every period at even angles."""
    events = []
    for k in range(views * 25 + 1):
        stamp = int(start_s * S) + k * int(period_s * S) // 25
        angle = TURN * (k // 25) / views
        events += buffer.add_joint(stamp, ("wrist",), (angle % TURN,), stamp)
        if k % 25 == 10 and k // 25 not in skip:
            events += buffer.add_cloud(cloud(stamp), stamp)
    return events


@pytest.mark.parametrize("views", [8, 12, 24, 36])
def test_a_rotation_is_complete_with_its_last_view(views):
    buffer = make()
    events = turn_round(buffer, views)
    complete = [e for e in events if isinstance(e, RotationComplete)]
    assert complete == [RotationComplete(views, pytest.approx(TURN))]
    assert buffer.state().stage is Stage.COMPLETE
    assert isinstance(events[-1], RotationComplete)  # not before the last


def test_a_rotation_with_a_dropped_cloud_is_complete_and_a_half_is_not():
    dropped_one, half = make(), make()
    assert any(isinstance(e, RotationComplete) for e in turn_round(dropped_one, 24, skip={7}))
    events = turn_round(half, 24, skip=set(range(12, 24)))
    assert not any(isinstance(e, RotationComplete) for e in events)
    # 12 views 15 degrees apart, and half of the largest gap that counts at either end
    assert half.state().angle_covered_rad == pytest.approx(np.radians(11 * 15 + 45))


def test_a_rotation_whose_views_are_cleared_is_complete_no_longer_and_may_be_again():
    buffer = make()
    turn_round(buffer, 12)
    buffer.clear_views([3])  # its neighbours are 60 degrees apart
    assert buffer.state().stage is Stage.GATHERING
    buffer.clear_views(range(12))
    assert buffer.state().stage is Stage.WAITING
    events = turn_round(buffer, 12, start_s=6.5)
    assert len([e for e in events if isinstance(e, RotationComplete)]) == 1
    assert check_accounts(buffer).stage is Stage.COMPLETE


def test_a_complete_rotation_that_stays_so_when_a_view_is_cleared_is_told_once():
    buffer = make()
    turn_round(buffer, 36)
    buffer.clear_views([3])
    assert buffer.state().stage is Stage.COMPLETE
    assert not any(isinstance(e, RotationComplete) for e in turn_round(buffer, 36, start_s=18.5))


def test_a_wrist_that_does_not_turn_is_told_once_for_an_item_with_what_came():
    buffer = make(**{"joints.history_s": 100.0})
    for start in (0, 15 * S):
        joints(buffer, start / S, start / S + 14, rate=0.0)
        told = []
        for k in range(1, 25):
            events = buffer.add_cloud(cloud(start + k * S // 2), 0)
            told += [e for e in events if isinstance(e, WristStill)]
        assert told == [WristStill(0.0, 11)]  # ten steps are five seconds
        assert buffer.state().still == WristStill(0.0, 24)
        buffer.new_item()
        assert buffer.state().still is None


def test_a_wrist_that_waits_a_little_or_turns_slowly_is_not_said_to_be_still():
    waiting, slow = make(), make()
    joints(waiting, 0, 5, rate=0.0)
    joints(slow, 0, 14, rate=0.02)
    for k in range(8):
        waiting.add_cloud(cloud(S + k * S // 2), 0)
    for k in range(24):
        slow.add_cloud(cloud(S + k * S // 2), 0)
    assert waiting.state().still is slow.state().still is None


def test_what_became_of_the_last_clouds_is_known():
    buffer = make()
    joints(buffer, 0, 14, rate=0.0)
    buffer.add_cloud(cloud(1 * S), 0)
    buffer.add_cloud(cloud(2 * S, shift=0.05), 0)
    buffer.add_cloud(cloud(3 * S, shift=0.05, rows=30), 0)
    buffer.clear_views([1])
    assert buffer.state().recent == ("", "item_swinging", "duplicate_angle")
    for _ in range(30):
        buffer.reject_cloud("lies", 0)
    assert buffer.state().recent == ("invalid_cloud",) * 20


@pytest.mark.parametrize(
    "positions, fault",
    [
        ((), "no position"),
        ((np.nan,), "position nan"),
        ((1e9,), "position 1e+09, beyond 10000 rad"),
    ],
)
def test_joint_states_without_a_position_are_counted_and_named(positions, fault):
    buffer = make()
    for k in range(3):
        buffer.add_joint(k, ("wrist",), positions, 0)
    buffer.add_cloud(cloud(S), 0)
    (event,) = buffer.tick(2 * S)
    assert event.text == (
        f"3 states of joint 'wrist' came, none with a position; the newest has {fault}"
    )
    assert (buffer.state().joint_faults, buffer.state().joint_fault) == (3, fault)
    joints(buffer, 0, 1)
    assert buffer.state().joint_fault == ""
    buffer.add_joint(2 * S, ("wrist",), positions, 0)
    buffer.add_cloud(cloud(4 * S), 2 * S)
    (event,) = buffer.tick(4 * S)
    assert event.reason == "too_old" and event.text.endswith(f"; the newest has {fault}")


def with_points(xyz):
    return dataclasses.replace(cloud(S), xyz=np.array(xyz, np.float32))


@pytest.mark.parametrize(
    "xyz, text",
    [
        (np.zeros((0, 0, 3)), "none of its 0 x 0 points is measured"),
        (np.zeros((4, 5, 3)), "none of its 4 x 5 points is measured (all NaN or zero)"),
        (np.full((4, 5, 3), np.nan), "none of its 4 x 5 points is measured"),
        (np.full((4, 5, 3), 1300.0), "are these millimetres?"),
        (np.full((4, 5, 3), 13.0), "item points below the gripper tip"),
    ],
)
def test_a_cloud_that_shows_nothing_says_why(xyz, text):
    (event,) = make().add_cloud(with_points(xyz), 0)
    assert event.reason == "empty_after_segmentation"
    assert text in event.text


def test_a_cloud_without_a_stamp_is_told_so_wherever_it_is_dropped():
    buffer = make()
    joints(buffer, 10, 12)
    (old,) = buffer.add_cloud(cloud(0), 0)
    buffer.clock_set_back(5 * S)
    (before,) = buffer.add_cloud(cloud(0), 0)
    simulated = make()  # its time begins at 0
    joints(simulated, 0, 2)
    simulated.add_cloud(cloud(S // 2), 0)
    (back,) = simulated.add_cloud(cloud(0), 0)
    reasons = [event.reason for event in (old, back, before)]
    assert reasons == ["too_old", "time_went_backwards", "previous_item"]
    assert all("the cloud's stamp is 0" in event.text for event in (old, back, before))


def test_open_fingers_are_known():
    buffer = make()
    for at, position, is_open in ((1, 0.0, False), (2, 0.03, True), (3, 0.0, False)):
        buffer.add_joint(at * S, ("finger_left", "finger_right"), (position, position), 0)
        assert buffer.fingers_open == is_open


def test_items_go_on_from_a_number():
    buffer = ViewBuffer(CALIBRATION, config_from({}), items_before=4)
    assert buffer.state().item == 5
    assert buffer.new_item() == (ItemStarted(6, "requested"),)


def test_of_two_views_at_one_angle_the_better_stays():
    buffer = make()
    joints(buffer, 0, 10, rate=0.0)
    buffer.add_cloud(cloud(1 * S, rows=40), 0)
    assert dropped(buffer.add_cloud(cloud(2 * S, rows=38), 0)) == ["duplicate_angle"]
    events = buffer.add_cloud(cloud(3 * S, rows=42), 0)
    assert events[0] == ViewReplaced(2, 0)
    assert dropped(events) == ["duplicate_angle"]
    assert check_accounts(buffer).view_ids == (2,)


def test_of_two_views_at_one_angle_the_one_of_a_slower_wrist_stays():
    buffer = make(**{"joints.history_s": 100.0})
    joints(buffer, 0, 12.7, rate=RATE)
    buffer.add_cloud(cloud(2 * S, rows=40), 0)
    for k in range(round(12.7 * 50), 700):  # back at the angle of 2 s, and still
        buffer.add_joint(k * S // 50, ("wrist",), (1.0,), 0)
    events = buffer.add_cloud(cloud(int(13.5 * S), rows=38), 0)
    assert events[0] == ViewReplaced(1, 0)


def test_an_item_that_moved_at_the_same_angle_is_swinging():
    buffer = make()
    joints(buffer, 0, 10, rate=0.0)
    buffer.add_cloud(cloud(1 * S), 0)
    events = buffer.add_cloud(cloud(2 * S, shift=0.05, rows=38), 0)
    assert dropped(events) == ["item_swinging"]
    assert check_accounts(buffer).view_ids == (1,)  # the newer


def test_a_full_buffer_gives_up_the_view_with_the_nearest_neighbours():
    buffer = make(**{"buffer.max_views": 4, "buffer.duplicate_angle_deg": 0.0})
    joints(buffer, 0, 14)
    for angle in (0.5, 2.0, 3.5, 5.0, 5.2):
        events = buffer.add_cloud(cloud(int(angle / RATE * S)), 0)
    assert dropped(events) == ["buffer_full"]
    assert check_accounts(buffer).view_ids in ((0, 1, 2, 3), (0, 1, 2, 4))


def test_a_buffer_is_bounded_by_bytes_too():
    buffer = make(**{"buffer.max_megabytes": 1.0, "buffer.duplicate_angle_deg": 0.0})
    for k in range(1, 60):
        joints(buffer, k - 1, k + 1)
        buffer.add_cloud(cloud(k * S, rows=100), 0)
        assert check_accounts(buffer).nbytes <= 1e6
    state = buffer.state()  # a view of 2000 points has 64 kB
    assert len(state.view_ids) == 15
    assert state.drops == {"buffer_full": 44}


def test_waiting_clouds_are_bounded():
    buffer = make(**{"buffer.max_waiting": 3})
    for k in range(5):
        buffer.add_cloud(cloud(k * S), 0)
    state = check_accounts(buffer)
    assert (state.clouds_waiting, state.drops) == (3, {"buffer_full": 2})


def test_a_clock_that_goes_back_starts_over():
    buffer = make()
    turn_round(buffer, 12, start_s=100.0)
    events = turn_round(buffer, 12, start_s=50.0)
    jumps = [e for e in events if isinstance(e, ClockJumped)]
    assert len(jumps) == 1 and jumps[0].to_ns == 50 * S
    state = check_accounts(buffer)
    assert (state.clock_jumps, state.stage, len(state.view_ids)) == (1, Stage.COMPLETE, 12)


def test_a_clock_that_says_so_itself_starts_over_once():
    buffer = make()
    joints(buffer, 0, 20)
    buffer.add_cloud(cloud(15 * S), 0)
    assert buffer.clock_set_back(int(19.5 * S)) == ()
    jumped, started = buffer.clock_set_back(5 * S)
    assert (type(jumped), jumped.to_ns, started.item) == (ClockJumped, 5 * S, 2)
    joints(buffer, 20, 20.2)  # were on their way
    joints(buffer, 5, 7)
    buffer.add_cloud(cloud(6 * S), 0)
    state = check_accounts(buffer)
    assert (state.item, state.clock_jumps, len(state.view_ids)) == (2, 1, 1)


@pytest.mark.parametrize("told", [True, False])
def test_a_cloud_that_was_on_its_way_when_the_clock_was_set_back_is_of_the_item_before(told):
    buffer = make()
    joints(buffer, 0, 20)
    if told:
        buffer.clock_set_back(5 * S)
    else:
        joints(buffer, 5, 5.1)  # show it themselves
    (late,) = buffer.add_cloud(cloud(int(20.1 * S)), 0)
    assert (late.reason, late.view_id) == ("previous_item", -1)
    assert late.text == "taken before the clock was set back"
    joints(buffer, 5.1 if not told else 5, 20.5)  # the new time comes to that stamp
    buffer.add_cloud(cloud(6 * S), 0)
    buffer.add_cloud(cloud(int(20.1 * S)), 0)
    state = check_accounts(buffer)
    assert (state.view_ids, state.drops) == ((0, 1), {"previous_item": 1})


def test_joint_states_that_go_on_as_before_are_believed_in_the_end():
    """The clock was set back, but not that of the joint states."""
    buffer = make()
    joints(buffer, 0, 20)
    buffer.clock_set_back(5 * S)
    joints(buffer, 20, 22, received=2 * S)
    buffer.add_cloud(cloud(21 * S), 2 * S)
    assert len(check_accounts(buffer).view_ids) == 1


def test_a_cloud_that_shows_the_new_time_first_is_not_lost():
    buffer = make()
    joints(buffer, 100, 110)
    buffer.add_cloud(cloud(105 * S), 0)
    assert buffer.add_cloud(cloud(50 * S + S // 4), 0) == ()  # waits: is it late, or the clock?
    events = joints(buffer, 50, 51)
    assert [type(e) for e in events] == [ClockJumped, ItemStarted, ViewAdded]
    assert check_accounts(buffer).view_ids == (0,)


def test_one_wrong_stamp_moves_no_clock():
    buffer = make()
    joints(buffer, 100, 101)
    buffer.add_joint(5 * S, ("wrist",), (0.0,), 0)
    buffer.add_joint(10**18, ("wrist",), (0.0,), 0)
    buffer.add_cloud(cloud(9 * 10**17), 0)
    joints(buffer, 101, 102)
    assert dropped(buffer.add_cloud(cloud(int(101.5 * S)), 0)) == []
    assert dropped(buffer.tick(10 * S)) == ["too_old"]
    state = check_accounts(buffer)
    assert (state.clock_jumps, state.view_ids) == (0, (1,))


def test_fingers_that_open_and_close_start_a_new_item():
    buffer = make()
    names = ("wrist", "finger_left", "finger_right")
    joints(buffer, 0, 2, names=names, extra=(0.001, 0.001))
    buffer.add_cloud(cloud(1 * S), 0)
    assert joints(buffer, 2, 3, names=names, extra=(0.03, 0.03)) == []
    assert dropped(buffer.add_cloud(cloud(int(2.5 * S)), 0)) == ["gripper_open"]
    check_accounts(buffer)
    buffer.add_cloud(cloud(int(3.01 * S)), 0)  # of the next item, before its joint states
    events = joints(buffer, 3, 4, names=names, extra=(0.001, 0.001))
    assert [type(e) for e in events] == [ItemStarted, ViewAdded]
    state = check_accounts(buffer)
    assert (state.item, state.view_ids, state.clouds_received) == (2, (0,), 1)
    assert dropped(buffer.add_cloud(cloud(int(2.9 * S)), 0)) == ["previous_item"]
    assert check_accounts(buffer).clouds_received == 2


def test_other_settings_and_absurd_positions_do_not_make_open_fingers_forget_that_they_are():
    buffer = make()
    names = ("wrist", "finger_left", "finger_right")
    joints(buffer, 0, 1, names=names, extra=(0.03, 0.03))
    buffer.add_joint(1 * S, names[1:], (float("nan"), float("inf")), 0)
    buffer.configure(config_from({"buffer.max_views": 50}))
    assert dropped([*buffer.add_cloud(cloud(int(1.1 * S)), 0), *joints(buffer, 1, 2)]) == [
        "gripper_open"
    ]
    buffer.configure(config_from({"buffer.finger_joints": "finger_right"}))
    events = [
        *buffer.add_joint(2 * S, names[1:], (0.03, 0.001), 0),
        *joints(buffer, 2, 3, names=names, extra=(0.03, 0.001)),
    ]
    assert ItemStarted(2, "the fingers closed") in events


def test_a_new_item_on_request_forgets_the_views():
    buffer = make()
    turn_round(buffer, 12)
    assert buffer.new_item() == (ItemStarted(2, "requested"),)
    state = check_accounts(buffer)
    assert (state.stage, state.view_ids, state.clouds_received, state.nbytes) == (
        Stage.WAITING,
        (),
        0,
        0,
    )


def test_absurd_messages_do_no_harm():
    buffer = make()
    joints(buffer, 0, 2)
    buffer.add_joint(3, (), (), 0)
    buffer.add_joint(3, ("wrist", "other"), (), 0)
    buffer.add_joint(-5 * S, ("wrist",), (float("nan"),), 0)
    buffer.add_joint(0, tuple(f"j{k}" for k in range(10_000)), (), 0)
    buffer.add_cloud(dataclasses.replace(cloud(S), xyz=np.zeros((0, 0, 3), np.float32)), 0)
    buffer.add_cloud(cloud(S + 1), -(10**18))
    state = check_accounts(buffer)
    assert state.view_ids == (1,)
    assert len(state.joints_seen) < 600


def test_a_long_run_stays_bounded():
    buffer = make(**{"joints.history_s": 2.0, "buffer.max_views": 8})
    for k in range(20_000):
        stamp = k * S // 50
        buffer.add_joint(stamp, ("wrist",), ((RATE * stamp / S) % TURN,), stamp)
        if k % 100 == 50:
            buffer.add_cloud(cloud(stamp, rows=12), stamp)
    state = check_accounts(buffer)
    assert state.clouds_received == 200
    assert len(state.view_ids) <= 8
    assert state.joint_states < 1000
