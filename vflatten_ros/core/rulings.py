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

WINDOWS_M = (0.006, 0.012, 0.024, 0.045, 0.08)  # standard deviations of the weight along a ruling
STEP_M = 0.008
REACH = 16  # samples to each side
DIRECTION_M = 0.015  # the direction is averaged over so much, standard deviation
AGREE_M = 0.02  # windows are judged over so much, standard deviation
CHUNK = 4000
SIGMAS = 2.0  # of the noise by which a sample may lie off the way and still be of one surface


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
    usable = layers.valid & ~layers.bridged
    rows, cols = np.nonzero(usable)
    direction = ruling_directions(fits, variance, layers, cell_m)[rows, cols]
    estimates = np.empty((len(WINDOWS_M), len(rows), 6))
    spread = np.empty((len(WINDOWS_M), len(rows)))
    inflation = _correlated(width_m)
    for k in range(0, len(rows), CHUNK):
        part = slice(k, k + CHUNK)
        estimates[:, part], spread[:, part] = _windows(
            fits, variance, usable, rows[part], cols[part], direction[part], cell_m, inflation
        )
    return _blend(fits, variance, rows, cols, estimates, spread, cell_m)


def ruling_directions(fits: Float, variance: Float, layers: Layers, cell_m: float) -> Float:
    """(rows, cols, 2) unit grid direction of least curvature, averaged over the surroundings."""
    steepness = 1 + (fits[..., 1] ** 2 + fits[..., 2] ** 2) / cell_m**2
    bend = np.stack([2 * fits[..., 3], fits[..., 4], 2 * fits[..., 5]]) / steepness**1.5
    usable = layers.valid & ~layers.bridged
    bend[:, ~usable] = 0.0
    # curvature is known worst at borders, where it counts least
    typical = float(np.median(variance[usable]))
    sure = np.minimum(typical / np.maximum(variance, 1e-18), 1.0) ** 4
    a, b, d = bend
    squared = [
        gaussian_filter(sure * m, DIRECTION_M / cell_m, mode="constant", truncate=2.5)
        for m in (a * a + b * b, (a + d) * b, b * b + d * d)
    ]
    angle = 0.5 * np.arctan2(2 * squared[1], squared[0] - squared[2])
    return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)


def _correlated(width_m: float) -> float:
    """By how much neighbouring samples' common noise raises the variance of their mean."""
    k = np.arange(1, REACH + 1)
    return float(1 + 2 * np.exp(-((k * STEP_M) ** 2) / (4 * width_m**2)).sum())


def _windows(
    fits: Float, variance: Float, usable: Bool, rows: Int, cols: Int, direction: Float,
    cell_m: float, inflation: float,
) -> tuple[Float, Float]:  # fmt: skip
    """(windows, k, 6) estimates of the fits and (windows, k) variances of their depth."""
    own = fits[rows, cols]
    own_variance = np.maximum(variance[rows, cols], 1e-18)
    rise = own[:, 1] * direction[:, 0] + own[:, 2] * direction[:, 1]
    stride = STEP_M / np.hypot(cell_m, rise)  # grid steps a sample
    samples = np.empty((2 * REACH + 1, len(rows), 6))
    weights = np.empty((2 * REACH + 1, len(rows)))
    flat = fits.reshape(-1, 6), variance.ravel(), usable.ravel()
    for side in (1, -1):
        free = np.ones(len(rows), bool)
        before = own[:, 0]
        for k in range(0 if side > 0 else 1, REACH + 1):
            distance = stride * (side * k)
            at, offset = _nearest(usable.shape, rows, cols, direction, distance)
            fit = flat[0].take(at, axis=0)
            fit[:, 0], slope = value_at(fit, offset), slope_at(fit, offset)
            fit[:, 1:3] = slope
            step = rise * stride * side if k else 0.0
            # the way there is one surface as long as depth goes on as it began
            doubt = own_variance + flat[1].take(at)
            limit = 0.5 * (cell_m + np.abs(step)) + SIGMAS * np.sqrt(doubt)
            free &= np.abs(fit[:, 0] - before - step) < limit
            free &= flat[2].take(at)
            before = fit[:, 0]
            weight = free * np.minimum(own_variance / np.maximum(flat[1].take(at), 1e-18), 4.0)
            weights[REACH + side * k] = weight
            np.multiply(fit, weight[:, None], out=samples[REACH + side * k])
    return _straight(own, own_variance, samples, weights, inflation)


def _nearest(
    shape: tuple[int, ...], rows: Int, cols: Int, direction: Float, distance: Float
) -> tuple[Int, Float]:
    """Flat index of the grid place nearest to some way along the rulings, and the way from it."""
    r, c = rows + distance * direction[:, 0], cols + distance * direction[:, 1]
    i, j = np.rint(r), np.rint(c)
    np.clip(i, 0, shape[0] - 1, out=i)
    np.clip(j, 0, shape[1] - 1, out=j)
    return (i * shape[1] + j).astype(np.int64), np.stack([r - i, c - j], axis=1)


def _straight(
    own: Float, own_variance: Float, samples: Float, weights: Float, inflation: float
) -> tuple[Float, Float]:
    """Value at the place itself of the line through the samples, by least squares.

    `samples` are weighted already.
    """
    t = np.arange(-REACH, REACH + 1) * STEP_M
    fall = np.exp(-0.5 * (t / np.array(WINDOWS_M)[:, None]) ** 2)  # (windows, samples)
    count, size = len(own), len(t)
    s0, s1, s2, q0 = (f @ weights for f in (fall, fall * t, fall * t * t, fall * fall))
    flat = samples.reshape(size, -1)
    v0, v1 = (f @ flat for f in (fall, fall * t))
    determinant = s0 * s2 - s1 * s1
    enough = determinant > 1e-3 * s0 * s2
    safe = np.where(enough, determinant, 1.0)
    line = (s2 / safe)[..., None] * v0.reshape(-1, count, 6)
    line -= (s1 / safe)[..., None] * v1.reshape(-1, count, 6)
    # variance of the line's value: that of the mean, times how far the place is from the middle
    share = inflation * q0 / np.maximum(s0, 1e-30) ** 2 * (s0 * s2 / safe)
    spread = np.where(enough, np.minimum(share, 1.0), 1.0) * own_variance
    return np.where(enough[..., None], line, own), spread


def _blend(
    fits: Float,
    variance: Float,
    rows: Int,
    cols: Int,
    estimates: Float,
    spread: Float,
    cell_m: float,
) -> tuple[Float, Float]:
    """Each window counts by its inverse squared error: of noise, and of bias that the data show."""
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
