"""Ordered points on the boundary of the observed region of one view (paper, section 3, step 1)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.config import BoundaryConfig
from vflatten_ros.core.errors import InvalidInput
from vflatten_ros.core.values import Float, Int


@dataclass(frozen=True, eq=False)
class Boundary:
    """Points of one view that stand for its region: loops in order, then extra points inside."""

    source: Int  # (m,) row of the view's points, so its pixel is exact
    loop: Int  # (m,) number of the point's loop, in order along it; -1: inside the region


def boundary_points(place: Int, spacing: float, config: BoundaryConfig) -> Boundary:
    """Evenly spaced points along the outer boundary of the region, loop by loop.

    Parameters
    ----------
    place : ndarray of shape (n, 2)
        Row and column of every point of the view.
    spacing : float
        Metres across the view from one pixel to the next.
    config : BoundaryConfig

    Returns
    -------
    Boundary
        Loops of the region's separate parts, longest first; holes have none.

    Raises
    ------
    InvalidInput
        No points, or none with a boundary of four points or more.
    """
    if not len(place):
        raise InvalidInput("boundary: the view shows no point of the item")
    low = place.min(axis=0) - 2
    mask = np.zeros(np.ptp(place, axis=0) + 5, dtype=np.uint8)
    mask[tuple((place - low).T)] = 1
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    found, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    loops = [_evenly(c[:, 0, ::-1].astype(np.float64), config.spacing_m / spacing) for c in found]
    loops = sorted((p for p in loops if len(p) >= 4), key=lambda p: (-len(p), tuple(p[0])))
    if not loops:
        raise InvalidInput(
            f"boundary: the region of {len(place)} points has no boundary of 4 points "
            f"{config.spacing_m} m apart; lower boundary.spacing_m"
        )
    tree = cKDTree(place)
    rows, numbers = [], []
    for number, loop in enumerate(loops):
        nearest = tree.query(loop + low)[1]
        rows.append(nearest[np.sort(np.unique(nearest, return_index=True)[1])])
        numbers.append(np.full(len(rows[-1]), number))
    return Boundary(np.concatenate(rows), np.concatenate(numbers))


def _evenly(contour: Float, spacing: float) -> Float:
    """Points at about equal distances along a closed line of pixels."""
    closed = np.vstack([contour, contour[:1]])
    at = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))]
    count = round(float(at[-1]) / spacing)
    wanted = np.arange(count) * (at[-1] / max(count, 1))
    return np.column_stack([np.interp(wanted, at, column) for column in closed.T])


def with_corresponding(
    boundary: Boundary, place: Int, points: Int, spacing: float, config: BoundaryConfig
) -> tuple[Boundary, Int]:
    """Put corresponding points in the place of the nearest boundary points.

    Parameters
    ----------
    boundary : Boundary
    place : ndarray of shape (n, 2)
        Row and column of every point of the view.
    points : ndarray of shape (k,)
        Rows of the view's points.
    spacing : float
        Metres across the view from one pixel to the next.

    Returns
    -------
    boundary : Boundary
        Points farther than the spacing from the boundary, or nearest to one already replaced, are
        added as points inside the region.
    at : ndarray of shape (k,)
        Where each point is in it.
    """
    source, loop = boundary.source.copy(), boundary.loop.copy()
    taken = np.zeros(len(source), dtype=bool)
    extra: list[int] = []
    at = []
    for point in points:
        away = np.linalg.norm(place[source] - place[point], axis=1) * spacing
        nearest = int(np.where(taken, np.inf, away).argmin())
        if away[nearest] <= config.spacing_m and not taken[nearest]:
            source[nearest], taken[nearest] = point, True
            at.append(nearest)
        else:
            at.append(len(source) + len(extra))
            extra.append(int(point))
    inside = np.full(len(extra), -1, dtype=np.int64)
    return (
        Boundary(np.r_[source, np.array(extra, dtype=np.int64)], np.r_[loop, inside]),
        np.array(at, dtype=np.int64),
    )


def ring_pairs(loop: Int) -> tuple[Int, Int]:
    """Every point with its next and second-next along its loop.

    Returns
    -------
    i, j : ndarray of shape (m,)
    """
    first, second = [], []
    for number in range(int(loop.max(initial=-1)) + 1):
        rows = np.flatnonzero(loop == number)
        for ahead in (1, 2):
            if len(rows) > 2 * ahead:
                first.append(rows)
                second.append(np.roll(rows, -ahead))
    none = np.zeros(0, dtype=np.int64)
    return np.concatenate([none, *first]), np.concatenate([none, *second])


def level_pairs(height: Float, group: Int, window_m: float, most: int) -> tuple[Int, Int]:
    """Pairs of similar height, the most similar first: folds run vertically (paper, step 2).

    Parameters
    ----------
    height : ndarray of shape (n,)
        Metres.
    group : ndarray of shape (n,)
        Points of different groups make no pair.
    window_m : float
        Largest difference of height.
    most : int
        Every point starts at most so many of the pairs, spread over the window's other points.

    Returns
    -------
    i, j : ndarray of shape (m,), i < j, sorted
    """
    i, j = np.triu_indices(len(height), 1)
    off = np.abs(height[i] - height[j])
    near = (off <= window_m) & (group[i] == group[j])
    i, j, off = i[near], j[near], off[near]
    order = np.lexsort((j, off, i))
    i, j = i[order], j[order]
    start = np.searchsorted(i, i)  # place of each point's first pair
    kept = np.arange(len(i)) - start < most
    i, j = i[kept], j[kept]
    order = np.lexsort((j, i))
    return i[order], j[order]
