"""The values that pass between the stages. All are frozen; arrays are never edited in place.

Frames are defined in vflatten_ros.core.geometry. Metres, radians, nanoseconds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.geometry import (
    R_VIEW_HANGER0,
    inverse,
    rigid,
    rotation_about,
    transform_points,
)

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Byte = NDArray[np.uint8]

Progress = Callable[[str, float], None]
"""Called as progress(stage, fraction) at least every 50 ms of work; may raise Cancelled."""


def no_progress(stage: str, fraction: float) -> None:
    """A progress callback that does nothing."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """One decoded point cloud."""

    stamp_ns: int
    frame_id: str
    xyz: NDArray[
        np.float32
    ]  # (rows, cols, 3), rig frame, NaN where unmeasured; rows = 1: unorganised
    rgb: Byte | None  # (rows, cols, 3), 0-255; None: the cloud has no colour

    @property
    def organised(self) -> bool:
        """Whether neighbours in the array are neighbours in the image."""
        return self.xyz.shape[0] > 1


@dataclass(frozen=True)
class Calibration:
    """Where the wrist axis is and how the joint turns the item."""

    frame: str  # frame_id of the clouds
    axis_point: tuple[float, float, float]  # a point of the wrist axis, rig frame
    axis_direction: tuple[float, float, float]  # unit, upwards, rig frame
    gripper_tip: tuple[float, float, float]  # where the item is held, rig frame
    joint: str  # name of the wrist joint in JointState
    joint_sign: float  # +1 or -1
    joint_zero_rad: float

    def item_angle_rad(self, joint_rad: float) -> float:
        """Item angle about axis_direction, right-handed, at a joint position."""
        return self.joint_sign * (joint_rad - self.joint_zero_rad)

    def T_rig_hanger(self, angle_rad: float) -> Float:
        """Hanger frame (at this item angle) to rig frame."""
        up = np.array(self.axis_direction)
        to_rig = -np.array(self.axis_point)
        toward = to_rig - (to_rig @ up) * up
        toward /= np.linalg.norm(toward)
        at_zero = np.stack([toward, np.cross(up, toward), up], axis=1)  # columns: hanger x, y, z
        turn = rotation_about(up, angle_rad)
        point = np.array(self.axis_point)
        tip = point + turn @ (np.array(self.gripper_tip) - point)
        return rigid(turn @ at_zero, tip)

    @property
    def T_view_rig(self) -> Float:
        """Rig frame to the standing view frame of the paper."""
        T_hanger0_rig = inverse(self.T_rig_hanger(0.0))
        return rigid(R_VIEW_HANGER0, np.zeros(3)) @ T_hanger0_rig


@dataclass(frozen=True, eq=False)
class View:
    """The item's points in one cloud, and the wrist angle at its stamp."""

    view_id: int  # index of the cloud in order of arrival, dropped clouds counted
    stamp_ns: int
    angle_rad: float  # item angle at the stamp, turns unwrapped
    points_rig: Float  # (n, 3), rig frame
    pixel: NDArray[np.int32]  # (n, 2) row, col in the cloud; row 0 where unorganised
    rgb: Byte | None  # (n, 3)
    shape: tuple[int, int]  # rows, cols of the cloud
    calibration: Calibration

    @property
    def points_hanger(self) -> Float:
        """(n, 3) points in the item's own frame, by the wrist angle alone."""
        return transform_points(
            inverse(self.calibration.T_rig_hanger(self.angle_rad)), self.points_rig
        )

    @property
    def points_view(self) -> Float:
        """(n, 3) points in the paper's frame: x right, y up, z towards the rig."""
        return transform_points(self.calibration.T_view_rig, self.points_rig)

    @property
    def nbytes(self) -> int:
        """Memory held by the arrays, bytes."""
        colour = 0 if self.rgb is None else self.rgb.nbytes
        return self.points_rig.nbytes + self.pixel.nbytes + colour


@dataclass(frozen=True)
class Correspondence:
    """One point of the cloth seen in two views."""

    view_a: int  # view_id
    view_b: int
    pixel_a: tuple[int, int]  # row, col
    pixel_b: tuple[int, int]
    manual: bool = True
    confidence: float = 1.0  # 0-1


@dataclass(frozen=True, eq=False)
class DistanceNetwork:
    """Distances along the cloth between pairs of points; pairs that are left out are unknown."""

    i: Int  # (m,) first point
    j: Int  # (m,) second point
    distance_m: Float  # (m,)
    sigma_m: Float  # (m,) one standard deviation
    bound: Bool  # (m,) True: at most this far apart, for a path that had to bend


@dataclass(frozen=True, eq=False)
class FlatPoints:
    """Points of the cloth: where they hang and where they lie when the item is flat."""

    uv: Float  # (n, 2), flat frame
    xyz_hanger: Float  # (n, 3), hanger frame
    view_id: Int  # (n,), -1: in no view
    pixel: Int  # (n, 2) row, col in that view; -1 in no view
    sigma_m: Float  # (n,) one standard deviation of uv per axis
    stress: Float  # (n,) rms misfit of the distances at the point, metres
    inferred: Bool  # (n,) True: placed by the category's template, not seen
    astray_m: Float | None = None  # (n,) how far off what is there may hang: see `turned_over`


@dataclass(frozen=True, eq=False)
class GeodesicLines:
    """Shortest paths along the cloth, for figures and markers."""

    nodes_hanger: Float  # (lines, nodes, 3)
    view_id: Int  # (lines,)
    length_m: Float  # (lines,)
    sigma_m: Float  # (lines,)
    flagged: Bool  # (lines,) True: crosses a jump or missing data


@dataclass(frozen=True, eq=False)
class Outline:
    """Closed outline of the flattened item, counter-clockwise, last point not repeated."""

    uv: Float  # (k, 2), flat frame
    sigma_m: Float  # (k,)
    inferred: Bool  # (k,) True: not seen to end so; once recognised, it is the category's


@dataclass(frozen=True, eq=False)
class FlatSurface:
    """All observed points of a flattened piece of cloth, and the small squares between them."""

    uv: Float  # (n, 2), flat frame
    xyz_hanger: Float  # (n, 3)
    edge: Bool  # (n,) False: the cloth goes on unseen beside the point
    cells: Int  # (m, 4) points around every square


@dataclass(frozen=True, eq=False)
class FlatPiece:
    """Cloth that lies in one piece; its place beside other pieces is not known."""

    points: FlatPoints
    start_uv: Float  # (n, 2) where its flattening started, rows as points
    surface: FlatSurface


@dataclass(frozen=True)
class ViewShare:
    """What one view shows of all cloth that any view shows, as shares of it."""

    view_id: int
    shows: float
    only: float  # that no other view shows
    first: float  # that no view of a smaller id shows


@dataclass(frozen=True)
class Coverage:
    """What the views show of the item, and from where more would be seen."""

    shares: tuple[ViewShare, ...]  # by view_id
    unseen_share: float  # of the ends of what was seen, beyond which cloth goes on
    open_share: float  # the same, where no view was taken from where that would be seen
    turn_to_rad: float | None  # item angle, 0 to 2 pi, that promises most; None: all were tried


@dataclass(frozen=True)
class Unseen:
    """Cloth that matters is in no view."""

    turn_to_rad: float | None  # item angle, 0 to 2 pi, that shows it best; None: turning cannot


@dataclass(frozen=True, eq=False)
class Flattened:
    """What a method makes of the views, before the category is known."""

    points: FlatPoints
    start_uv: Float | None  # (n, 2) where the flattening started, rows as points
    lines: GeodesicLines
    outline: Outline
    correspondences: tuple[Correspondence, ...]  # that were used
    notices: tuple[Notice, ...]
    pieces: tuple[FlatPiece, ...] = field(
        default=()
    )  # the largest is the outline's; others are loose
    seen: Coverage | None = None  # None: not known
    outline_sigma_m: float = 0.0  # error that a whole edge shares, beside that of its points
    size_sigma: float = 0.0  # error of a length, as a share of it, beside those
    calibration: Calibration | None = None  # of the hanger frame; None: that of the views


@dataclass(frozen=True)
class Measurement:
    """One named size of the item laid flat."""

    name: str  # "width", "length", or one of the category's own
    value_m: float
    sigma_m: float
    inferred: bool  # True: rests on parts that no view shows
    ends_uv: tuple[tuple[float, float], tuple[float, float]] | None = (
        None  # flat frame, for drawing
    )


@dataclass(frozen=True)
class Landmark:
    """One named point of the item."""

    name: str
    uv: tuple[float, float]  # flat frame
    uv_sigma_m: float
    xyz_hanger: tuple[float, float, float] | None  # unseen: the nearest cloth seen; None: none was
    xyz_sigma_m: float
    views: tuple[int, ...]  # view_ids that show it, best first; none: unseen
    certainty: float  # 0-1

    @property
    def seen(self) -> bool:
        """Whether a view shows it."""
        return bool(self.views)


@dataclass(frozen=True)
class Notice:
    """Something that the user of a result should know."""

    code: str  # one of NOTICE_CODES in this module
    text: str


NOTICE_CODES: Mapping[str, str] = {
    "length_unseen": "a size rests on a part of the item that no view shows",
    "width_unseen": "a width rests on a part of the item that no view shows",
    "low_coverage": "much of the item was not seen",
    "hidden_crease": "a deep crease probably hides cloth",
    "category_uncertain": "two categories fit nearly as well",
    "ends_alike": "turned by half a turn the item looks the same: a towel's end at the gripper is "
    "called bottom, others' names may be exchanged",
    "solution_uncertain": "the item may lie otherwise, with another width or length",
    "turned_over": "a part may lie turned over: what is on it may be mistaken for its opposite",
    "correspondence_rejected": "a corresponding point contradicts the others",
    "coarse_points": "the points are noisier, or farther apart, than the method is set for",
    "smoothed_depth": "the depth was smoothed over, which joins layers: turn its filters off",
    "looked_past": "points where other views see nothing were taken away",
    "fat_edges": "stereo has made edges wider: what it added was taken off",
    "views_misplaced": "the views do not fit together, or a print on the cloth says so",
    "view_left_out": "a view shows too little of the item to be placed beside the others",
    "axis_off": "the item turned about another axis than the calibration has",
    "views_chosen": "which views the two-view method chose by itself",
    "high_stress": "the distances contradict each other more than noise explains",
    "unseen": "no view shows some cloth that matters: turn, or grasp elsewhere",
    "truncated": "the item reaches the border of the image",
    "untrusted": "the result should not be used for sizes",
}


@dataclass(frozen=True, eq=False)
class FlatGarment:
    """What the item would look like laid flat, and how sure that is."""

    method: str
    view_ids: tuple[int, ...]
    stamp_ns: int  # newest view
    points: FlatPoints
    start_uv: (
        Float | None
    )  # (n, 2) where the flattening started, rows as points; None: no single start
    lines: GeodesicLines
    outline: Outline
    category: str  # best category or "unknown"
    scores: Mapping[str, float]  # category -> score of the method (R of eq. 11, or probability)
    score_kind: str  # "R" or "probability"
    template_uv: Float  # (k, 2) the best category's outline fitted to the item; (0, 2) if unknown
    measurements: tuple[Measurement, ...]
    landmarks: tuple[Landmark, ...]
    correspondences: tuple[Correspondence, ...]
    coverage: float  # 0-1, share of the template's area that was seen
    quality: float  # 0-1, higher is better
    calibration: Calibration  # of the hanger frame: the axis about which the item turned
    notices: tuple[Notice, ...] = field(default=())
    shares: tuple[ViewShare, ...] = ()  # by view_id; empty: not known
    unseen: Unseen | None = None  # None: nothing that matters
    enough: bool = False  # further views would hardly change the answer

    @property
    def trusted(self) -> bool:
        """Whether it may be used for sizes."""
        return all(notice.code != "untrusted" for notice in self.notices)

    def measurement(self, name: str) -> Measurement | None:
        """The measurement of that name, None if it was not made."""
        return next((m for m in self.measurements if m.name == name), None)
