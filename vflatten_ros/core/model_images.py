"""Categories by model images: Kita & Kita 2019, section 4, eq. 11."""

from __future__ import annotations

import cv2
import numpy as np

from vflatten_ros.core.templates import Float, Template

CELLS = 128  # cells of a model image along the longest length
MARGIN = 1.5  # side of a model image, in longest lengths: any rotation of the contour fits


def model_image_scores(
    contour: Float, templates: tuple[Template, ...], decay: float, rotations: int
) -> dict[str, float]:
    """R of every category.

    The contour is scaled so that its longest length is that of the category's typical outline, its
    centroid is put on the centre of the model image, and it is turned and mirrored: R is the
    largest mean of the image along the contour. The image is exp(-d / decay), d the distance to
    the typical outline in its longest lengths.

    Parameters
    ----------
    contour : ndarray of shape (k, 2)
        Closed, evenly sampled, in any unit.
    templates : tuple of Template
    decay : float
        Distance at which the image falls to 1/e, as a share of the longest length.
    rotations : int
        Rotations tried in a full turn.

    Returns
    -------
    dict
        Category -> R, 0 to 1.
    """
    shape = _normalised(contour)
    angle = np.arange(rotations) * (2.0 * np.pi / rotations)
    cos, sin = np.cos(angle), np.sin(angle)
    turns = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], -2)  # (r, 2, 2)
    both = np.stack([shape, shape * [-1.0, 1.0]])
    turned = np.einsum("mki,rij->mrkj", both, turns).astype(np.float32)
    pixel = (turned / MARGIN + 0.5) * (CELLS * MARGIN) - 0.5
    places = np.ascontiguousarray(pixel.reshape(-1, len(shape), 2))
    scores = {}
    for template in templates:
        image = model_image(template, decay)
        values = cv2.remap(image, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
        scores[template.category] = float(values.mean(axis=1).max())
    return scores


def model_image(template: Template, decay: float) -> Float:
    """The typical outline of a category as an image, float32, highest on the outline."""
    outline = _normalised(template.outline(np.zeros(template.dimensions)))
    size = int(CELLS * MARGIN)
    ink = np.full((size, size), 255, dtype=np.uint8)
    fine = np.rint(((outline / MARGIN + 0.5) * size - 0.5) * 16).astype(np.int32)
    cv2.polylines(ink, [fine], isClosed=True, color=0, thickness=1, shift=4)
    distance = cv2.distanceTransform(ink, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    image: Float = np.exp(-distance / np.float32(decay * CELLS))
    return image


def _normalised(contour: Float) -> Float:
    """The contour with its centroid at 0 and a longest length of 1."""
    hull = cv2.convexHull(contour.astype(np.float32))[:, 0].astype(np.float64)
    longest = np.linalg.norm(hull[:, None] - hull[None], axis=-1).max()
    result: Float = (contour - centroid(contour)) / max(longest, 1e-9)
    return result


def centroid(contour: Float) -> Float:
    """Centroid of the area that a closed contour encloses."""
    after = np.roll(contour, -1, axis=0)
    cross = contour[:, 0] * after[:, 1] - contour[:, 1] * after[:, 0]
    if abs(cross.sum()) < 1e-9:
        mean: Float = contour.mean(axis=0)
        return mean
    middle: Float = (cross[:, None] * (contour + after)).sum(axis=0) / (3.0 * cross.sum())
    return middle
