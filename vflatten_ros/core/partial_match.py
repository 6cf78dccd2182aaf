"""Where on a category's outline a piece of an item may belong: chamfer matching over all shifts.

For every rotation and size, the misfit of all shifts at once is a sum of correlations, by FFT: the
piece's ends should lie on the outline, its cloth inside, and no part of the outline amid its cloth.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import Float, Int

CELL_M = 0.02
CUT_M = 0.08  # farther off is no worse
DEEP_M = 0.02  # cloth is this deep inside the piece before an outline there counts
SIZES = (0.9, 1.1, 1.4)  # of the whole item's longest extent over the piece's
ROTATIONS = 24
AROUND = 2  # cells between two shifts that differ, at least


def matches(
    template: Template,
    ends: Float,
    inner: Float,
    count: int,
    cut: Float | None = None,
    each: int = 1,
) -> tuple[Float, Float]:
    """Best poses of typical cuts of a category, or of one cut, for a piece of an item.

    Parameters
    ----------
    template : Template
    ends : ndarray of shape (n, 2)
        Points of the piece's outline that may be ends of the item, m.
    inner : ndarray of shape (q, 2)
        Points spread over the piece.
    count : int
        Poses wanted.
    cut : ndarray of shape (m,), optional
        State of the template; typical ones of several sizes by default.
    each : int, optional
        Most shifts of one rotation.

    Returns
    -------
    pose : ndarray of shape (count, 3)
        Rotation and shift of the template.
    state : ndarray of shape (count, m)
    """
    typical = template.outline(np.zeros(template.dimensions))
    extent, own = _diameter(inner), _diameter(typical)
    if cut is None:
        cuts = [_scaled(template, np.log(size * extent / own)) for size in SIZES]
        widest = SIZES[-1] * extent
    else:
        cuts, widest = [cut], _diameter(template.outline(cut))
    # wide enough that a piece within one copy of the outline does not feel the next copy
    span = np.ptp(inner, axis=0) + widest + 2 * CUT_M
    shape = tuple(fft.next_fast_len(int(n), real=True) for n in np.ceil(span / CELL_M)[::-1])
    middle = np.array(shape)[::-1] * 0.5 * CELL_M
    low = 0.5 * (inner.min(axis=0) + inner.max(axis=0)) - middle
    given = [_share(ends, low, shape), _share(inner, low, shape), _depth(inner, low, shape)]
    parts = _spectra(given)
    angles = np.arange(ROTATIONS) * (2 * np.pi / ROTATIONS)
    poses, states, costs = [], [], []
    for state in cuts:
        outline = template.outline(state)
        centre = 0.5 * (outline.min(axis=0) + outline.max(axis=0))
        turned = [(outline - centre) @ _rotation(angle).T + middle for angle in angles]
        images = _misfit_of_shifts(turned, shape, parts)
        size_cells = np.array(shape)[::-1]
        for angle, image in zip(angles, images, strict=True):
            row, col = _minima(image, each)
            shift = (np.stack([col, row], axis=1) + size_cells // 2) % size_cells - size_cells // 2
            place = shift * CELL_M + middle + low - _rotation(angle) @ centre
            poses.append(np.column_stack([np.full(len(place), angle), place]))
            states += [state] * len(place)
            costs.append(image[row, col])
    best = np.argsort(np.concatenate(costs), kind="stable")[:count]
    return np.concatenate(poses)[best], np.array(states)[best]


def _minima(image: NDArray[np.float32], count: int) -> tuple[Int, Int]:
    """Rows and columns of the least values that are the least around, the image going round."""
    if count == 1:
        row, col = np.unravel_index([int(image.argmin())], image.shape)
        return row, col
    wrapped = np.pad(image, AROUND, mode="wrap")
    least = cv2.erode(wrapped, np.ones((2 * AROUND + 1, 2 * AROUND + 1), np.uint8))
    row, col = np.nonzero(image == least[AROUND:-AROUND, AROUND:-AROUND])
    best = np.argsort(image[row, col], kind="stable")[:count]
    return row[best], col[best]


def _misfit_of_shifts(
    outlines: Sequence[Float], shape: tuple[int, ...], parts: NDArray[np.complex64]
) -> NDArray[np.float32]:
    """(n, rows, cols) misfit of each outline moved by every shift of the image."""
    images = np.empty((len(outlines), 3, *shape), dtype=np.float32)
    for outline, (off, out, edge) in zip(outlines, images, strict=True):
        body, line = np.zeros(shape, dtype=np.uint8), np.ones(shape, dtype=np.uint8)
        cells = np.rint(outline / CELL_M * 16).astype(np.int32)
        cv2.fillPoly(body, [cells], (1,), shift=4)
        cv2.polylines(line, [cells], isClosed=True, color=(0,), shift=4)
        off[:] = _capped(cv2.distanceTransform(line, cv2.DIST_L2, 3))
        out[:] = off * (body == 0)
        edge[:] = (1 - line) * (2.0 * CELL_M)
    total = (np.conj(_spectra(images)) * parts).sum(axis=1)
    found: NDArray[np.float32] = fft.irfft2(total, shape)
    return found


def _capped(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    result: NDArray[np.float32] = np.square(np.minimum(distance * (CELL_M / CUT_M), 1.0))
    return result


def _spectra(images: Sequence[Float] | NDArray[np.float32]) -> NDArray[np.complex64]:
    """(..., rows, cols) spectra of images, in single precision: shifts are compared, no more."""
    out: NDArray[np.complex64] = fft.rfft2(np.asarray(images, dtype=np.float32))
    return out


def _share(points: Float, low: Float, shape: tuple[int, ...]) -> Float:
    """Share of the points in every cell."""
    col, row = np.rint((points - low) / CELL_M).astype(int).T
    image = np.zeros(shape)
    np.add.at(image, (row, col), 1.0 / len(points))
    return image


def _depth(inner: Float, low: Float, shape: tuple[int, ...]) -> Float:
    """How deep inside the piece every cell is, 0 to 1."""
    free = np.ones(shape, dtype=np.uint8)
    col, row = np.rint((inner - low) / CELL_M).astype(int).T
    free[row, col] = 0
    free = cv2.morphologyEx(free, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(np.uint8)
    deep = cv2.distanceTransform(1 - free, cv2.DIST_L2, 3) * CELL_M - DEEP_M
    out: Float = np.clip(deep / CUT_M, 0.0, 1.0)
    return out


def _scaled(template: Template, log_size: float) -> Float:
    """The typical cut, larger or smaller as a whole."""
    roots = np.abs(template.log_spread).astype(bool).sum(axis=1) == 1
    state = np.zeros(template.dimensions)
    spread = np.diagonal(template.log_spread)[roots]
    state[: len(template.sizes)][roots] = log_size / spread
    return state


def _diameter(points: Float) -> float:
    middle = points.mean(axis=0)
    return 2.0 * float(np.linalg.norm(points - middle, axis=1).max())


def _rotation(angle: float) -> Float:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])
