"""Averaging along the rulings of the cloth.

Cloth hardly stretches, so it is locally developable: through almost every point runs a straight
line of the surface, the ruling, along which the tangent plane stays the same. Averaging along it
removes noise without rounding the folds off. How far it is straight differs from place to place
and is judged from the data: windows of several lengths are compared, and each counts by its
estimated error.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from vflatten_ros.core.breaks import Layers
from vflatten_ros.core.geometry import Float
from vflatten_ros.core.smoothing import slope_at, value_at
from vflatten_ros.core.values import Bool, Int

WINDOWS_M = (0.006, 0.012, 0.024, 0.040)  # standard deviations of the weight along a ruling
STEP_M = 0.006
REACH = 12  # samples to each side
DIRECTION_M = 0.015  # the direction is averaged over so much, standard deviation
AGREE_M = 0.02  # windows are judged over so much, standard deviation
CHUNK = 20000


def average_along_rulings(
    fits: Float, variance: Float, layers: Layers, cell_m: float, width_m: float
) -> tuple[Float, Float]:
    """Fits averaged along the rulings.

    Parameters
    ----------
    fits : ndarray of shape (rows, cols, 6)
        Quadratics of depth, see smoothing.
    variance : ndarray of shape (rows, cols)
        Of their depth, square metres.
    layers : Layers
    cell_m : float
        Distance of grid lines across the rays.
    width_m : float
        Standard deviation of the weight that the fits were made with.

    Returns
    -------
    fits, variance : as given
    """
    rows, cols = np.nonzero(layers.valid & ~layers.bridged)
    direction = ruling_directions(fits, layers, cell_m)[rows, cols]
    estimates = np.empty((len(WINDOWS_M), len(rows), 6))
    spread = np.empty((len(WINDOWS_M), len(rows)))
    inflation = _correlated(width_m)
    for k in range(0, len(rows), CHUNK):
        part = slice(k, k + CHUNK)
        estimates[:, part], spread[:, part] = _windows(
            fits, variance, layers, rows[part], cols[part], direction[part], cell_m, inflation
        )
    return _blend(fits, variance, rows, cols, estimates, spread, cell_m)


def ruling_directions(fits: Float, layers: Layers, cell_m: float) -> Float:
    """(rows, cols, 2) unit grid direction of least curvature, averaged over the surroundings."""
    steepness = 1 + (fits[..., 1] ** 2 + fits[..., 2] ** 2) / cell_m**2
    bend = np.stack([2 * fits[..., 3], fits[..., 4], 2 * fits[..., 5]]) / steepness**1.5
    bend[:, ~layers.valid | layers.bridged] = 0.0
    a, b, d = bend
    squared = [
        gaussian_filter(m, DIRECTION_M / cell_m, mode="constant", truncate=2.5)
        for m in (a * a + b * b, (a + d) * b, b * b + d * d)
    ]
    angle = 0.5 * np.arctan2(2 * squared[1], squared[0] - squared[2])
    return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)


def _correlated(width_m: float) -> float:
    """By how much neighbouring samples' common noise raises the variance of their mean."""
    k = np.arange(1, REACH + 1)
    return float(1 + 2 * np.exp(-((k * STEP_M) ** 2) / (4 * width_m**2)).sum())


def _windows(
    fits: Float, variance: Float, layers: Layers, rows: Int, cols: Int, direction: Float,
    cell_m: float, inflation: float,
) -> tuple[Float, Float]:  # fmt: skip
    """(windows, k, 6) estimates of the fits and (windows, k) variances of their depth."""
    count = len(rows)
    own = fits[rows, cols]
    along = np.einsum("ki,ki->k", own[:, 1:3], direction)
    stride = STEP_M / np.hypot(cell_m, along)  # grid steps a sample
    sums = np.zeros((len(WINDOWS_M), 5, count))  # of w, w t, w t^2, w^2, w^2 t ... see below
    values = np.zeros((len(WINDOWS_M), 2, count, 6))
    own_variance = np.maximum(variance[rows, cols], 1e-18)
    for side in (1, -1):
        free = np.ones(count, bool)
        before = own[:, 0]
        for k in range(0 if side > 0 else 1, REACH + 1):
            sample, weight, free, before = _sample(
                fits, variance, layers, rows, cols, direction, stride * side * k, free, before,
                along * stride * side, own_variance, cell_m,
            )  # fmt: skip
            t = side * k * STEP_M
            for i, window in enumerate(WINDOWS_M):
                fall = np.exp(-0.5 * (t / window) ** 2)
                if fall < 0.01:
                    continue
                w = fall * weight
                sums[i, 0] += w
                sums[i, 1] += w * t
                sums[i, 2] += w * t * t
                sums[i, 3] += w * fall
                sums[i, 4] += w * fall * t
                values[i, 0] += w[:, None] * sample
                values[i, 1] += (w * t)[:, None] * sample
    return _straight(own, own_variance, sums, values, inflation)


def _sample(
    fits: Float, variance: Float, layers: Layers, rows: Int, cols: Int, direction: Float,
    distance: Float, free: Bool, before: Float, rise: Float, own_variance: Float, cell_m: float,
) -> tuple[Float, Float, Bool, Float]:  # fmt: skip
    """Fits some way along the rulings, their weights, and whether the way there is one surface."""
    r, c = rows + distance * direction[:, 0], cols + distance * direction[:, 1]
    i = np.clip(np.round(r).astype(np.int64), 0, fits.shape[0] - 1)
    j = np.clip(np.round(c).astype(np.int64), 0, fits.shape[1] - 1)
    fit = fits[i, j]
    offset = np.stack([r - i, c - j], axis=1)
    sample = fit.copy()
    sample[:, 0] = value_at(fit, offset)
    sample[:, 1:3] = slope_at(fit, offset)
    free = free & layers.valid[i, j] & ~layers.bridged[i, j]
    if distance.any():
        step = np.abs(sample[:, 0] - before - rise)
        free &= step < 0.5 * (cell_m + np.abs(rise))
    weight = free * np.minimum(own_variance / np.maximum(variance[i, j], 1e-18), 4.0)
    return sample, weight, free, sample[:, 0]


def _straight(
    own: Float, own_variance: Float, sums: Float, values: Float, inflation: float
) -> tuple[Float, Float]:
    """Value at the place itself of the line through the samples, by least squares."""
    s0, s1, s2, q0, _ = sums.swapaxes(0, 1)
    determinant = s0 * s2 - s1 * s1
    enough = determinant > 1e-3 * s0 * s2
    safe = np.where(enough, determinant, 1.0)
    line = (s2[..., None] * values[:, 0] - s1[..., None] * values[:, 1]) / safe[..., None]
    estimates = np.where(enough[..., None], line, own)
    # variance of the line's value: that of the mean, times how far the place is from the middle
    lever = s0 * s2 / safe
    share = inflation * q0 / np.maximum(s0, 1e-30) ** 2 * lever
    return estimates, np.where(enough, np.minimum(share, 1.0), 1.0) * own_variance


def _blend(
    fits: Float,
    variance: Float,
    rows: Int,
    cols: Int,
    estimates: Float,
    spread: Float,
    cell_m: float,
) -> tuple[Float, Float]:
    """Each window counts by the inverse square of its squared error: bias, from the data, and noise."""
    own, own_variance = fits[rows, cols], variance[rows, cols]
    mass = np.zeros(variance.shape)
    mass[rows, cols] = 1.0
    near = AGREE_M / cell_m
    mass = gaussian_filter(mass, near, mode="constant", truncate=2.5)[rows, cols]
    weight = 1.0 / np.maximum(own_variance, 1e-18) ** 2
    total, value, noise = weight.copy(), weight[:, None] * own, weight * own_variance
    for k in range(len(estimates)):
        image = np.zeros(variance.shape)
        excess = (estimates[k, :, 0] - own[:, 0]) ** 2 - np.maximum(own_variance - spread[k], 0)
        image[rows, cols] = excess
        bias = gaussian_filter(image, near, mode="constant", truncate=2.5)[rows, cols] / mass
        error = np.maximum(np.maximum(bias, 0.0) + spread[k], 1e-18)
        weight = 1.0 / error**2
        total += weight
        value += weight[:, None] * estimates[k]
        noise += weight * error
    out, out_variance = fits.copy(), variance.copy()
    out[rows, cols] = value / total[:, None]
    out_variance[rows, cols] = noise / total
    return out, out_variance
