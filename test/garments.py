"""A flattened garment with a known answer: a towel bent round a vertical cylinder, seen twice.

0.30 x 0.50 m, radius 0.12 m. The flat place of a point is (radius times angle, height) exactly.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from vflatten_ros.core.geometry import transform_points
from vflatten_ros.core.values import (
    Calibration,
    Correspondence,
    FlatGarment,
    FlatPoints,
    GeodesicLines,
    Landmark,
    Measurement,
    Notice,
    Outline,
    View,
)

RADIUS_M, WIDTH_M, HEIGHT_M, BELOW_TIP_M = 0.12, 0.30, 0.50, 0.03
SHAPE = (480, 360)
FOCAL = 520.0
FIRST_NS = 1_700_000_000_000_000_000

CALIBRATION = Calibration(
    frame="rig_optical",
    axis_point=(0.0, -0.5, 1.3),
    axis_direction=(0.0, -1.0, 0.0),
    gripper_tip=(0.0, -0.5, 1.3),
    joint="wrist_roll",
    joint_sign=-1.0,
    joint_zero_rad=0.3,
)


def hang(uv: np.ndarray) -> np.ndarray:
    """(n, 2) flat places -> (n, 3) places on the cylinder, hanger frame."""
    angle = uv[:, 0] / RADIUS_M
    return np.c_[RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), uv[:, 1] - BELOW_TIP_M]


def example_view(view_id: int, angle_rad: float) -> View:
    """The pixels of the towel that face the rig at an item angle."""
    u, v = np.meshgrid(
        np.linspace(-WIDTH_M / 2, WIDTH_M / 2, 200), np.linspace(-HEIGHT_M, 0.0, 300)
    )
    points_hanger = hang(np.c_[u.ravel(), v.ravel()])
    T_rig_hanger = CALIBRATION.T_rig_hanger(angle_rad)
    rig = transform_points(T_rig_hanger, points_hanger)
    axis = transform_points(T_rig_hanger, points_hanger * [0.0, 0.0, 1.0])
    facing = ((rig - axis) * -rig).sum(axis=1) > 0.2 * RADIUS_M * np.linalg.norm(rig, axis=1)
    rig = rig[facing]
    pixel = np.rint(
        FOCAL * rig[:, [1, 0]] / rig[:, 2:] + [(SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2]
    ).astype(np.int32)
    _, first = np.unique(pixel[:, 0] * SHAPE[1] + pixel[:, 1], return_index=True)
    shade = (rig[first, 1] * 400 % 60 + 120).astype(np.uint8)
    return View(
        view_id=view_id,
        stamp_ns=FIRST_NS + view_id * 500_000_000,
        angle_rad=angle_rad,
        points_rig=rig[first],
        pixel=pixel[first],
        rgb=np.stack([shade // 2, shade, shade], axis=1),
        shape=SHAPE,
        calibration=CALIBRATION,
    )


def example_views() -> list[View]:
    """Two views, 80 degrees apart."""
    return [example_view(2, np.radians(-40.0)), example_view(5, np.radians(40.0))]


def flat_of(view: View, index: np.ndarray) -> np.ndarray:
    """(n, 2) true flat places of some points of a view."""
    x, y, z = view.points_hanger[index].T
    return np.c_[RADIUS_M * np.arctan2(y, x), z + BELOW_TIP_M]


def example_garment(views: list[View] | None = None) -> FlatGarment:
    """The towel flattened without error; its lower left corner is inferred."""
    views = views or example_views()
    picked = [np.arange(0, len(view.points_rig), 97) for view in views]
    uv = np.concatenate([flat_of(view, i) for view, i in zip(views, picked, strict=True)])
    points = FlatPoints(
        uv=uv,
        xyz_hanger=np.concatenate(
            [view.points_hanger[i] for view, i in zip(views, picked, strict=True)]
        ),
        view_id=np.concatenate(
            [np.full(len(i), view.view_id) for view, i in zip(views, picked, strict=True)]
        ),
        pixel=np.concatenate(
            [view.pixel[i].astype(np.int64) for view, i in zip(views, picked, strict=True)]
        ),
        sigma_m=np.full(len(uv), 0.002),
        stress=np.full(len(uv), 0.001),
        inferred=np.zeros(len(uv), dtype=bool),
    )
    outline = _outline()
    return FlatGarment(
        method="kita2019",
        view_ids=tuple(view.view_id for view in views),
        stamp_ns=max(view.stamp_ns for view in views),
        points=points,
        start_uv=points.xyz_hanger[:, 1:],
        lines=_lines(views),
        outline=outline,
        category="towel",
        scores={"shorts": 0.35, "towel": 0.81, "trousers": 0.42},
        score_kind="R",
        template_uv=outline.uv * 1.02,
        measurements=(
            Measurement("length", 0.50, 0.004, True, ((0.0, -HEIGHT_M), (0.0, 0.0))),
            Measurement("width", 0.30, 0.003, False, ((-0.15, -0.25), (0.15, -0.25))),
        ),
        landmarks=_landmarks(),
        calibration=views[0].calibration,
        correspondences=_correspondences(views),
        coverage=0.93,
        quality=0.8,
        notices=(Notice("length_unseen", "the lower left corner is in no view"),),
    )


def _outline() -> Outline:
    corners = np.array([[-0.5, -1.0], [0.5, -1.0], [0.5, 0.0], [-0.5, 0.0], [-0.5, -1.0]])
    corners *= [WIDTH_M, HEIGHT_M]
    share = np.linspace(0.0, 1.0, 20, endpoint=False)[:, None]
    sides = [a + share * (b - a) for a, b in pairwise(corners)]
    uv = np.concatenate(sides)
    inferred = np.linalg.norm(uv - corners[0], axis=1) < 0.06
    return Outline(uv=uv, sigma_m=np.where(inferred, 0.02, 0.002), inferred=inferred)


def _lines(views: list[View]) -> GeodesicLines:
    """Horizontal lines, four per view; the last is flagged."""
    spans = {views[0].view_id: (-0.02, 0.14), views[1].view_id: (-0.14, 0.02)}
    heights = np.linspace(-0.45, -0.05, 4)
    nodes = [
        hang(np.c_[np.linspace(*span, 15), np.full(15, height)])
        for span in spans.values()
        for height in heights
    ]
    return GeodesicLines(
        nodes_hanger=np.array(nodes),
        view_id=np.repeat(list(spans), 4),
        length_m=np.full(8, 0.16),
        sigma_m=np.full(8, 0.001),
        flagged=np.arange(8) == 7,
    )


def _landmarks() -> tuple[Landmark, ...]:
    flat = np.array([[-WIDTH_M / 2, 0.0], [WIDTH_M / 2, 0.0], [-WIDTH_M / 2, -0.4]])
    left, right, lowest = (tuple(float(v) for v in row) for row in hang(flat))
    return (
        Landmark("left_top_corner", (-0.15, 0.0), 0.003, left, 0.004, (5,), 0.9),  # type: ignore[arg-type]
        Landmark("right_top_corner", (0.15, 0.0), 0.003, right, 0.004, (2,), 0.9),  # type: ignore[arg-type]
        Landmark("left_bottom_corner", (-0.15, -0.5), 0.02, lowest, 0.102, (), 0.2),  # type: ignore[arg-type]
    )


def _correspondences(views: list[View]) -> tuple[Correspondence, ...]:
    """The pixels nearest to three places on the middle line."""
    places = hang(np.array([[0.0, -0.1], [0.0, -0.25], [0.0, -0.4]]))
    sides = []
    for view in views:
        gaps = np.linalg.norm(view.points_hanger[:, None] - places, axis=-1)
        sides.append([tuple(int(v) for v in view.pixel[i]) for i in gaps.argmin(axis=0)])
    return tuple(
        Correspondence(views[0].view_id, views[1].view_id, a, b)  # type: ignore[arg-type]
        for a, b in zip(*sides, strict=True)
    )
