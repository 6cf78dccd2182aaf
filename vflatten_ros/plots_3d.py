"""The parts of figures that are drawn in space: geodesic lines on a cloud, the hanging item."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vflatten_ros.core.geometry import R_VIEW_HANGER0, transform_points
from vflatten_ros.core.values import FlatGarment, Float, View
from vflatten_ros.plots import BLUE, CM, FLAT_COLOURS, ORANGE, VERMILION

DOTS_3D = 9000
LINES_SHOWN = 40


def draw_lines(ax: Any, garment: FlatGarment, view: View | None, cloud: Float, chosen: Any) -> None:
    """Lines over a cloud. Drawn axes: x right, depth away from the rig, y up."""
    axes = CM * np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # view -> drawn
    x, depth, y = (cloud[:: max(1, len(cloud) // DOTS_3D)] @ axes).T
    ax.scatter(x, depth, y, s=0.8, c="#A5A5A5", alpha=0.4, linewidths=0, depthshade=False)
    for i in _long_ones(garment, chosen):
        nodes = hanging(garment.lines.nodes_hanger[i], view) @ axes
        colour = ORANGE if garment.lines.flagged[i] else VERMILION
        ax.plot(*nodes.T, color=colour, lw=1.6)
        ax.plot(*nodes[[0, -1]].T, color=BLUE, marker=".", ls="none", ms=5)
    spans = np.maximum([np.ptp(x), np.ptp(depth), np.ptp(y)], 1.0)
    ax.set_box_aspect(spans, zoom=1.0)
    ax.view_init(elev=14, azim=-62)
    for axis, name, span in zip(
        (ax.xaxis, ax.yaxis, ax.zaxis), ("x", "depth", "y"), spans, strict=True
    ):
        axis.set_major_locator(MaxNLocator(max(2, round(6 * span / spans.max()))))
        axis.set_label_text(f"{name} (cm)")
        axis.labelpad = 16 if name == "y" else 6
        axis.set_tick_params(pad=6 if name == "y" else 2)


def draw_hanging(figure: Figure, garment: FlatGarment) -> None:
    """Where no lines were kept: the hanging points from two sides, coloured by their flat place."""
    figure.set_size_inches(9.2, 6.2)
    seen = garment.points.view_id >= 0
    step = max(1, int(seen.sum()) // DOTS_3D)
    x, y, z = CM * garment.points.xyz_hanger[seen][::step].T
    for k, side in enumerate((0, 180)):
        ax: Any = figure.add_subplot(1, 2, k + 1, projection="3d")
        u = garment.points.uv[seen][::step, 0]
        ax.scatter(x, y, z, s=2, c=u, cmap=FLAT_COLOURS, linewidths=0, depthshade=False)
        ax.set_box_aspect([max(float(np.ptp(v)), 1.0) if len(v) else 1.0 for v in (x, y, z)])
        ax.view_init(elev=14, azim=side)
        ax.set_axis_off()
        ax.set_title(f"hanging, from {side}°; colour: u when flat")


def _long_ones(garment: FlatGarment, chosen: Any) -> Any:
    """Some of the longer half of the lines, evenly spread over their order."""
    length = garment.lines.length_m[chosen]
    longer = chosen[length >= np.median(length)] if len(chosen) else chosen
    return longer[:: max(1, -(-len(longer) // LINES_SHOWN))]


def hanging(nodes_hanger: Float, view: View | None) -> Float:
    """Hanger frame to the view frame as a view sees the item, or at item angle 0."""
    if view is None:
        return nodes_hanger @ R_VIEW_HANGER0.T
    calibration = view.calibration
    return transform_points(
        calibration.T_view_rig @ calibration.T_rig_hanger(view.angle_rad), nodes_hanger
    )
