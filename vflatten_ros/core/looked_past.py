"""Points where there is nothing, as other views tell that look past them.

Stereo finds depths where there is nothing to match, makes edges fat and ragged, and bridges steps
of depth. What hangs in the air so in one view, the other views look past, at cloth behind it or at
nothing; where there is cloth, most of them see it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from vflatten_ros.core.geometry import inverse, transform_directions, transform_points
from vflatten_ros.core.parallel import mapped
from vflatten_ros.core.registration import ViewSurface
from vflatten_ros.core.sight import PlacedSight, Sight
from vflatten_ros.core.values import Bool, Float, Int, Notice

PAST_M = 0.004  # behind a point, from which on a view looks past it
PAST_SPREADS = 3.0  # or so many standard deviations of surfaces of different views
FACING = 0.3  # least cosine between the normal and the direction to a camera that may see a point
FEWEST = 2  # views that look past a point with nothing there
MOST = 0.5  # share of the views that tell, above which it is one
FARTHEST_M = 1e9  # beyond any item: a view shows nothing there
LOOKED_AT = 20  # every so many-th point tells how many there are
NOTED = 0.002  # share of such points that fits of the surface bear
TOO_MANY = 0.3  # share above which it is the views that do not fit together
FEWEST_LEFT = 100  # points of a view


def kept_rows(
    surfaces: Sequence[ViewSurface], poses: Sequence[Float], apart_m: float
) -> tuple[float, list[Int]]:
    """Rows of each view's points without those where there is nothing, if that is worth while.

    Parameters
    ----------
    surfaces : sequence of ViewSurface
    poses : sequence of ndarray of shape (4, 4)
    apart_m : float
        As looked_past.

    Returns
    -------
    share : float
        Of the points, that is looked past; 0 if it is so small that fits bear it, or so large that
        the views do not fit together: then all are to be kept.
    rows : list of ndarray of shape (n,)
        Of the points of each view; all that its surface has, if hardly any were left.
    """
    if not NOTED <= share_looked_past(surfaces, poses, apart_m) <= TOO_MANY:
        return 0.0, []
    past = looked_past(surfaces, poses, apart_m)
    rows = [
        s.index[~gone] if (~gone).sum() >= FEWEST_LEFT else s.index
        for s, gone in zip(surfaces, past, strict=True)
    ]
    return float(np.concatenate(past).mean()), rows


def share_looked_past(
    surfaces: Sequence[ViewSurface], poses: Sequence[Float], apart_m: float
) -> float:
    """About which share of the points is looked past; as looked_past."""
    found = looked_past(surfaces, poses, apart_m, every=LOOKED_AT)
    return float(np.concatenate(found).mean())


def looked_past(
    surfaces: Sequence[ViewSurface], poses: Sequence[Float], apart_m: float, every: int = 1
) -> list[Bool]:
    """Which points of each view most other views look past, of those that see the place.

    What a view shows nothing of, all round which it shows the item, may be a hole in its depth:
    that tells nothing.

    Parameters
    ----------
    surfaces : sequence of ViewSurface
        None of them of a cloud that is not a camera's.
    poses : sequence of ndarray of shape (4, 4)
        Result of register_views for them.
    apart_m : float
        Standard deviation of overlapping views' surfaces from each other.
    every : int
        Only every so many-th point.

    Returns
    -------
    list of ndarray of shape (n,), bool
        For every `every`-th point of each surface.
    """
    margin_m = max(PAST_M, PAST_SPREADS * apart_m)
    images = [surface.sight for surface in surfaces if surface.sight is not None]
    sights = [
        PlacedSight(sight, pose)
        for sight, pose in zip(mapped(_without_holes, images), poses, strict=True)
    ]

    def of_view(k: int) -> Bool:
        at = transform_points(poses[k], surfaces[k].points[::every])
        normal = transform_directions(poses[k], surfaces[k].normals[::every])
        past, there = np.zeros(len(at)), np.zeros(len(at))
        for j, placed in enumerate(sights):
            if j == k:
                continue
            facing = placed.facing(at, normal, FACING)
            behind = placed.sight.behind(transform_points(inverse(placed.T_common_view), at))
            past += facing & (behind > margin_m)
            there += facing & (np.abs(behind) <= margin_m)
        found: Bool = (past >= FEWEST) & (past > MOST * (past + there))
        return found

    return list(mapped(of_view, range(len(surfaces))))


def _without_holes(sight: Sight) -> Sight:
    """With no depth, in place of an infinite one, where what shows nothing is closed in."""
    nothing = (sight.depth > FARTHEST_M).astype(np.uint8)
    nothing = cv2.copyMakeBorder(nothing, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(1,))
    label = cv2.connectedComponents(nothing, connectivity=4)[1]
    hole = ((nothing > 0) & (label != label[0, 0]))[1:-1, 1:-1]
    return replace(sight, depth=np.where(hole, np.float32(np.nan), sight.depth))


def notice_of(share: float) -> Notice:
    """Says that points were taken away."""
    return Notice(
        "looked_past",
        f"{share:.1%} of the points lie where other views see nothing, as stereo finds depths by "
        "chance beside edges and where nothing is to match: taken away",
    )
