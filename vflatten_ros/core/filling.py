"""The outline beside the category's: filled where no view shows it, and odd where it was seen."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vflatten_ros.core.geometry import thinned_loop, twice_area
from vflatten_ros.core.template_fit import Fit, place
from vflatten_ros.core.values import Float, Outline

CELL_M = 0.002  # of the images
SAME_M = 0.004  # between the outline before and after where it stays as it is
THINNEST_CELLS = 3  # of what is added
DEEP_M = 0.04  # inside the category's outline, which is no mere inaccuracy
MOST_DEEP_M = 0.13  # longest stretch seen there of results that turned out right: 0.123


def filled(outline: Outline, fit: Fit) -> Outline:
    """Add what the fitted category has beyond inferred parts of an outline.

    Where the cloth was seen to end nothing is added, whatever the category has there.

    Parameters
    ----------
    outline : Outline
        Of what was seen, inferred where the cloth goes on.
    fit : Fit
        The category's outline as it fits.

    Returns
    -------
    Outline
        Inferred where it is the category's; as uncertain there as the fit.
    """
    if not outline.inferred.any():
        return outline
    points, slope = place(fit.template, fit.pose, fit.state)
    k = fit.template.vertices
    low = np.minimum(outline.uv.min(axis=0), points[:k].min(axis=0)) - 4 * CELL_M
    high = np.maximum(outline.uv.max(axis=0), points[:k].max(axis=0)) + 4 * CELL_M
    cols, rows = np.ceil((high - low) / CELL_M).astype(int) + 1
    seen = _image(outline.uv, low, (rows, cols))
    beyond = _image(points[:k], low, (rows, cols)) & (1 - seen)
    at = np.argwhere(beyond)
    nearest = cKDTree(outline.uv).query(low + CELL_M * at[:, ::-1])[1]
    off = at[~outline.inferred[nearest]]
    beyond[off[:, 0], off[:, 1]] = 0
    thin = np.ones((THINNEST_CELLS, THINNEST_CELLS), np.uint8)
    beyond = cv2.morphologyEx(beyond, cv2.MORPH_OPEN, thin).astype(np.uint8)
    contours, _ = cv2.findContours(seen | beyond, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    uv = low + CELL_M * thinned_loop(max(contours, key=cv2.contourArea)[:, 0].astype(np.float64))
    if twice_area(uv) * twice_area(outline.uv) < 0:
        uv = uv[::-1]
    away, near = cKDTree(outline.uv).query(uv)
    added = away > SAME_M
    variance = np.einsum("pim,mn,pin->pi", slope[:k], fit.covariance, slope[:k])
    sigma = float(np.sqrt(variance.mean()))
    return Outline(
        uv,
        np.where(added, np.hypot(sigma, outline.sigma_m[near]), outline.sigma_m[near]),
        added | outline.inferred[near],
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


def _image(uv: Float, low: Float, shape: tuple[int, int]) -> NDArray[np.uint8]:
    image = np.zeros(shape, dtype=np.uint8)
    cv2.fillPoly(image, [np.rint((uv - low) / CELL_M * 16).astype(np.int32)], (1,), shift=4)
    return image
