"""What happens to clouds, views and items, as the view buffer reports it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

DROP_REASONS: Mapping[str, str] = {
    "no_joint_state": "no state of the wrist joint came in time",
    "too_old": "the joint states nearest to the cloud's stamp are too far from it",
    "time_went_backwards": "the cloud's stamp is not after the cloud before it",
    "empty_after_segmentation": "no item was seen below the gripper",
    "wrist_moving_too_fast": "the wrist turned faster than buffer.max_rate_rad_s",
    "item_swinging": "the item had moved when it was seen again at the same angle",
    "buffer_full": "the buffer was full, and its neighbours in angle were nearest",
    "wrong_frame": "the cloud's frame is not the calibration's",
    "duplicate_angle": "a better view was taken at nearly the same angle",
    "invalid_cloud": "the message contradicts itself",
    "gripper_open": "the fingers were open",
    "previous_item": "the cloud was taken before the present item was held, or the clock set back",
    "cleared": "removed on request",
}

REMEDIES: Mapping[str, str] = {
    "no_joint_state": "check the joint in the calibration and the topic of the joint states",
    "too_old": "send joint states faster, or synchronise the clocks of camera and robot",
    "time_went_backwards": "let one publisher only send clouds, with a clock that does not jump",
    "empty_after_segmentation": "check the calibration and segmentation.*",
    "wrist_moving_too_fast": "turn slower, or raise buffer.max_rate_rad_s",
    "item_swinging": "wait longer after picking up; check that the joint in the calibration turns",
    "buffer_full": "raise buffer.max_views, max_megabytes or max_waiting",
    "wrong_frame": "correct the frame in the calibration or in the camera driver",
    "invalid_cloud": "correct the camera driver",
}

CLOCK_SET_BACK = "the clock was set back"  # a cause of ItemStarted


@dataclass(frozen=True)
class ViewAdded:
    """A cloud became a view."""

    view_id: int
    angle_rad: float
    points: int


@dataclass(frozen=True)
class ViewReplaced:
    """A better view at nearly the same angle took another's place."""

    view_id: int
    replaced_id: int


@dataclass(frozen=True)
class CloudDropped:
    """A cloud gave no view, or its view was removed."""

    view_id: int
    reason: str  # a key of DROP_REASONS
    text: str


@dataclass(frozen=True)
class ItemStarted:
    """The views of the item before are gone."""

    item: int
    cause: str


@dataclass(frozen=True)
class RotationComplete:
    """The views cover the whole turn."""

    views: int
    angle_covered_rad: float


@dataclass(frozen=True)
class ClockJumped:
    """Stamps went back: everything before is forgotten."""

    from_ns: int
    to_ns: int


@dataclass(frozen=True)
class WristStill:
    """Clouds come and the wrist joint stays where it is; once for an item."""

    moved_rad: float
    clouds: int


Event = (
    ViewAdded
    | ViewReplaced
    | CloudDropped
    | ItemStarted
    | RotationComplete
    | ClockJumped
    | WristStill
)


class Stage(Enum):
    """How far the present item is; numbers as in msg/ViewBufferState."""

    WAITING = 0
    GATHERING = 1
    COMPLETE = 2


@dataclass(frozen=True)
class BufferState:
    """Summary of the buffer at one moment."""

    stage: Stage
    item: int  # from 1
    view_ids: tuple[int, ...]
    angle_covered_rad: float  # 0 to 2 pi
    nbytes: int
    clouds_received: int  # = views + clouds_waiting + sum(drops)
    clouds_waiting: int
    drops: Mapping[str, int]  # reason -> clouds, reasons that occurred, sorted
    joint_states: int  # samples of the wrist joint kept
    joints_seen: tuple[str, ...]  # names of all joints that came, sorted
    clock_jumps: int  # since the start
    recent: tuple[str, ...] = ()  # of each of the last clouds: "" or why it was dropped
    still: WristStill | None = None  # while the wrist joint has not moved
    joint_faults: int = 0  # joint states that name the wrist and give no position, since the start
    joint_fault: str = ""  # what was wrong with the newest, if that is one of them
