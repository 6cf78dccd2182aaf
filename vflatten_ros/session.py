"""The present item as a planner sees it: views, selection, corresponding points; without ROS."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vflatten_ros import messages
from vflatten_ros.core.buffer import ViewBuffer
from vflatten_ros.core.config import METHODS, Config
from vflatten_ros.core.errors import InvalidCorrespondence, VFlattenError
from vflatten_ros.core.events import CloudDropped, Event, ItemStarted, Stage
from vflatten_ros.core.joints import position_fault
from vflatten_ros.core.values import Calibration, Cloud, Correspondence, View
from vflatten_ros.goals import Task

OK, INVALID_ARGUMENT, UNKNOWN_VIEW, UNKNOWN_NAME, NO_VIEWS, NO_RESULT = range(6)  # msg/Status
NOT_ACTIVE, BUSY, CANCELLED, FAILED, PARTLY, NOT_SEEN, NOT_HELD, NO_JOINT_STATE = range(6, 14)
UNKNOWN_ID = UNKNOWN_VIEW

MAX_PAIRS = 1000  # held, and in one request: each is looked up in its views, 1 ms or so
MAX_IDS = 100_000  # in one request
Places = frozenset[tuple[int, tuple[int, int]]]  # view and pixel of both sides


class Refused(VFlattenError):
    """A request that cannot be done; `code` is one of msg/Status."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True)
class Wrist:
    """The wrist's newest joint state."""

    position_rad: float
    stamp_ns: int
    received_ns: int  # steady clock: stamps may be of another clock than ours


class Session:
    """The buffer of the present item and what was asked about it. Not thread-safe."""

    def __init__(self, calibration: Calibration, config: Config, items_before: int = 0) -> None:
        self.calibration = calibration
        self.buffer = ViewBuffer(calibration, config, items_before)
        self.pairs: dict[int, Correspondence] = {}
        self.wrist: Wrist | None = None
        self.enough = False  # a result so far says that further views would hardly change it
        self._looked_rad = 0.0  # angle covered when the last early look began
        self._selection: tuple[int, ...] | None = None
        self._next_pair = 1

    # ---- sensors

    def add_joint(
        self, stamp_ns: int, names: Sequence[str], positions: Sequence[float], now_ns: int
    ) -> tuple[Event, ...]:
        """Take one joint state."""
        position = dict(zip(names, positions, strict=False)).get(self.calibration.joint)
        if position is not None and not position_fault(position):
            self.wrist = Wrist(float(position), stamp_ns, now_ns)
        return self._noted(self.buffer.add_joint(stamp_ns, names, positions, now_ns))

    def add_cloud(self, cloud: Cloud, now_ns: int) -> tuple[Event, ...]:
        """Take one decoded cloud."""
        return self._noted(self.buffer.add_cloud(cloud, now_ns))

    def reject_cloud(self, reason: str, now_ns: int) -> tuple[Event, ...]:
        """Count a cloud that could not be decoded."""
        return self._noted(self.buffer.reject_cloud(reason, now_ns))

    def tick(self, now_ns: int) -> tuple[Event, ...]:
        """Let time pass."""
        return self._noted(self.buffer.tick(now_ns))

    def new_item(self, cause: str) -> tuple[Event, ...]:
        """Forget the present item."""
        return self._noted(self.buffer.new_item(cause))

    def item_angle(self, now_ns: int, limit_s: float) -> tuple[float, int]:
        """Item angle of the newest joint state, and its stamp.

        Raises
        ------
        Refused
            There is none, or it came longer ago than `limit_s`.
        """
        joint = self.calibration.joint
        if self.wrist is None:
            raise Refused(NO_JOINT_STATE, f"no state of joint {joint!r} has come; give item_angle")
        age_s = (now_ns - self.wrist.received_ns) * 1e-9
        if age_s > limit_s:
            raise Refused(
                NO_JOINT_STATE,
                f"the newest state of joint {joint!r} came {age_s:.1f} s ago, no_data_warning_s "
                f"allows {limit_s:g} s; does the robot still send? Or give item_angle",
            )
        return self.calibration.item_angle_rad(self.wrist.position_rad), self.wrist.stamp_ns

    def clock_set_back(self, to_ns: int) -> tuple[Event, ...]:
        """Forget what is stamped later than the clock, which was set back."""
        return self._noted(self.buffer.clock_set_back(to_ns))

    def _noted(self, events: tuple[Event, ...]) -> tuple[Event, ...]:
        if any(isinstance(event, ItemStarted) for event in events):
            self.pairs.clear()
            self._selection = None
            self.enough, self._looked_rad = False, 0.0
        elif any(isinstance(event, CloudDropped) for event in events):
            self._forget_missing()
        return events

    def _forget_missing(self) -> None:
        """Pairs and a selection cannot name views that are gone."""
        held = set(self.views())
        for number in [n for n, p in self.pairs.items() if not {p.view_a, p.view_b} <= held]:
            del self.pairs[number]
        if self._selection is not None:
            self._selection = tuple(i for i in self._selection if i in held) or None

    def due(self, every_deg: float) -> bool:
        """Whether the rotation, not complete, has come far enough for an early look.

        Parameters
        ----------
        every_deg : float
            Angle between two looks, deg; 0: none.
        """
        state = self.buffer.state()
        return (
            every_deg > 0.0
            and not self.enough
            and state.stage is Stage.GATHERING
            and len(state.view_ids) >= self.buffer.min_views
            and state.angle_covered_rad - self._looked_rad >= math.radians(every_deg) - 1e-6
        )

    def looked(self) -> None:
        """An early look begins."""
        self._looked_rad = self.buffer.state().angle_covered_rad

    # ---- views

    def views(self) -> dict[int, View]:
        """Views by id."""
        return {view.view_id: view for view in self.buffer.views()}

    def selected(self) -> tuple[int, ...]:
        """Ids of the views that the next flattening uses."""
        return self._selection if self._selection is not None else tuple(self.views())

    def select(self, ids: Sequence[int]) -> tuple[int, ...]:
        """Choose the views of the next flattening; none: automatic. Raises Refused."""
        self._selection = self._known(ids) or None
        return self.selected()

    def clear_views(self, ids: Sequence[int]) -> tuple[int, list[int], tuple[Event, ...]]:
        """Remove views. Number removed, unknown ids, events."""
        _check_count(ids)
        held = self.views()
        unknown = [i for i in dict.fromkeys(ids) if i not in held]
        events = self._noted(self.buffer.clear_views([i for i in ids if i in held]))
        return len(held) - len(self.views()), unknown, events

    def _known(self, ids: Sequence[int]) -> tuple[int, ...]:
        _check_count(ids)
        held = self.views()
        unknown = [i for i in ids if i not in held]
        if unknown:
            raise Refused(
                UNKNOWN_VIEW, f"view {unknown[0]} is not in the buffer; views held: {_listed(held)}"
            )
        return tuple(dict.fromkeys(int(i) for i in ids))

    # ---- corresponding points

    def add_pairs(self, pairs: Iterable[Mapping[str, Any]]) -> list[tuple[int, str]]:
        """Check and keep pairs of vflatten_ros/Correspondence fields: id (0: refused), reason."""
        views, held = self.views(), set(map(_places, self.pairs.values()))
        return [self._add_pair(pair, views, held) for pair in pairs]

    def _add_pair(
        self, fields: Mapping[str, Any], views: Mapping[int, View], held: set[Places]
    ) -> tuple[int, str]:
        if len(self.pairs) >= MAX_PAIRS:
            return 0, f"there are {MAX_PAIRS} pairs already; clear some"
        reach_px = self.buffer.config.integration.pair_reach_px
        try:
            pair = messages.correspondence_from_fields(fields, views, reach_px)
        except InvalidCorrespondence as error:
            return 0, str(error)
        if _places(pair) in held:
            return 0, "the same pair is already there"
        held.add(_places(pair))
        self.pairs[self._next_pair] = pair
        self._next_pair += 1
        return self._next_pair - 1, ""

    def clear_pairs(self, ids: Sequence[int]) -> tuple[int, list[int]]:
        """Remove pairs, all if no ids. Number removed, unknown ids."""
        _check_count(ids)
        wanted = list(dict.fromkeys(ids)) or list(self.pairs)
        unknown = [i for i in wanted if i not in self.pairs]
        removed = sum(self.pairs.pop(i, None) is not None for i in wanted)
        return removed, unknown

    # ---- flattening

    def task(self, config: Config, method: str = "", ids: Sequence[int] = ()) -> Task:
        """What to flatten now. Raises Refused."""
        if method and method not in METHODS:
            raise Refused(
                UNKNOWN_NAME,
                f"method {method[:60]!r} does not exist; methods: {', '.join(METHODS)}",
            )
        if method:
            config = dataclasses.replace(config, method=method)
        held = self.views()
        chosen = self._known(ids) or self.selected()
        if not chosen:
            raise Refused(NO_VIEWS, "the buffer holds no views; turn the item before the rig first")
        if config.method == "rotation" and len(chosen) < 2:
            raise Refused(
                NO_VIEWS,
                f"method rotation needs two views or more, got {len(chosen)}; turn the item, or "
                "select more of the views held",
            )
        kept = set(chosen)
        pairs = [self.pairs[i] for i in sorted(self.pairs)]
        pairs = [pair for pair in pairs if {pair.view_a, pair.view_b} <= kept]
        item = self.buffer.state().item
        return Task(tuple(held[i] for i in chosen), tuple(pairs), config, item)


def _places(pair: Correspondence) -> Places:
    """What a pair joins, whichever side is named first and whoever gave it."""
    return frozenset({(pair.view_a, pair.pixel_a), (pair.view_b, pair.pixel_b)})


def _check_count(ids: Sequence[int]) -> None:
    if len(ids) > MAX_IDS:
        raise Refused(
            INVALID_ARGUMENT, f"{len(ids)} ids in one request; at most {MAX_IDS} are read"
        )


def _listed(ids: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(ids))) or "none"
