"""The views of the present item: what the live node and the replay share, without ROS.

Joint states and clouds go in as they arrive; views come out once the wrist angle at a cloud's
stamp lies between two joint states. Every cloud becomes a view, waits, or is counted under the
reason why it gave none: received = views + waiting + sum(drops). Not thread-safe.

Stamps are the sensors' clock; `received_ns` and `now_ns` are the receiver's, for time-outs only.
So the same messages give the same views however joint states and clouds interleave.
"""

from __future__ import annotations

import dataclasses
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import EmptyView
from vflatten_ros.core.events import (
    CLOCK_SET_BACK,
    DROP_REASONS,
    BufferState,
    ClockJumped,
    CloudDropped,
    Event,
    ItemStarted,
    RotationComplete,
    Stage,
    ViewAdded,
    ViewReplaced,
    WristStill,
)
from vflatten_ros.core.fingers import FingerWatch
from vflatten_ros.core.joints import JointReading, JointStatus, JointTrack, position_fault
from vflatten_ros.core.segmentation import segment, view_at
from vflatten_ros.core.turntable import (
    TURN,
    angle_between,
    angle_covered,
    crowded,
    rotation_complete,
)
from vflatten_ros.core.values import Calibration, Cloud, View

__all__ = [
    "DROP_REASONS",
    "BufferState",
    "ClockJumped",
    "CloudDropped",
    "Event",
    "ItemStarted",
    "RotationComplete",
    "Stage",
    "ViewAdded",
    "ViewBuffer",
    "ViewReplaced",
    "WristStill",
]

MOST_NAMES = 256  # joints remembered by name
ON_ITS_WAY_NS = 300_000_000  # longest from a joint state's publication to its arrival
RECENT = 20  # clouds
# A wrist that has moved less while so many clouds came in so long a time does not turn.
STILL_RAD, STILL_CLOUDS, STILL_NS = 0.1, 10, 5_000_000_000
FAR_M = 100.0  # no rig looks farther: the numbers are not metres


@dataclass(frozen=True, eq=False)
class _Waiting:
    view: View  # angle not known yet
    received_ns: int


class ViewBuffer:
    """Views of the present item, gathered from clouds and joint states."""

    def __init__(self, calibration: Calibration, config: Config, items_before: int = 0) -> None:
        """`items_before`: the first item's number is the next one."""
        self._calibration = calibration
        self._config = config
        self._track = JointTrack(config.joints)
        self._fingers = FingerWatch(config.buffer)
        self._joints_seen: set[str] = set()
        self._item = items_before
        self._clock_jumps = 0
        self._joint_faults = 0
        self._joint_fault = ""
        self._now_ns = 0
        self._suspect: tuple[int, float] | None = None
        self._outdated: tuple[int, int] | None = None  # stamps from, received until
        self._begin_item()

    @property
    def config(self) -> Config:
        """The settings in use."""
        return self._config

    def configure(self, config: Config) -> None:
        """Use other settings from now on; views and joint states so far stay."""
        self._fingers.configure(config.buffer)
        self._track.configure(config.joints)
        self._config = config

    # ---- what comes in

    def add_joint(
        self, stamp_ns: int, names: Sequence[str], positions: Sequence[float], received_ns: int
    ) -> tuple[Event, ...]:
        """Take one joint state; states without the wrist joint count for the fingers only."""
        if len(self._joints_seen) < MOST_NAMES:
            self._joints_seen.update(names[:MOST_NAMES])
        if self._on_its_way(stamp_ns, received_ns):
            return self._settle(received_ns)
        values = dict(zip(names, positions, strict=False))
        events: list[Event] = []
        if self._calibration.joint in names:
            position = values.get(self._calibration.joint)
            self._joint_fault = position_fault(position)
            self._joint_faults += bool(self._joint_fault)
            if position is not None:
                events += self._add_wrist(stamp_ns, float(position))
        closed_ns = self._fingers.add(stamp_ns, values)
        if closed_ns is not None:
            events += self._start_item("the fingers closed", closed_ns)
        return (*events, *self._settle(received_ns))

    def add_cloud(self, cloud: Cloud, received_ns: int) -> tuple[Event, ...]:
        """Take one decoded cloud: its item is segmented at once, its angle decided when known."""
        if late := self._late(cloud.stamp_ns):
            self._received += 1  # takes no id, so that ids do not depend on how late it came
            text = late + _unstamped(cloud.stamp_ns)
            return (self._drop(-1, "previous_item", text), *self._settle(received_ns))
        view_id = self._count_cloud()
        if cloud.frame_id != self._calibration.frame:
            text = f"frame {cloud.frame_id!r}, the calibration is for {self._calibration.frame!r}"
            return (self._drop(view_id, "wrong_frame", text), *self._settle(received_ns))
        try:
            pixel = segment(cloud, self._calibration, self._config.segmentation)
        except EmptyView as error:
            text = _unusable(cloud) or str(error)
            dropped = self._drop(view_id, "empty_after_segmentation", text)
            return (dropped, *self._settle(received_ns))
        view = view_at(view_id, cloud, pixel, self._calibration, np.nan)
        self._waiting.append(_Waiting(view, received_ns))
        events = list(self._settle(received_ns))
        if len(self._waiting) > self._config.buffer.max_waiting:
            first = self._waiting.pop(0).view
            events.append(
                self._drop(first.view_id, "buffer_full", "too many clouds wait for joint states")
            )
        return tuple(events)

    def reject_cloud(self, reason: str, received_ns: int) -> tuple[Event, ...]:
        """Count a cloud that could not be decoded."""
        dropped = self._drop(self._count_cloud(), "invalid_cloud", reason)
        return (dropped, *self._settle(received_ns))

    def tick(self, now_ns: int) -> tuple[Event, ...]:
        """Let time pass: clouds that have waited too long are decided or dropped."""
        return self._settle(now_ns)

    def finish(self) -> tuple[Event, ...]:
        """No more messages will come: decide every waiting cloud by the joint states there are."""
        return self._settle(self._now_ns, last=True)

    def new_item(self, cause: str = "requested") -> tuple[Event, ...]:
        """Forget the present item's views and counts."""
        return tuple(self._start_item(cause, None))

    def clock_set_back(self, to_ns: int) -> tuple[Event, ...]:
        """The clock reads `to_ns` again: forget what is stamped later, unless by a little only.

        Where nobody says so, joint states show it.
        """
        newest = max(self._newest_ns or to_ns, self._track.newest_ns or to_ns)
        if newest - to_ns <= self._config.buffer.clock_jump_s * 1e9:
            return ()
        self._outdated = ((newest + to_ns) // 2, self._now_ns + ON_ITS_WAY_NS)
        return tuple(self._jump_back(newest, to_ns))

    def clear_views(self, view_ids: Iterable[int]) -> tuple[Event, ...]:
        """Remove some views; unknown ids are left out."""
        known = sorted(set(view_ids) & set(self._views))
        events = [self._remove(view_id, "cleared", "removed on request") for view_id in known]
        self._complete &= self._goes_round()
        return tuple(events)

    # ---- what comes out

    @property
    def fingers_open(self) -> bool:
        """Whether the fingers are open now: they hold no item."""
        return self._fingers.open_at(2**63)

    def views(self) -> tuple[View, ...]:
        """The views, by id."""
        return tuple(self._views[key] for key in sorted(self._views))

    def state(self) -> BufferState:
        """Summary of the present item."""
        stage = Stage.GATHERING if self._views else Stage.WAITING
        return BufferState(
            stage=Stage.COMPLETE if self._complete else stage,
            item=self._item,
            view_ids=tuple(sorted(self._views)),
            angle_covered_rad=angle_covered(self._angles(), self._max_gap_rad),
            nbytes=self._nbytes(),
            clouds_received=self._received,
            clouds_waiting=len(self._waiting),
            drops=dict(sorted(self._drops.items())),
            joint_states=len(self._track),
            joints_seen=tuple(sorted(self._joints_seen)),
            clock_jumps=self._clock_jumps,
            recent=tuple(self._recent),
            still=self._still(),
            joint_faults=self._joint_faults,
            joint_fault=self._joint_fault,
        )

    # ---- the item

    def _begin_item(self) -> None:
        self._item += 1
        self._views: dict[int, View] = {}
        self._rates: dict[int, float] = {}
        self._waiting: list[_Waiting] = []
        self._drops: Counter[str] = Counter()
        self._received = 0
        self._next_id = 0
        self._complete = False
        self._recent: deque[str] = deque(maxlen=RECENT)
        self._readings: list[tuple[int, float]] = []  # stamp, joint: first, lowest, highest, last
        self._placed = 0  # clouds whose angle was known
        self._told_still = False
        self._newest_ns: int | None = None
        self._first_turns: int | None = None
        self._item_start_ns: int | None = None
        self._before_jump: tuple[int, int] | None = None  # stamps of clouds on their way then

    def _start_item(self, cause: str, start_ns: int | None) -> list[Event]:
        """Begin the next item; clouds taken after its start that came too early move to it."""
        waiting = self._waiting
        self._begin_item()
        self._item_start_ns = start_ns
        for entry in waiting:
            if start_ns is not None and entry.view.stamp_ns >= start_ns:
                view = dataclasses.replace(entry.view, view_id=self._count_cloud())
                self._waiting.append(_Waiting(view, entry.received_ns))
        return [ItemStarted(self._item, cause)]

    def _count_cloud(self) -> int:
        self._received += 1
        self._next_id += 1
        return self._next_id - 1

    def _drop(self, view_id: int, reason: str, text: str) -> CloudDropped:
        self._drops[reason] += 1
        if reason != "cleared":
            self._recent.append(reason)
        return CloudDropped(view_id, reason, text)

    # ---- joint states

    def _on_its_way(self, stamp_ns: int, received_ns: int) -> bool:
        """Whether a joint state was sent before the clock was set back, and came after."""
        if self._outdated is None:
            return False
        from_ns, until_ns = self._outdated
        if stamp_ns >= from_ns and received_ns < until_ns:
            return True
        self._outdated = None
        return False

    def _add_wrist(self, stamp_ns: int, position: float) -> list[Event]:
        """One sample of the wrist; the clock was set back once two samples in a row say so."""
        newest = self._track.newest_ns
        jump_ns = self._config.buffer.clock_jump_s * 1e9
        if newest is None or abs(stamp_ns - newest) <= jump_ns:
            self._suspect = None
            self._track.add(stamp_ns, position)
            return []
        suspect, self._suspect = self._suspect, (stamp_ns, position)
        if suspect is None or not 0 < stamp_ns - suspect[0] <= jump_ns:
            return []
        self._suspect = None
        events = self._jump_back(newest, suspect[0]) if suspect[0] < newest else []
        self._track.add(*suspect)
        self._track.add(stamp_ns, position)
        return events

    def _jump_back(self, from_ns: int, to_ns: int) -> list[Event]:
        early = [entry for entry in self._waiting if entry.view.stamp_ns < from_ns]
        self._track.clear()
        self._fingers.clear()
        self._clock_jumps += 1
        events: list[Event] = [ClockJumped(from_ns, to_ns)]
        self._waiting = early
        events += self._start_item(CLOCK_SET_BACK, min(to_ns, from_ns))
        jump_ns = int(self._config.buffer.clock_jump_s * 1e9)
        self._before_jump = ((from_ns + to_ns) // 2, from_ns + jump_ns)
        return events

    # ---- clouds

    def _late(self, stamp_ns: int) -> str:
        """Why a cloud shows an item before the present one, if it does."""
        if self._item_start_ns is not None and stamp_ns < self._item_start_ns:
            return "taken before the present item was held"
        if self._before_jump is None:
            return ""
        from_ns, until_ns = self._before_jump
        ahead_ns = (self._track.newest_ns or 0) + self._config.buffer.clock_jump_s * 1e9
        if from_ns <= stamp_ns <= until_ns and stamp_ns > ahead_ns:
            return "taken before the clock was set back"
        return ""

    def _settle(self, now_ns: int, last: bool = False) -> tuple[Event, ...]:
        """Decide every waiting cloud that can be decided, in order of arrival."""
        self._now_ns = now_ns
        events: list[Event] = []
        still: list[_Waiting] = []
        waiting, self._waiting = self._waiting, []
        for entry in waiting:
            over = last or now_ns - entry.received_ns >= self._config.joints.wait_s * 1e9
            reading = self._track.at(entry.view.stamp_ns)
            undecided = reading.status in (JointStatus.WAITING, JointStatus.NO_JOINT)
            if not over and (undecided or self._far_back(entry.view.stamp_ns)):
                still.append(entry)
                continue
            if reading.status is JointStatus.WAITING:
                reading = self._track.held(entry.view.stamp_ns)
            events += self._decide(entry.view, reading)
        self._waiting = still
        return (*events, *self._check_complete(bool(events)))

    def _far_back(self, stamp_ns: int) -> bool:
        """Whether a cloud may belong to a time after a clock jump that joint states will show."""
        jump_ns = self._config.buffer.clock_jump_s * 1e9
        return self._newest_ns is not None and stamp_ns < self._newest_ns - jump_ns

    def _decide(self, view: View, reading: JointReading) -> list[Event]:
        refused = self._refuse(view, reading)
        if refused is not None:
            return [self._drop(view.view_id, *refused)]
        self._newest_ns = view.stamp_ns
        placed = dataclasses.replace(view, angle_rad=self._item_angle(reading))
        events = self._store(placed, abs(reading.rate_rad_s))
        return [*events, *self._watch_wrist(view.stamp_ns, reading.angle_rad)]

    def _watch_wrist(self, stamp_ns: int, angle_rad: float) -> list[Event]:
        """Say once for an item that the wrist does not turn, if it does not."""
        first, *_ = seen = [*self._readings, (stamp_ns, angle_rad)]
        by_angle = sorted(seen, key=lambda reading: reading[1])
        self._readings = [first, by_angle[0], by_angle[-1], seen[-1]]
        self._placed += 1
        still = self._still()
        if still is None or self._told_still:
            return []
        self._told_still = True
        return [still]

    def _still(self) -> WristStill | None:
        if self._placed < STILL_CLOUDS:
            return None
        first, lowest, highest, last = self._readings
        moved = highest[1] - lowest[1]
        if moved >= STILL_RAD or last[0] - first[0] < STILL_NS:
            return None
        return WristStill(moved, self._placed)

    def _item_angle(self, reading: JointReading) -> float:
        """Item angle, unwrapped; the item's first view lies between -pi and pi.

        So the same clouds have the same angles, to the last bit, whenever the joint states began.
        """
        within = self._calibration.item_angle_rad(reading.position_rad)
        turns = round(self._calibration.joint_sign) * reading.turns
        if self._first_turns is None:
            self._first_turns = turns + round(within / TURN)
        return within + (turns - self._first_turns) * TURN

    def _refuse(self, view: View, reading: JointReading) -> tuple[str, str] | None:
        """Why a cloud gives no view, whatever the other views are."""
        stamp, limit = view.stamp_ns, self._config.buffer.max_rate_rad_s
        joint, unstamped = self._calibration.joint, _unstamped(view.stamp_ns)
        if reading.status is JointStatus.NO_JOINT:
            return "no_joint_state", self._no_joint_text()
        if reading.status is not JointStatus.OK:
            age = f"{reading.age_s:.3f} s from the cloud's stamp"
            text = f"joint states of {joint!r} are {age}, joints.max_age_s allows less"
            return "too_old", text + self._fault_text() + unstamped
        if self._newest_ns is not None and stamp <= self._newest_ns:
            back = (self._newest_ns - stamp) * 1e-9
            text = f"stamped {back:.3f} s before the newest view"
            return "time_went_backwards", text + unstamped
        if self._fingers.open_at(stamp):
            return "gripper_open", "taken while the fingers were open"
        if limit and abs(reading.rate_rad_s) > limit:
            return "wrist_moving_too_fast", f"wrist turned at {abs(reading.rate_rad_s):.2f} rad/s"
        return None

    def _no_joint_text(self) -> str:
        joint = self._calibration.joint
        if self._joint_faults:
            text = f"{self._joint_faults} states of joint {joint!r} came, none with a position"
            return text + self._fault_text()
        seen = ", ".join(sorted(self._joints_seen)) or "none"
        return f"no state of joint {joint!r} (joints seen: {seen})"

    def _fault_text(self) -> str:
        return f"; the newest has {self._joint_fault}" if self._joint_fault else ""

    def _store(self, view: View, rate: float) -> list[Event]:
        """Put a view in its place: beside the others, instead of one at its angle, or nowhere."""
        rival = self._rival(view)
        events: list[Event] = []
        if rival is None:
            self._recent.append("")
            events.append(ViewAdded(view.view_id, view.angle_rad, len(view.points_rig)))
        else:
            swung = self._swung(view, rival)
            if not swung and not self._better(view, rate, rival):
                text = f"view {rival.view_id} at the same angle is better"
                return [self._drop(view.view_id, "duplicate_angle", text)]
            reason = "item_swinging" if swung else "duplicate_angle"
            text = f"view {view.view_id} took its place"
            events += [
                ViewReplaced(view.view_id, rival.view_id),
                self._remove(rival.view_id, reason, text),
            ]
        self._views[view.view_id] = view
        self._rates[view.view_id] = rate
        return events + self._make_room()

    def _rival(self, view: View) -> View | None:
        """The stored view nearest in angle, if nearer than duplicate_angle_deg."""
        limit = np.radians(self._config.buffer.duplicate_angle_deg)
        near = [(angle_between(v.angle_rad, view.angle_rad), v.view_id) for v in self.views()]
        distance, view_id = min(near, default=(np.inf, -1))
        return self._views[view_id] if distance < limit else None

    def _better(self, view: View, rate: float, rival: View) -> bool:
        """A clearly slower wrist is better, else more points; the older where they are equal."""
        difference = rate - self._rates[rival.view_id]
        if abs(difference) > 0.05:
            return difference < 0
        return len(view.points_rig) > len(rival.points_rig)

    def _swung(self, view: View, rival: View) -> bool:
        limit = self._config.buffer.swing_m
        moved = np.linalg.norm(view.points_rig.mean(axis=0) - rival.points_rig.mean(axis=0))
        return bool(limit and moved > limit)

    def _make_room(self) -> list[Event]:
        events: list[Event] = []
        config = self._config.buffer
        while len(self._views) > config.max_views or self._nbytes() > config.max_megabytes * 1e6:
            ids = sorted(self._views)
            if len(ids) == 1:
                break
            view_id = ids[crowded([self._views[key].angle_rad for key in ids])]
            events.append(self._remove(view_id, "buffer_full", DROP_REASONS["buffer_full"]))
        return events

    def _remove(self, view_id: int, reason: str, text: str) -> CloudDropped:
        del self._views[view_id], self._rates[view_id]
        return self._drop(view_id, reason, text)

    # ---- the rotation

    @property
    def min_views(self) -> int:
        """Fewest views of a complete rotation."""
        return self._config.buffer.min_views

    @property
    def _max_gap_rad(self) -> float:
        return float(np.radians(self._config.buffer.max_gap_deg))

    def _angles(self) -> list[float]:
        return [view.angle_rad for view in self.views()]

    def _nbytes(self) -> int:
        return sum(view.nbytes for view in self._views.values())

    def _check_complete(self, changed: bool) -> list[Event]:
        if self._complete or not changed or not self._goes_round():
            return []
        self._complete = True
        return [
            RotationComplete(len(self._views), angle_covered(self._angles(), self._max_gap_rad))
        ]

    def _goes_round(self) -> bool:
        enough = len(self._views) >= self._config.buffer.min_views
        return enough and rotation_complete(self._angles(), self._max_gap_rad)


def _unstamped(stamp_ns: int) -> str:
    return "" if stamp_ns else "; the cloud's stamp is 0: set it in the camera driver"


def _unusable(cloud: Cloud) -> str:
    """What is wrong with all points of a cloud, whatever it shows; "" if nothing is."""
    points = cloud.xyz.reshape(-1, 3)
    away = np.linalg.norm(points[np.isfinite(points).all(axis=1)], axis=1)
    away = away[away > 0.0]
    if not len(away):
        rows, cols = cloud.xyz.shape[:2]
        return f"none of its {rows} x {cols} points is measured (all NaN or zero)"
    if away.min() > FAR_M:
        return (
            f"its nearest point is {away.min():.0f} m away; metres are expected: "
            "are these millimetres?"
        )
    return ""
