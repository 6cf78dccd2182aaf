"""The outline beside the category's: both weighed together, and odd where it was seen."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vflatten_ros.core.geometry import thinned_loop, twice_area
from vflatten_ros.core.template_fit import Fit, place
from vflatten_ros.core.values import Float, Outline

CELL_M = 0.002  # of the images
COARSE_M, PATCH_M = 0.004, 0.04  # cells of images of what is missing; narrower is a strip
CUT = 4.0  # standard deviations of a difference, from which on what was seen weighs nothing
DEEP_M = 0.04  # inside the category's outline, which is no mere inaccuracy
MOST_DEEP_M = 0.13  # longest stretch seen there of results that turned out right: 0.123


def with_category(outline: Outline, fit: Fit, misfit_m: float) -> Outline:
    """What was seen of an outline and the category's together, each by how sure it is.

    Both are distances inside a border, so they are weighed cell by cell. Far beyond what an item
    may differ from its category by, what was seen lies wrongly, and weighs nothing (Tukey's
    biweight). Where no view shows the outline the category adds what it has beyond.

    Parameters
    ----------
    outline : Outline
        Of what was seen, inferred where the cloth goes on.
    fit : Fit
        The category's outline as it fits.
    misfit_m : float
        How far an item's outline differs from the category's, one standard deviation.

    Returns
    -------
    Outline
        Inferred where it is the category's; as uncertain there as the fit.
    """
    points, slope = place(fit.template, fit.pose, fit.state)
    k = fit.template.vertices
    low = np.minimum(outline.uv.min(axis=0), points[:k].min(axis=0)) - 4 * CELL_M
    high = np.maximum(outline.uv.max(axis=0), points[:k].max(axis=0)) + 4 * CELL_M
    cols, rows = np.ceil((high - low) / CELL_M).astype(int) + 1
    category = _inside_m(points[:k], low, (rows, cols))
    differs = _inside_m(outline.uv, low, (rows, cols)) - category
    seen_m = float(np.median(outline.sigma_m))
    share = misfit_m**2 / (misfit_m**2 + seen_m**2)
    bounded = np.minimum(np.abs(differs) / (CUT * np.hypot(misfit_m, seen_m)), 1.0)
    if outline.inferred.any():
        row, col = np.nonzero((differs < 0.0) & (bounded < 1.0))
        nearest = cKDTree(outline.uv).query(low + CELL_M * np.column_stack([col, row]))[1]
        hidden = outline.inferred[nearest]
        differs[row[hidden], col[hidden]] = 0.0
    inside = category + share * (1.0 - bounded**2) ** 2 * differs > 0.0
    contours, _ = cv2.findContours(
        inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    if not contours:
        return outline
    uv = low + CELL_M * thinned_loop(max(contours, key=cv2.contourArea)[:, 0].astype(np.float64))
    if twice_area(uv) * twice_area(outline.uv) < 0:
        uv = uv[::-1]
    away, near = cKDTree(outline.uv).query(uv)
    moved = away > misfit_m
    variance = np.einsum("pim,mn,pin->pi", slope[:k], fit.covariance, slope[:k])
    sigma = float(np.sqrt(variance.mean()))
    return Outline(
        uv,
        np.where(moved, np.hypot(sigma, misfit_m), outline.sigma_m[near]),
        moved | outline.inferred[near],
    )


def deep_inside_m(outline: Outline, fit: Fit) -> float:
    """Length of the longest seen stretch of the outline that lies deep inside the category's.

    Parameters
    ----------
    outline : Outline
    fit : Fit

    Returns
    -------
    float
        Metres; above MOST_DEEP_M the category does not say what was seen there.
    """
    category = (fit.points()[: fit.template.vertices] * 1e3).astype(np.float32)
    off = [cv2.pointPolygonTest(category, (u, v), True) for u, v in (outline.uv * 1e3).tolist()]
    odd = (np.array(off) > 1e3 * DEEP_M) & ~outline.inferred
    if odd.all() or not odd.any():
        return 0.0 if not odd.any() else float("inf")
    length = np.linalg.norm(np.roll(outline.uv, -1, axis=0) - outline.uv, axis=1)
    first = int(np.flatnonzero(~odd)[0])  # begin where no stretch goes on
    odd, length = np.roll(odd, -first), np.roll(length, -first)
    stretch = np.cumsum(~odd)
    return float(np.bincount(stretch[odd], length[odd]).max())


def missing_share(outline: Outline, fit: Fit) -> float:
    """Share of the category's area that the outline leaves out, in patches and not in strips.

    Parameters
    ----------
    outline : Outline
    fit : Fit
    """
    category = fit.points()[: fit.template.vertices]
    low = np.minimum(outline.uv.min(axis=0), category.min(axis=0)) - 4 * COARSE_M
    high = np.maximum(outline.uv.max(axis=0), category.max(axis=0)) + 4 * COARSE_M
    cols, rows = np.ceil((high - low) / COARSE_M).astype(int) + 1
    whole, seen = (_filled(uv, low, (rows, cols), COARSE_M) for uv in (category, outline.uv))
    across = 2 * round(0.5 * PATCH_M / COARSE_M) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (across, across))
    missing = cv2.morphologyEx(whole & ~seen & 1, cv2.MORPH_OPEN, disc)
    return float(missing.sum()) / max(float(whole.sum()), 1.0)


def _inside_m(uv: Float, low: Float, shape: tuple[int, int]) -> Float:
    """How far inside a closed line every cell lies; outside negative."""
    image = _filled(uv, low, shape, CELL_M)
    away: Float = cv2.distanceTransform(image, cv2.DIST_L2, cv2.DIST_MASK_5).astype(np.float64)
    away -= cv2.distanceTransform(1 - image, cv2.DIST_L2, cv2.DIST_MASK_5)
    return CELL_M * away


def _filled(uv: Float, low: Float, shape: tuple[int, int], cell_m: float) -> NDArray[np.uint8]:
    """Image that is 1 inside a closed line (n, 2), m, and begins at `low`."""
    image = np.zeros(shape, dtype=np.uint8)
    cv2.fillPoly(image, [np.rint((uv - low) / cell_m * 16).astype(np.int32)], (1,), shift=4)
    return image
