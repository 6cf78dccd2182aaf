"""What a fit of outlines may rest on, drawn from the flattened outline and points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RecognitionConfig
from vflatten_ros.core.errors import InvalidInput
from vflatten_ros.core.geometry import distances_m, loop_normals, twice_area
from vflatten_ros.core.templates import Float
from vflatten_ros.core.values import Bool, FlatPoints, Int, Outline

CELL_M = 0.004  # of the images
MARGIN_M = 0.15  # of the images round the outline
SAMPLES = 128  # of the outline, and most flattened points that a fit uses
RIM_M = 0.03  # flattened points nearer than this to the outline, or outside, bound the item
MOST_INFERRED = 0.6  # if more than this is, the flags say too little to go by
GAP_M = 0.05  # widest gap between parts of an item, as between its legs
GAP_WEIGHT = 4.0  # of an outline along such a gap: cloth that no view shows is not missing so
MEETING_M = 0.06  # beyond where pieces meet their outline need not be that of the item
MOST_LINKED = 6000  # flattened points that are linked to find gaps


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was seen, prepared once for all templates."""

    outline: Float  # (n, 2) evenly spaced points of the outline, m
    normal: Float  # (n, 2) outward
    sigma: Float  # (n,) m
    weight: Float  # (n,) independent observations that a point stands for; 0: not seen
    inner: Float  # (q, 2) flattened points near the rim
    inner_sigma: Float  # (q,)
    inner_weight: Float  # (q,)
    origin: Float  # (2,) of the distance image
    distance: Float  # (rows, cols) signed distance to the outline, inside negative, m
    slope: Float  # (rows, cols, 2) its gradient
    seen: Float  # (rows, cols) 1 where the nearest part of the outline was seen
    density: float  # independent observations per metre of outline

    def thinned(self) -> Evidence:
        """Every second point of the outline and no inner points, for a first look."""
        return replace(
            self,
            outline=self.outline[::2],
            normal=self.normal[::2],
            sigma=self.sigma[::2],
            weight=2.0 * self.weight[::2],
            inner=self.inner[:0],
            inner_sigma=self.inner_sigma[:0],
            inner_weight=self.inner_weight[:0],
        )

    @property
    def total(self) -> float:
        """Independent observations in all."""
        return float(self.weight.sum())


def evidence_from(outline: Outline, points: FlatPoints, config: RecognitionConfig) -> Evidence:
    """Evenly spaced outline with its gaps opened, its distance image, and points near the rim.

    Raises
    ------
    InvalidInput
        An outline of fewer than three points, not finite, or without area.
    """
    if len(outline.uv) < 3 or not np.isfinite(outline.uv).all():
        raise InvalidInput(f"outline: expected three finite points or more, got {outline.uv.shape}")
    if abs(twice_area(outline.uv)) < 2e-4:
        raise InvalidInput("outline: encloses less than 1 cm2")
    origin = outline.uv.min(axis=0) - MARGIN_M
    cols, rows = np.ceil((outline.uv.max(axis=0) + MARGIN_M - origin) / CELL_M).astype(int) + 1
    body = np.zeros((rows, cols), dtype=np.uint8)
    cv2.fillPoly(body, [_cells(outline.uv, origin)], (1,), shift=4)
    gaps = _gaps(points, origin, body)
    even = _evenly(_with_gaps(outline, origin, body, gaps), SAMPLES)
    uv, sigma, inferred = even.uv, even.sigma_m, even.inferred
    if inferred.mean() > MOST_INFERRED:
        sigma = np.full(SAMPLES, np.median(points.sigma_m))
        inferred = np.zeros(SAMPLES, dtype=bool)
    distance, slope, seen = _distance_image(uv, ~inferred, origin, (rows, cols))
    density = 0.5 / config.correlation_m
    weight = density * float(np.linalg.norm(uv[1] - uv[0]))
    depth = sample(distance, (points.uv - origin) / CELL_M)
    rim = np.flatnonzero(~points.inferred & (depth > -RIM_M))
    rim = rim[np.linspace(0, len(rim) - 1, min(len(rim), SAMPLES)).astype(int)]
    normal = loop_normals(uv)
    gap = _across_gaps(uv, normal, origin, distance)
    return Evidence(
        outline=uv,
        normal=normal,
        sigma=np.hypot(sigma, config.misfit_m),
        weight=np.where(inferred, 0.0, weight) * np.where(gap, GAP_WEIGHT, 1.0),
        inner=points.uv[rim],
        inner_sigma=np.hypot(points.sigma_m[rim], config.misfit_m),
        inner_weight=np.full(len(rim), 0.5 * weight * SAMPLES / max(len(rim), 1)),
        origin=origin,
        distance=distance,
        slope=slope,
        seen=seen,
        density=density,
    )


def _cells(uv: Float, origin: Float) -> NDArray[np.int32]:
    """Image coordinates in sixteenths of a cell."""
    result: NDArray[np.int32] = np.rint((uv - origin) / CELL_M * 16).astype(np.int32)
    return result


def _gaps(points: FlatPoints, origin: Float, body: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Where the flat outline is closed but no cloth runs across: between two legs, for one.

    Points that are as near in space as in the plane lie on one piece of cloth. What no link between
    such points comes near is a gap.
    """
    seen = np.flatnonzero(~points.inferred)
    seen = seen[:: max(1, len(seen) // MOST_LINKED)]
    nothing = np.zeros_like(body)
    if len(seen) < 300:
        return nothing
    uv, xyz = points.uv[seen], points.xyz_hanger[seen]
    tree = cKDTree(uv)
    spacing = float(np.quantile(tree.query(uv, k=2)[0][:, 1], 0.75))
    reach_m = max(0.010, 3.0 * spacing)
    pairs = tree.query_pairs(reach_m, output_type="ndarray")
    one, other = np.ascontiguousarray(pairs.T)
    linked = distances_m(xyz, one, other) < 1.3 * distances_m(uv, one, other) + 0.005
    steps = int(np.ceil(reach_m / CELL_M))
    cloth = _drawn((uv - origin) / CELL_M, one[linked], other[linked], steps, body.shape)
    reach = 2 * int(np.ceil(max(0.004, 1.5 * spacing) / CELL_M)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    bare = ((body > 0) & (cv2.dilate(cloth, disc) == 0)).astype(np.uint8)
    if bare.sum() > 0.4 * body.sum():
        return nothing
    return np.asarray(cv2.dilate(bare, disc) & body & ~cloth, dtype=np.uint8)


def _drawn(
    cell: Float, start: Int, end: Int, steps: int, shape: tuple[int, ...]
) -> NDArray[np.uint8]:
    """Image of straight lines between cells (n, 2), x first; strays lie beyond it."""
    rows, cols = shape
    image = np.zeros(shape, dtype=np.uint8)
    u, v = np.ascontiguousarray(cell.T)
    x, y = u[start], v[start]
    dx, dy = u[end] - x, v[end] - y
    for share in np.linspace(0.0, 1.0, steps + 1):  # one by one: the arrays stay in the cache
        col, row = np.rint(x + share * dx), np.rint(y + share * dy)
        inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
        image.ravel()[(row * cols + col)[inside].astype(np.intp)] = 1
    return image


def _with_gaps(
    outline: Outline, origin: Float, body: NDArray[np.uint8], gaps: NDArray[np.uint8]
) -> Outline:
    """The outline, counter-clockwise, going in and out of gaps that reach it."""
    flip = slice(None, None, 1 if twice_area(outline.uv) > 0 else -1)
    given = Outline(outline.uv[flip], outline.sigma_m[flip], outline.inferred[flip])
    gaps = _without_hidden(gaps, given, origin)
    if not gaps.any():
        return given
    rest = body & ~gaps & ~_slit_cells(given.uv, origin, body) & 1
    rest = cv2.morphologyEx(rest, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    contours, _ = cv2.findContours(rest, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(contours, key=cv2.contourArea)[:, 0].astype(np.float64)
    if cv2.contourArea(largest.astype(np.float32)) < 0.6 * body.sum():
        return given
    uv = origin + CELL_M * largest
    uv = uv if twice_area(uv) > 0 else uv[::-1]
    given = _evenly(given, 8 * SAMPLES)
    far, near = cKDTree(given.uv).query(uv)
    uv = np.where((far < 0.01)[:, None], given.uv[near], uv)
    return Outline(uv, given.sigma_m[near], given.inferred[near] & (far < 0.02))


def _slit_cells(uv: Float, origin: Float, body: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Cells within a filled outline through which it runs: slits too narrow to be left bare."""
    line = np.zeros_like(body)
    cv2.polylines(line, [_cells(uv, origin)], isClosed=True, color=(1,), shift=4)
    return np.asarray(line & cv2.erode(body, np.ones((3, 3), np.uint8)), dtype=np.uint8)


def _without_hidden(gaps: NDArray[np.uint8], outline: Outline, origin: Float) -> NDArray[np.uint8]:
    """Without the gaps that open where the outline is inferred: there is hidden cloth."""
    if not gaps.any() or not outline.inferred.any():
        return gaps
    count, label = cv2.connectedComponents(cv2.dilate(gaps, np.ones((3, 3), np.uint8)))
    fine = _evenly(outline, 8 * SAMPLES)
    col, row = np.rint((fine.uv - origin) / CELL_M).astype(int).T
    mouth = label[row.clip(0, label.shape[0] - 1), col.clip(0, label.shape[1] - 1)]
    met = np.bincount(mouth, minlength=count)
    hidden = np.bincount(mouth, fine.inferred, minlength=count) > 0.5 * met
    hidden[0] = False
    return np.where(hidden[label], 0, gaps).astype(np.uint8)


def _across_gaps(uv: Float, normal: Float, origin: Float, distance: Float) -> Bool:
    """Points that face other cloth across a narrow gap."""
    steps = np.arange(0.008, GAP_M, CELL_M)
    ahead = uv[:, None] + steps[:, None] * normal[:, None]
    faced: Bool = (sample(distance, (ahead - origin) / CELL_M) < -CELL_M).any(axis=1)
    return faced


def _evenly(outline: Outline, count: int) -> Outline:
    closed = np.vstack([outline.uv, outline.uv[:1]])
    at = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))]
    wanted = np.arange(count) * (at[-1] / count)
    uv = np.column_stack([np.interp(wanted, at, column) for column in closed.T])
    sigma = np.interp(wanted, at, np.r_[outline.sigma_m, outline.sigma_m[0]])
    inferred = np.interp(wanted, at, np.r_[outline.inferred, outline.inferred[0]].astype(float))
    return Outline(uv, sigma, inferred > 0.5)


def _distance_image(
    uv: Float, trusted: Bool, origin: Float, shape: tuple[int, int]
) -> tuple[Float, Float, Float]:
    fine = _cells(uv, origin)
    body, edge = np.zeros(shape, dtype=np.uint8), np.ones(shape, dtype=np.uint8)
    cv2.fillPoly(body, [fine], (1,), shift=4)
    cv2.polylines(edge, [fine], isClosed=True, color=(0,), shift=4)
    away, label = cv2.distanceTransformWithLabels(
        edge, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    distance = np.where(body > 0, -away, away).astype(np.float64) * CELL_M
    down, right = np.gradient(distance, CELL_M)
    row, col = np.nonzero(edge == 0)
    nearest = cKDTree(uv).query(origin + CELL_M * np.column_stack([col, row]))[1]
    of_label = np.zeros(label.max() + 1)
    of_label[label[row, col]] = trusted[nearest]
    return distance, np.stack([right, down], axis=-1), of_label[label]


def seen_beside(evidence: Evidence, ends: Float) -> Float:
    """Where a template must lie on the seen outline: not near where two pieces' ends meet.

    Parameters
    ----------
    ends : ndarray of shape (n, 2)
        Of all pieces, m; those amid the cloth of the evidence meet others.

    Returns
    -------
    ndarray of shape (rows, cols)
        As Evidence.seen.
    """
    cell = np.rint((ends - evidence.origin) / CELL_M).astype(int)
    rows, cols = evidence.distance.shape
    col, row = np.clip(cell, 0, [cols - 1, rows - 1]).T
    within = evidence.distance[row, col] < -CELL_M
    free = np.ones((rows, cols), np.uint8)
    free[row[within], col[within]] = 0
    away = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_5) * CELL_M
    return np.where(away < MEETING_M, 0.0, evidence.seen)


def robust_mean(off: Float, cut: float) -> Float:
    """(...,) mean over the last axis of halves of squared residuals (in sigmas), levelling off."""
    out: Float = (0.5 * off**2 / (1.0 + (off / cut) ** 2)).mean(axis=-1)
    return out


def sample(image: Float, cell: Float) -> Float:
    """Values of an image between its cells; beyond it, those of its border."""
    rows, cols = image.shape
    inside = np.clip(cell, 0.0, np.array([cols, rows]) - 1.001)
    low: Int = inside.astype(np.int64)
    u, v = np.moveaxis(inside - low, -1, 0)
    i, j = low[..., 1], low[..., 0]
    above = image[i, j] * (1 - u) + image[i, j + 1] * u
    below = image[i + 1, j] * (1 - u) + image[i + 1, j + 1] * u
    value: Float = above * (1 - v) + below * v
    return value


def look_up(evidence: Evidence, at: Float) -> tuple[Float, Float, Float]:
    """Signed distance to the seen outline, its gradient, and 1 where that part was seen."""
    rows, cols = evidence.distance.shape
    cell = (at - evidence.origin) / CELL_M
    inside = np.clip(cell, 0.0, np.array([cols, rows]) - 1.001)
    beyond = np.linalg.norm(cell - inside, axis=-1) * CELL_M
    low = np.rint(inside).astype(np.int64)
    i, j = low[..., 1], low[..., 0]
    return sample(evidence.distance, inside) + beyond, evidence.slope[i, j], evidence.seen[i, j]
