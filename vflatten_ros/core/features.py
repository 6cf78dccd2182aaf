"""Points of the cloth that two views show, found by their colour where the fabric has texture.

Surfaces alone do not tell where along a smooth tube or a flat side two views meet; a print does.
A feature of one view is looked for only where the registered surfaces allow it in the other, so
that stripes and checks, which repeat, are less often taken for one another; what is left must agree
on one small motion. Plain fabric has few features or none, and that does no harm.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vflatten_ros.core.config import CorrespondenceConfig
from vflatten_ros.core.correspondences import Matches, PlacedView
from vflatten_ros.core.values import Bool, Byte, Float, Int, View

CREATE = "SIFT_create"  # the one name that OpenCV has from 4.6 on, though not its stubs
ENLARGED = 2  # times: prints are a few pixels wide where a pixel is 2 to 3 mm
MARGIN_PX = 3  # of the item's border without features: the background shows in them
MOST_FEATURES = 600  # of a view
LEAST_CONTRAST = 4.0  # grey values, one sigma within the item, below which it is plain
ALIKE = 0.7  # least cosine between the normals of one point in two views
LEAST_AGREEING = 4  # matches that agree on a motion, and
LEAST_SHARE = 0.35  # their share of all, below which none of them counts
ROUNDS = 64  # of the search for the motion
TURN_M = 0.15  # lever of a turn about the vertical: how far most cloth is from the axis

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one view, on its placed surface."""

    at: Int  # (n,) rows of the PlacedView
    offset_m: Float  # (n, 3) from that row's point to the feature, common frame
    descriptor: Float32  # (n, 128)


def features_of(placed: PlacedView) -> Features:
    """Features of a view's grey image, inside the item (SIFT; Lowe 2004).

    Returns
    -------
    Features
        None where the view has no colour, no image or no contrast.
    """
    view = placed.view
    none = Features(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 128), np.float32))
    if view.rgb is None or view.shape[0] < 2 or len(placed.row) < 50:
        return none
    low = view.pixel.min(axis=0) - 8
    grey, mask = _image(view, low)
    if grey[mask > 0].std() < LEAST_CONTRAST:
        return none
    grey = cv2.createCLAHE(2.0, (8, 8)).apply(grey)
    size = (grey.shape[1] * ENLARGED, grey.shape[0] * ENLARGED)
    grey = cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC)
    inside = cv2.erode(mask, np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8))
    inside = cv2.resize(inside, size, interpolation=cv2.INTER_NEAREST)
    sift = getattr(cv2, CREATE)(nfeatures=MOST_FEATURES, contrastThreshold=0.02)
    found, descriptor = sift.detectAndCompute(grey, inside)
    if not found:
        return none
    xy = np.array([point.pt for point in found])
    pixel = (xy[:, ::-1] + 0.5) / ENLARGED - 0.5 + low
    # the surface around the feature tells where on the cloth it is, finer than a pixel
    tree = cKDTree(view.pixel[placed.row])
    away, at = tree.query(pixel)
    on = away < 2.0
    order = np.lexsort((pixel[on, 1], pixel[on, 0]))
    at, pixel, descriptor = at[on][order], pixel[on][order], descriptor[on][order]
    return Features(at, _offsets(placed, tree, at, pixel), descriptor.astype(np.float32))


def _image(view: View, low: Int) -> tuple[Byte, Byte]:
    """Grey image of the item, filled with its mean around it, and its mask."""
    shape = np.ptp(view.pixel, axis=0) + 17
    assert view.rgb is not None
    row, col = (view.pixel - low).T
    value = view.rgb.astype(np.float64) @ np.array([0.299, 0.587, 0.114])
    mask = np.zeros(shape, dtype=np.uint8)
    mask[row, col] = 1
    grey = np.full(shape, np.clip(value.mean(), 0, 255))
    grey[row, col] = value
    # single pixels that were not measured are filled by those around them
    filled = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    around = cv2.blur(grey * mask, (3, 3)) / np.maximum(cv2.blur(mask.astype(float), (3, 3)), 1e-6)
    grey = np.where((filled > 0) & (mask == 0), around, grey)
    image: Byte = np.rint(grey.clip(0, 255)).astype(np.uint8)
    return image, filled


def _offsets(placed: PlacedView, tree: cKDTree, at: Int, pixel: Float) -> Float:
    """From the nearest pixel's point to the feature: by the slope of the points around."""
    if not len(at):
        return np.zeros((0, 3))
    near = tree.query(pixel, k=9)[1]
    image = placed.view.pixel[placed.row]
    step = (image[near] - image[at][:, None]).astype(float)
    move = placed.points[near] - placed.points[at][:, None]
    weight = (np.linalg.norm(move, axis=2) < 0.012)[..., None]  # not across a jump
    normal = np.einsum("nki,nkj->nij", step * weight, step) + 1e-3 * np.eye(2)
    slope = np.linalg.solve(normal, np.einsum("nki,nkj->nij", step * weight, move))
    offset: Float = np.einsum("ni,nij->nj", pixel - image[at], slope)
    return offset


def common_features(
    a: PlacedView, b: PlacedView, of_a: Features, of_b: Features, config: CorrespondenceConfig
) -> Matches:
    """Features of two views that are the same point of the cloth.

    Parameters
    ----------
    a, b : PlacedView
        Of the same registration.
    of_a, of_b : Features
        Of these views.

    Returns
    -------
    Matches
        Those that agree on one small motion; often none.
    """
    none = Matches(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    if not len(of_a.at) or not len(of_b.at):
        return none
    i, j, doubt = _matched(a, b, of_a, of_b, config)
    if len(i) < LEAST_AGREEING:
        return none
    p, q = a.points[of_a.at[i]] + of_a.offset_m[i], b.points[of_b.at[j]] + of_b.offset_m[j]
    agree, miss = agreeing(p, q, config.feature_agree_m)
    if agree.sum() < max(LEAST_AGREEING, LEAST_SHARE * len(i)):
        return none
    share = float(agree.mean())
    sure = (
        share
        * (1 - doubt[agree]) ** 0.5
        * np.exp(-0.5 * (miss[agree] / config.feature_agree_m) ** 2)
    )
    return Matches(of_a.at[i[agree]], of_b.at[j[agree]], sure)


def _matched(
    a: PlacedView, b: PlacedView, of_a: Features, of_b: Features, config: CorrespondenceConfig
) -> tuple[Int, Int, Float]:
    """Features nearest to each other among those that may be the same, and their ratio."""
    p, q = a.points[of_a.at] + of_a.offset_m, b.points[of_b.at] + of_b.offset_m
    may = np.zeros((len(p), len(q)), dtype=bool)
    for row, near in enumerate(cKDTree(q).query_ball_point(p, config.feature_reach_m)):
        may[row, near] = True
    may &= a.normals[of_a.at] @ b.normals[of_b.at].T > ALIKE
    one, other = of_a.descriptor, of_b.descriptor
    squared = (one**2).sum(1)[:, None] + (other**2).sum(1) - 2.0 * one @ other.T
    off = np.sqrt(np.maximum(squared, 0.0)).astype(np.float64)
    off[~may] = np.inf
    j = off.argmin(axis=1)
    i = np.arange(len(p))
    best = off[i, j]
    rest = off.copy()
    rest[i, j] = np.inf
    # the same feature found twice is no rival
    twin = np.linalg.norm(q[None] - q[j][:, None], axis=2) < config.feature_agree_m
    rest[twin] = np.inf
    second = np.minimum(rest.min(axis=1), config.feature_most)
    mutual = off.argmin(axis=0)[j] == i
    keep = np.isfinite(best) & (best < config.feature_ratio * second) & mutual
    return i[keep], j[keep], (best[keep] / second[keep]).clip(0, 1)


def agreeing(p: Float, q: Float, limit_m: float) -> tuple[Bool, Float]:
    """Which matches one small motion (a shift and a turn about the vertical) brings together.

    RANSAC (Fischler and Bolles 1981) over shifts, then least squares.

    Parameters
    ----------
    p, q : ndarray of shape (m, 3)
        Matched points, common frame.
    limit_m : float
        How far they may be apart.

    Returns
    -------
    agree : ndarray of shape (m,), bool
    miss_m : ndarray of shape (m,)
        What is left between them.
    """
    off = p - q
    tried = np.random.default_rng(0).permutation(len(off))[:ROUNDS]  # seeded: the same every time
    left = np.linalg.norm(off[None] - off[tried][:, None], axis=2)
    agree: Bool = left[(left < limit_m).sum(axis=1).argmax()] < limit_m
    miss = np.full(len(p), np.inf)
    for _ in range(3):
        design = np.zeros((len(p), 3, 4))
        design[:, :, :3] = np.eye(3)
        design[:, 0, 3], design[:, 1, 3] = -q[:, 1] / TURN_M, q[:, 0] / TURN_M
        chosen = design[agree].reshape(-1, 4)
        normal = chosen.T @ chosen + 0.1 * np.eye(4)
        motion = np.linalg.solve(normal, chosen.T @ off[agree].reshape(-1))
        miss = np.linalg.norm(off - design @ motion, axis=1)
        agree = miss < limit_m
        if not agree.any():
            break
    return agree, miss
