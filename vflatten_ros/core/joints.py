"""Wrist angle at a cloud's stamp, interpolated between joint states."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass
from enum import Enum

from vflatten_ros.core.config import JointConfig

TURN = 2.0 * math.pi
# Noise at the wrap of a joint that reports 0 to 2 pi, or -pi to pi, stays within this.
WRAP_TOLERANCE_RAD = 0.2
MAX_SAMPLES = 200_000
MAX_POSITION_RAD = 1e4  # 1600 turns; beyond that a driver's mistake, which would end unwrapping


class JointStatus(Enum):
    """Whether a stamp has an angle."""

    OK = "ok"
    WAITING = "waiting"  # needs a later sample
    NO_JOINT = "no joint"  # there is no sample at all
    TOO_OLD = "too old"  # the nearest samples are farther than max_age_s


@dataclass(frozen=True)
class JointReading:
    """The joint at one stamp."""

    status: JointStatus
    position_rad: float = math.nan  # as reported, between the samples
    turns: int = 0  # whole turns to add since the first sample
    rate_rad_s: float = math.nan
    age_s: float = math.nan  # to the farther of the samples used

    @property
    def angle_rad(self) -> float:
        """Joint position, turns unwrapped."""
        return self.position_rad + self.turns * TURN


def position_fault(position: float | None) -> str:
    """What is wrong with a joint state's position, "" if nothing is; None: there is none."""
    if position is None:
        return "no position"
    if not math.isfinite(position):
        return f"position {position}"
    if abs(position) > MAX_POSITION_RAD:
        return f"position {position:g}, beyond {MAX_POSITION_RAD:g} rad"
    return ""


class JointTrack:
    """Recent samples of one joint, turns unwrapped.

    A joint that reports its angle modulo one turn and one that counts its turns are unwrapped
    alike: a step is taken the short way round, except once positions have been seen that no
    wrapped joint reports; from then on a step is taken as reported.

    Samples may come late, twice or out of order within the history. Not thread-safe.
    """

    def __init__(self, config: JointConfig) -> None:
        self._config = config
        self._stamps: list[int] = []
        self._reported: list[float] = []
        self._turns: list[int] = []
        self._lowest = math.inf
        self._highest = -math.inf

    def configure(self, config: JointConfig) -> None:
        """Use other settings from now on; the samples stay."""
        self._config = config

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample."""
        return self._stamps[-1] if self._stamps else None

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest sample kept."""
        return self._stamps[0] if self._stamps else None

    def clear(self) -> None:
        """Forget all samples; what is known of the joint's range stays."""
        self._stamps.clear()
        self._reported.clear()
        self._turns.clear()

    def add(self, stamp_ns: int, position_rad: float) -> bool:
        """Add one sample; False if absurd, of a stamp already there, or before the history."""
        if not abs(position_rad) <= MAX_POSITION_RAD:
            return False
        place = bisect_left(self._stamps, stamp_ns)
        if place < len(self._stamps) and self._stamps[place] == stamp_ns:
            return False
        if self._stamps and stamp_ns < self._stamps[-1] - self._history_ns:
            return False
        self._lowest = min(self._lowest, position_rad)
        self._highest = max(self._highest, position_rad)
        turns = self._turns_at(position_rad, max(place - 1, 0)) if self._stamps else 0
        self._stamps.insert(place, stamp_ns)
        self._reported.insert(place, position_rad)
        self._turns.insert(place, turns)
        self._forget()
        return True

    def at(self, stamp_ns: int) -> JointReading:
        """The joint at a stamp, between the samples on both sides of it.

        Returns
        -------
        JointReading
            WAITING while no sample at or after the stamp has come.
        """
        if not self._stamps:
            return JointReading(JointStatus.NO_JOINT)
        after = bisect_left(self._stamps, stamp_ns)
        if after == len(self._stamps):
            return JointReading(JointStatus.WAITING, age_s=(stamp_ns - self._stamps[-1]) * 1e-9)
        exact = self._stamps[after] == stamp_ns
        before = after if exact else after - 1
        age_s = (self._stamps[after] - stamp_ns) * 1e-9
        if before >= 0:
            age_s = max(age_s, (stamp_ns - self._stamps[before]) * 1e-9)
        if before < 0 or age_s > self._config.max_age_s:
            return JointReading(JointStatus.TOO_OLD, age_s=age_s)
        return self._interpolate(before, after, stamp_ns, age_s)

    def held(self, stamp_ns: int) -> JointReading:
        """The newest sample's angle, for a stamp that no later sample follows.

        For when waiting is over: the angle is held, not extrapolated, and only up to max_age_s.
        """
        if not self._stamps:
            return JointReading(JointStatus.NO_JOINT)
        age_s = (stamp_ns - self._stamps[-1]) * 1e-9
        if age_s <= 0.0:
            return self.at(stamp_ns)
        if age_s > self._config.max_age_s:
            return JointReading(JointStatus.TOO_OLD, age_s=age_s)
        last = len(self._stamps) - 1
        rate = self._rate(last, last)
        return JointReading(JointStatus.OK, self._reported[last], self._turns[last], rate, age_s)

    @property
    def _history_ns(self) -> int:
        return int(self._config.history_s * 1e9)

    def _turns_at(self, position: float, neighbour: int) -> int:
        """Turns to add to a position beside a sample."""
        if self._counts_turns():
            return self._turns[neighbour]
        return self._turns[neighbour] - round((position - self._reported[neighbour]) / TURN)

    def _step(self, before: int, after: int) -> float:
        turns = self._turns[after] - self._turns[before]
        return self._reported[after] - self._reported[before] + turns * TURN

    def _counts_turns(self) -> bool:
        low, high = self._lowest, self._highest
        return (
            high - low > TURN + WRAP_TOLERANCE_RAD
            or low < -math.pi - WRAP_TOLERANCE_RAD
            or high > TURN + WRAP_TOLERANCE_RAD
        )

    def _interpolate(self, before: int, after: int, stamp_ns: int, age_s: float) -> JointReading:
        span = self._stamps[after] - self._stamps[before]
        share = (stamp_ns - self._stamps[before]) / span if span else 0.0
        position = self._reported[before] + share * self._step(before, after)
        rate = self._rate(before, after)
        return JointReading(JointStatus.OK, position, self._turns[before], rate, age_s)

    def _rate(self, before: int, after: int) -> float:
        """Mean rate over at least 40 ms about the samples, so that encoder noise does not count."""
        last = len(self._stamps) - 1
        while self._stamps[after] - self._stamps[before] < 40_000_000:
            if before == 0 and after == last:
                break
            before, after = max(before - 1, 0), min(after + 1, last)
        span_s = (self._stamps[after] - self._stamps[before]) * 1e-9
        return self._step(before, after) / span_s if span_s else 0.0

    def _forget(self) -> None:
        oldest = self._stamps[-1] - self._history_ns
        drop = max(bisect_left(self._stamps, oldest), len(self._stamps) - MAX_SAMPLES)
        # In blocks: removing from the front of a list costs its length.
        if drop > 256 or len(self._stamps) > MAX_SAMPLES:
            del self._stamps[:drop], self._reported[:drop], self._turns[:drop]
