"""How fat stereo makes the edges of what is in front, as other views tell.

Stereo matches blocks, and so gives pixels beside an edge the depth of what is in front. Where a
fold ends the item for one view, those pixels hang in the air beside it, and a view from farther
round, which sees the fold from the front, says so. Where a hem ends it, nothing tells; but edges
are fat all round or not at all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.edges import MOST_PX
from vflatten_ros.core.geometry import inverse, transform_points
from vflatten_ros.core.registration import NORMAL_MAD, ViewSurface
from vflatten_ros.core.values import Float, Int, Notice

REACH_M = 0.008  # from a pixel beside an edge to where another view sees the cloth
ROUND_RAD = np.radians(25.0)  # least angle between two views of which one sees the other's folds
OUT_PITCHES = 0.4  # how far such pixels stand out at least: distances of neighbouring points
OUT_SPREADS = 1.1  # and standard deviations of what is no edge
ALIKE = 0.45  # share of that by which those farther in do, if the edge is as fat
FEWEST = 100  # pixels at one distance from an edge, of all views
LOOKED_AT = 150  # pixels of one view at one distance from an edge


def fat_px(
    surfaces: Sequence[ViewSurface],
    poses: Sequence[Float],
    to_edge: Sequence[Int],
    config: RotationConfig,
    pitch_m: float,
) -> int:
    """By how many pixels edges are fat: what hangs in the air for views from farther round.

    Parameters
    ----------
    surfaces : sequence of ViewSurface
    poses : sequence of ndarray of shape (4, 4)
        Result of register_views for them.
    to_edge : sequence of ndarray of shape (n,)
        Result of pixels_to_edge for the points of each surface.
    config : RotationConfig
    pitch_m : float
        Between neighbouring points.

    Returns
    -------
    int
        0 to MOST_PX; 0 if too little tells.
    """
    inside = _standing_out(surfaces, poses, to_edge, MOST_PX + 1, config)
    if len(inside) < FEWEST:
        return 0
    spread = NORMAL_MAD * float(np.median(np.abs(inside)))
    out = [_standing_out(surfaces, poses, to_edge, 1, config)]
    if len(out[0]) < FEWEST or np.median(out[0]) < max(OUT_PITCHES * pitch_m, OUT_SPREADS * spread):
        return 0
    out += [_standing_out(surfaces, poses, to_edge, px, config) for px in range(2, MOST_PX + 1)]
    first = float(np.median(out[0]))
    told = [len(each) >= FEWEST and bool(np.median(each) > ALIKE * first) for each in out]
    return 1 + int(np.flatnonzero(told).max())


def notice_of(px: int) -> Notice:
    """Says that edges were fat."""
    return Notice(
        "fat_edges",
        f"edges are fat by {px} pixel{'s' * (px > 1)}, as stereo makes them: taken off; "
        f"{px} more in segmentation.trim_px does so as views arrive, and sooner",
    )


def _standing_out(
    surfaces: Sequence[ViewSurface],
    poses: Sequence[Float],
    to_edge: Sequence[Int],
    px: int,
    config: RotationConfig,
) -> Float:
    """How far points `px` pixels from an edge are in front of what other views see well there.

    With MOST_PX + 1, points that are no nearer to one.
    """
    found = [np.zeros(0)]
    for surface, pose, near_edge in zip(surfaces, poses, to_edge, strict=True):
        rows = np.flatnonzero(near_edge == px)
        rows = rows[:: max(1, len(rows) // LOOKED_AT)]
        at = transform_points(pose, surface.points[rows])
        for other, its_pose, its_edge in zip(surfaces, poses, to_edge, strict=True):
            turned = abs((other.angle_rad - surface.angle_rad + np.pi) % (2 * np.pi) - np.pi)
            if not ROUND_RAD < turned <= np.radians(config.overlap_deg) + 1e-6:
                continue
            seen = transform_points(inverse(its_pose), at)
            away, near = other.tree.query(seen, distance_upper_bound=REACH_M)
            there = np.flatnonzero(np.isfinite(away))
            there = there[its_edge[near[there]] > MOST_PX]
            near = near[there]
            found.append(((seen[there] - other.smooth[near]) * other.normals[near]).sum(axis=1))
    return np.concatenate(found)
