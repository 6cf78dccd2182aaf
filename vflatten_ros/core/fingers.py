"""Whether the gripper is open, from the finger joints."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping

from vflatten_ros.core.config import BufferConfig

MAX_CHANGES = 64


class FingerWatch:
    """Opening and closing of the fingers, with hysteresis between two thresholds."""

    def __init__(self, config: BufferConfig) -> None:
        self.configure(config)
        self._latest: dict[str, float | None] = {}
        self._newest_ns: int | None = None
        self._changes: list[tuple[int, bool]] = []  # stamp, whether open from then on

    def configure(self, config: BufferConfig) -> None:
        """Use other joints or thresholds from now on; how the fingers are stays."""
        self._joints = [name.strip() for name in config.finger_joints.split(",") if name.strip()]
        self._open_above = config.finger_open
        self._closed_below = min(config.finger_closed, config.finger_open)

    def clear(self) -> None:
        """Forget when the fingers moved; how they are now stays."""
        is_open = bool(self._changes) and self._changes[-1][1]
        self._changes = [(-(2**63), True)] if is_open else []
        self._newest_ns = None

    def add(self, stamp_ns: int, positions: Mapping[str, float]) -> int | None:
        """Take a joint state; the stamp at which open fingers have closed, else None."""
        if self._newest_ns is not None and stamp_ns <= self._newest_ns:
            return None
        own = {name: float(positions[name]) for name in self._joints if name in positions}
        own = {name: position for name, position in own.items() if math.isfinite(position)}
        if not own:
            return None
        self._newest_ns = stamp_ns
        self._latest = {name: own.get(name, self._latest.get(name)) for name in self._joints}
        known = [position for position in self._latest.values() if position is not None]
        mean = sum(known) / len(known)
        was_open = bool(self._changes) and self._changes[-1][1]
        if not was_open and mean > self._open_above:
            self._change(stamp_ns, True)
        elif was_open and mean < self._closed_below:
            self._change(stamp_ns, False)
            return stamp_ns
        return None

    def open_at(self, stamp_ns: int) -> bool:
        """Whether the fingers were open at a stamp."""
        place = bisect_right(self._changes, (stamp_ns, True))
        return place > 0 and self._changes[place - 1][1]

    def _change(self, stamp_ns: int, is_open: bool) -> None:
        self._changes = [*self._changes[1 - MAX_CHANGES :], (stamp_ns, is_open)]
