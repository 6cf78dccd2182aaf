"""Where a depth image is one piece of cloth and where it jumps from one layer to another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, uniform_filter, uniform_filter1d
from scipy.ndimage import label as connected_regions
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vflatten_ros.core.geometry import Float
from vflatten_ros.core.values import Bool, Int

RING = 2.0  # grid steps that the surface is carried beyond measured places
HOLE = 20  # places in a hole that neighbours fill: single measurements that failed


@dataclass(frozen=True, eq=False)
class Layers:
    """Which grid neighbours are one piece of cloth."""

    seen: Bool  # (rows, cols) measured
    valid: Bool  # (rows, cols) measured, in a small hole, or within RING of the border
    source: Int  # (rows, cols) flat index of the nearest measured place
    bridged: Bool  # (rows, cols) in a hole too large to trust: the surface is only guessed
    right: Bool  # (rows, cols) joined to the place to the right
    down: Bool  # (rows, cols) joined to the place below
    smooth_right: Bool  # (rows, cols) no jump to the place to the right, though perhaps a gap
    smooth_down: Bool  # (rows, cols)
    label: NDArray[np.int32]  # (rows, cols) number of the piece, -1: none


def near_measured(seen: Bool) -> Bool:
    """Measured places, those within RING of them, and small holes."""
    holes, _ = connected_regions(~seen)
    small = np.bincount(holes.ravel())[holes] <= HOLE
    return np.asarray((distance_transform_edt(~seen) <= RING) | small)


def find_layers(
    depth: Float, seen: Bool, points: Float, cell_m: float, noise_m: float, misfit: Float
) -> Layers:
    """Join grid neighbours that no depth jump separates.

    Parameters
    ----------
    depth : ndarray of shape (rows, cols)
        Depth along the rays, metres; any value where not seen.
    seen : ndarray of shape (rows, cols)
        Where depth was measured.
    points : ndarray of shape (rows, cols, 3)
        The measured points.
    cell_m : float
        Distance of grid lines across the rays.
    noise_m : float
        Standard deviation of depth.
    misfit : ndarray of shape (rows, cols)
        Distance of the measured points from a smooth surface, which a jump contradicts.
    """
    rough = _rough(misfit, seen, max(noise_m, 0.15 * cell_m))
    away, nearest = distance_transform_edt(~seen, return_indices=True)
    source = nearest[0] * seen.shape[1] + nearest[1]
    holes, _ = connected_regions(~seen)
    small = (np.bincount(holes.ravel())[holes] <= HOLE) & ~seen
    outside = np.unique(np.concatenate([holes[0], holes[-1], holes[:, 0], holes[:, -1]]))
    bridged = ~seen & ~small & (away > RING) & ~np.isin(holes, outside)
    valid = (away <= RING) | small | bridged
    reach = np.where(small, 8.0, 3.0)
    smooth, joined = [], []
    for axis in (1, 0):
        near, close = _joined(depth, seen, points, source, reach, rough, axis, cell_m, noise_m)
        near &= valid & np.roll(valid, -1, axis=axis)
        near[(slice(None), -1) if axis else -1] = False
        smooth.append(near)
        joined.append(near & (close | bridged | np.roll(bridged, -1, axis=axis)))
    right, down = joined
    label = _label(valid, right, down)
    return Layers(seen, valid, source, bridged, right, down, smooth[0], smooth[1], label)


def _joined(
    depth: Float, seen: Bool, points: Float, source: Int, reach: Float, rough: Bool, axis: int,
    cell_m: float, noise_m: float,
) -> tuple[Bool, Bool]:  # fmt: skip
    """Whether each place and the next along the axis are on one surface, and measured near by."""
    flat = points.reshape(-1, 3)
    other = np.roll(source, -1, axis=axis)
    gap = np.linalg.norm(flat[source] - flat[other], axis=-1)
    rows, cols = np.divmod(source, seen.shape[1])
    rows2, cols2 = np.divmod(other, seen.shape[1])
    steps = np.maximum(np.hypot(rows - rows2, cols - cols2), 1.0)
    # six grid steps deep for one across is 80 degrees from the view
    both = seen & np.roll(seen, -1, axis=axis)
    # steeper places cannot be told from a jump where nothing was measured between
    near = gap < np.hypot(np.where(both, 6.0, 2.5) * cell_m * steps, 5.0 * noise_m)
    # nor where no smooth surface fits
    doubtful = rough | np.roll(rough, -1, axis=axis)
    near &= ~doubtful | (gap < np.hypot(1.6 * cell_m * steps, 3.5 * noise_m))
    close = steps <= np.maximum(reach, np.roll(reach, -1, axis=axis))
    limit = max(4.0 * noise_m, 1.2 * cell_m)
    low = max(3.2 * noise_m, 1.2 * cell_m)
    # a jump is a line of places, noise is not
    short, wide = (_step(depth, seen, axis, across) for across in (3, 7))
    step = (short > limit) & (wide > limit / 2) | (wide > low)
    return np.asarray(near & ~step), np.asarray(close)


def _rough(misfit: Float, seen: Bool, noise_m: float) -> Bool:
    """Places around which the misfit is more than 2.5 times the noise."""
    squared = uniform_filter(np.where(seen, misfit**2, 0.0), 3, mode="constant")
    mass = uniform_filter(seen.astype(float), 3, mode="constant")
    return np.asarray(squared > (2.5 * noise_m) ** 2 * mass)


def _step(depth: Float, seen: Bool, axis: int, across: int) -> Float:
    """How much the change to the next place exceeds the slopes on its two sides; nan: unknown.

    On a smooth surface the change lies between the slopes before and after, whatever the
    curvature; at a step it does not. Changes are means over `across` places beside each other.
    """
    z = np.where(seen, depth, np.nan)
    change = np.roll(z, -1, axis=axis) - z
    change[(slice(None), -1) if axis else -1] = np.nan
    known = np.isfinite(change)
    mass = uniform_filter1d(known.astype(float), across, axis=1 - axis, mode="constant")
    total = uniform_filter1d(np.where(known, change, 0.0), across, axis=1 - axis, mode="constant")
    mean = np.where(known, total / np.maximum(mass, 1e-9), np.nan)
    before = (_shift(mean, 1, axis) + _shift(mean, 2, axis)) / 2
    after = (_shift(mean, -1, axis) + _shift(mean, -2, axis)) / 2
    low, high = np.fmin(before, after), np.fmax(before, after)
    return np.asarray(np.fmax(mean - high, low - mean))


def _shift(values: Float, by: int, axis: int) -> Float:
    out = np.roll(values, by, axis=axis)
    edge = slice(0, by) if by > 0 else slice(by, None)
    out[(slice(None), edge) if axis else edge] = np.nan
    return out


def _label(valid: Bool, right: Bool, down: Bool) -> NDArray[np.int32]:
    number = np.arange(valid.size).reshape(valid.shape)
    a = np.concatenate([number[right], number[down]])
    b = np.concatenate([number[right] + 1, number[down] + valid.shape[1]])
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(valid.size, valid.size))
    _, label = connected_components(graph, directed=False)
    order = np.full(label.max() + 1, -1)
    used, first = np.unique(label[valid.ravel()], return_index=True)
    order[used[np.argsort(first)]] = np.arange(len(used))
    return np.where(valid, order[label].reshape(valid.shape), -1).astype(np.int32)


def connected_window(layers: Layers, rows: Int, cols: Int, reach: int) -> Bool:
    """Which places around each of k places no jump parts from it inside a window.

    Returns
    -------
    ndarray of shape (2 reach + 1, 2 reach + 1, k)
    """
    pad = reach + 1
    wide = layers.valid.shape[1] + 2 * pad
    right, down = (np.pad(m, pad).ravel() for m in (layers.smooth_right, layers.smooth_down))
    here = (rows + pad) * wide + cols + pad
    size = 2 * reach + 1
    open_right = np.empty((size, size - 1, len(rows)), bool)
    open_down = np.empty((size - 1, size, len(rows)), bool)
    for i in range(size):
        for j in range(size):
            at = here + (i - reach) * wide + j - reach
            if j < size - 1:
                right.take(at, out=open_right[i, j], mode="clip")
            if i < size - 1:
                down.take(at, out=open_down[i, j], mode="clip")
    reached = np.zeros((size, size, len(rows)), bool)
    reached[reach, reach] = layers.valid[rows, cols]
    for _ in range(3):  # sweeps to and fro: ways with up to 3 turns back
        for j in range(size - 1):
            reached[:, j + 1] |= reached[:, j] & open_right[:, j]
        for i in range(size - 1):
            reached[i + 1] |= reached[i] & open_down[i]
        for j in range(size - 2, -1, -1):
            reached[:, j] |= reached[:, j + 1] & open_right[:, j]
        for i in range(size - 2, -1, -1):
            reached[i] |= reached[i + 1] & open_down[i]
    return reached


def joined_places(layers: Layers, rc: Float, over_gaps: bool = False) -> tuple[Bool, Bool]:
    """Whether (m, n, 2) grid places are on observed surface, and consecutive ones on one piece.

    `over_gaps`: a narrow gap without a jump does not part them.

    Returns
    -------
    observed (m, n), joined (m, n - 1)
    """
    rows, cols = layers.valid.shape
    place = np.clip(np.round(rc).astype(np.int64), 0, (rows - 1, cols - 1))
    observed = layers.valid[place[..., 0], place[..., 1]]
    r0, c0 = place[:, :-1, 0], place[:, :-1, 1]
    r1, c1 = place[:, 1:, 0], place[:, 1:, 1]
    left, top = np.minimum(c0, c1), np.minimum(r0, r1)
    across, along = c0 != c1, r0 != r1
    right = layers.smooth_right if over_gaps else layers.right
    down = layers.smooth_down if over_gaps else layers.down
    by_col0 = ~across | right[r0, left]  # first along the row of the start
    by_col1 = ~across | right[r1, left]
    by_row0 = ~along | down[top, c0]
    by_row1 = ~along | down[top, c1]
    step = (np.abs(c1 - c0) <= 1) & (np.abs(r1 - r0) <= 1)
    joined = step & ((by_col0 & by_row1) | (by_row0 & by_col1))
    return observed, joined & observed[:, :-1] & observed[:, 1:]
