"""Features of one view's image, where its fabric has texture, and where on the cloth they are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vflatten_ros.core.geometry import transform_directions
from vflatten_ros.core.values import Byte, Float, Int, View

CREATE = "SIFT_create"  # the one name that OpenCV has from 4.6 on, though not its stubs
ENLARGED = 2  # times: prints are a few pixels wide where a pixel is 2 to 3 mm
MARGIN_PX = 3  # of the item's border without features: the background shows in them
MOST_FEATURES = 600  # of a view
LEAST_CONTRAST = 4.0  # grey values, one sigma within the item, below which it is plain
LEAST_POINTS = 50  # of a surface

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one view, on its surface."""

    at: Int  # (n,) rows of the surface
    offset_m: Float  # (n, 3) from that row's point to the feature, frame of the surface
    descriptor: Float32  # (n, 128)

    def turned(self, pose: Float) -> Features:
        """The same in the frame that `pose` (4, 4) takes that of the surface to."""
        return replace(self, offset_m=transform_directions(pose, self.offset_m))


NO_FEATURES = Features(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 128), np.float32))


def features_of(view: View, surface: Float, row: Int) -> Features:
    """Features of a view's grey image, inside the item (SIFT; Lowe 2004).

    Parameters
    ----------
    view : View
    surface : ndarray of shape (n, 3)
        Points of its surface.
    row : ndarray of shape (n,)
        Rows of the view's points that they belong to.

    Returns
    -------
    Features
        None where the view has no colour, no image or no contrast.
    """
    if view.rgb is None or view.shape[0] < 2 or len(row) < LEAST_POINTS:
        return NO_FEATURES
    low = view.pixel.min(axis=0) - 8
    grey, mask = _image(view, low)
    if grey[mask > 0].std() < LEAST_CONTRAST:
        return NO_FEATURES
    grey = cv2.createCLAHE(2.0, (8, 8)).apply(grey)
    size = (grey.shape[1] * ENLARGED, grey.shape[0] * ENLARGED)
    grey = cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC)
    inside = cv2.erode(mask, np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8))
    inside = cv2.resize(inside, size, interpolation=cv2.INTER_NEAREST)
    sift = getattr(cv2, CREATE)(nfeatures=MOST_FEATURES, contrastThreshold=0.02)
    found, descriptor = sift.detectAndCompute(grey, inside)
    if not found:
        return NO_FEATURES
    xy = np.array([point.pt for point in found])
    pixel = (xy[:, ::-1] + 0.5) / ENLARGED - 0.5 + low
    # the surface around the feature tells where on the cloth it is, finer than a pixel
    image = view.pixel[row]
    tree = cKDTree(image)
    away, at = tree.query(pixel)
    on = away < 2.0
    order = np.lexsort((pixel[on, 1], pixel[on, 0]))
    at, pixel, descriptor = at[on][order], pixel[on][order], descriptor[on][order]
    offset = _offsets(surface, image, tree, at, pixel)
    return Features(at, offset, descriptor.astype(np.float32))


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


def _offsets(
    surface: Float, image: NDArray[np.int32], tree: cKDTree, at: Int, pixel: Float
) -> Float:
    """From the nearest pixel's point to the feature: by the slope of the points around."""
    if not len(at):
        return np.zeros((0, 3))
    near = tree.query(pixel, k=9)[1]
    step = (image[near] - image[at][:, None]).astype(float)
    move = surface[near] - surface[at][:, None]
    weight = (np.linalg.norm(move, axis=2) < 0.012)[..., None]  # not across a jump
    normal = np.einsum("nki,nkj->nij", step * weight, step) + 1e-3 * np.eye(2)
    slope = np.linalg.solve(normal, np.einsum("nki,nkj->nij", step * weight, move))
    offset: Float = np.einsum("ni,nij->nj", pixel - image[at], slope)
    return offset
