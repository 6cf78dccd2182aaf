"""The wrist angle at a stamp, from samples that come wrapped, late, twice or not at all."""

import numpy as np
import pytest

from vflatten_ros.core.config import JointConfig
from vflatten_ros.core.joints import JointStatus, JointTrack

TURN = 2 * np.pi
MS = 1_000_000


def track_of(stamps_ms, positions, **options):
    track = JointTrack(JointConfig(**options))
    for stamp, position in zip(stamps_ms, positions):
        track.add(int(stamp * MS), float(position))
    return track


def angle_at(track, stamp_ms):
    reading = track.at(int(stamp_ms * MS))
    assert reading.status is JointStatus.OK
    return reading.angle_rad


def test_angle_and_rate_lie_on_the_line_between_samples():
    track = track_of([0, 20, 40, 60], [1.0, 1.1, 1.2, 1.3])
    reading = track.at(25 * MS)
    assert reading.angle_rad == pytest.approx(1.125, abs=1e-12)
    assert reading.rate_rad_s == pytest.approx(5.0, abs=1e-9)
    assert angle_at(track, 40) == pytest.approx(1.2, abs=1e-12)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("low", [0.0, -np.pi])
def test_a_wrapped_joint_is_unwrapped_over_many_turns_with_noise_at_the_wrap(direction, low):
    stamps = np.arange(0, 100_000, 20)
    true = low + direction * 0.4e-3 * stamps  # 0.4 rad/s, 6 turns
    noise = np.random.default_rng(0).normal(0, 0.001, len(stamps))
    track = track_of(stamps, (true + noise - low) % TURN + low, history_s=1000.0)
    asked = np.arange(100, 99_000, 333)
    got = np.array([angle_at(track, stamp) for stamp in asked])
    error = got - (low + direction * 0.4e-3 * asked)
    whole = np.round(error[0] / TURN) * TURN  # the first sample may lie on either side of the wrap
    assert np.abs(error - whole).max() < 0.006  # six sigma of the noise


def test_a_wrist_that_stands_on_the_wrap_does_not_turn():
    noise = np.random.default_rng(1).normal(0, 0.001, 200)
    track = track_of(np.arange(200) * 20, noise % TURN)
    angles = [angle_at(track, stamp) for stamp in range(10, 3900, 50)]
    assert np.ptp(angles) < 0.01


def test_a_joint_that_counts_turns_keeps_its_count_over_a_gap():
    track = track_of([0, 20, 5000, 5020], [20.0, 20.1, 45.0, 45.1], max_age_s=10.0)
    assert angle_at(track, 10) == pytest.approx(20.05)
    assert angle_at(track, 5010) == pytest.approx(45.05)
    assert angle_at(track, 20) < angle_at(track, 2500) < angle_at(track, 5000)


def test_a_stamp_after_all_samples_waits_and_is_then_held_within_max_age():
    track = track_of([0, 20], [1.0, 1.2], max_age_s=0.1)
    assert track.at(50 * MS).status is JointStatus.WAITING
    held = track.held(50 * MS)
    assert (held.status, held.angle_rad) == (JointStatus.OK, 1.2)  # held, not extrapolated
    assert track.held(130 * MS).status is JointStatus.TOO_OLD


def test_a_stamp_before_all_samples_or_in_a_gap_has_no_angle():
    track = track_of([1000, 1020, 2000], [0.0, 0.0, 0.0], max_age_s=0.1)
    assert track.at(990 * MS).status is JointStatus.TOO_OLD
    assert track.at(1030 * MS).status is JointStatus.TOO_OLD  # the sample after it is 0.97 s away
    assert track.at(1010 * MS).status is JointStatus.OK
    assert JointTrack(JointConfig()).at(0).status is JointStatus.NO_JOINT
    assert JointTrack(JointConfig()).held(0).status is JointStatus.NO_JOINT


def test_order_of_arrival_does_not_matter():
    stamps = np.arange(0, 20_000, 20)
    positions = (0.7e-3 * stamps) % TURN
    straight = track_of(stamps, positions)
    shuffled = np.arange(len(stamps)).reshape(-1, 5)[:, [0, 4, 2, 1, 3]].ravel()  # up to 80 ms late
    late = track_of(stamps[shuffled], positions[shuffled])
    for stamp in range(10, 19_900, 97):
        assert late.at(stamp * MS) == straight.at(stamp * MS)


def test_repeated_stamps_and_bad_positions_are_refused():
    track = track_of([0, 20], [0.0, 0.2])
    assert not track.add(20 * MS, 9.0)
    assert not track.add(40 * MS, float("nan"))
    assert not track.add(40 * MS, float("inf"))
    assert not track.add(40 * MS, 1e300)
    assert angle_at(track, 10) == pytest.approx(0.1)


def test_history_is_bounded_and_samples_before_it_are_refused():
    track = track_of(np.arange(0, 100_000, 2), np.zeros(50_000), history_s=1.0)
    assert len(track) < 1000
    assert track.newest_ns - track.oldest_ns < 2_000 * MS
    assert not track.add(0, 0.0)


def test_the_angle_has_the_same_bits_whenever_the_samples_began():
    stamps = np.arange(0, 30_000, 20)
    positions = (0.9e-3 * stamps + 5.0) % TURN
    whole, part = track_of(stamps, positions), track_of(stamps[500:], positions[500:])
    first, second = whole.at(25_003 * MS), part.at(25_003 * MS)
    assert first.position_rad == second.position_rad
    assert first.turns - second.turns == whole.at(12_003 * MS).turns - part.at(12_003 * MS).turns
