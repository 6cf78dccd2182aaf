"""Quadratic fits of a depth image made better by what other fits around them say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter

from vflatten_ros.core.smoothing import Sums, quadratic_image
from vflatten_ros.core.values import Bool, Float

POOR = 1.3  # times the usual variance: fits with measured places on one side only
CHANGE = 0.12  # squared change of curvature over a fit's width, of squared curvature
NEAR = 2.0  # times the fit's width: what is around a fit
NOISE_SHARE = 0.02  # of the depth's variance that a fit of fitted depths takes away again


def settle_borders(
    fits: Float, gain: Float, sums: Sums, usable: Bool, noise_m: float
) -> tuple[Float, Float]:
    """Fits at borders held to the curvature of the cloth beside them.

    Parameters
    ----------
    fits : ndarray of shape (rows, cols, 6)
    gain : ndarray of shape (rows, cols)
        Variance of the fitted depth over that of a measured one.
    sums : Sums
        That the fits were solved from.
    usable : ndarray of shape (rows, cols)
        Fits of one surface alone.
    noise_m : float
        Standard deviation of a measured depth.

    Returns
    -------
    fits, gain : as given, with those at borders solved anew
    """
    if not usable.any():
        return fits, gain
    typical = float(np.median(gain[usable]))
    poor = usable & (gain > POOR * typical)
    # the curvature of a one-sided fit is much less sure than its depth
    sure = np.where(usable, np.minimum(typical / np.maximum(gain, 1e-9), 1.0) ** 4, 0.0)
    mass = np.maximum(_around(sure, sums.width), 1e-9)
    bend = np.moveaxis(fits[..., 3:], 2, 0) * sums.width**2
    mean = np.stack([_around(sure * b, sums.width) / mass for b in bend], axis=-1)
    spread = CHANGE * _around(sure * (bend**2).sum(axis=0), sums.width) / mass
    few = sums.part(poor[sums.place])
    hold = noise_m**2 / np.maximum(spread[few.place], 1e-12)
    normal, right = few.normal.copy(), few.right.copy()
    for i in range(3):
        normal[:, 3 + i, 3 + i] += hold
        right[:, 3 + i] += hold * mean[few.place][:, i]
    out, out_gain = fits.copy(), gain.copy()
    out[few.place], out_gain[few.place] = replace(few, normal=normal, right=right).solved()
    return out, out_gain


def sharpen_folds(fits: Float, variance: Float, usable: Bool, mixed: Bool, width: float) -> Float:
    """Give folds back the height that fitting took from them.

    Fitting the fitted depths again shows what a fit takes away (Tukey's twicing); as much is put
    back where that is more than noise.

    Parameters
    ----------
    fits : ndarray of shape (rows, cols, 6)
    variance : ndarray of shape (rows, cols)
        Of their depth, square metres.
    usable : ndarray of shape (rows, cols)
        Places with a fit.
    mixed : ndarray of shape (rows, cols)
        Places whose fit was made otherwise, or from which a jump is not far.
    width : float
        Standard deviation of the fit's weight, grid steps.
    """
    inside = usable & ~mixed & ~maximum_filter(~usable, 2 * round(1.5 * width) + 1)
    if not inside.any():
        return fits
    missing = fits - quadratic_image(fits[..., 0], usable, usable, width)[0]
    mass = np.maximum(_around(inside.astype(float), width), 1e-9)
    square = _around(np.where(inside, missing[..., 0] ** 2, 0.0), width) / mass
    noise = NOISE_SHARE * _around(np.where(inside, variance, 0.0), width) / mass
    share = np.clip(1.0 - noise / np.maximum(square, 1e-18), 0.0, 1.0) * inside
    return np.asarray(fits + share[..., None] * missing)


def _around(image: Float, width: float) -> Float:
    return np.asarray(gaussian_filter(image, NEAR * width, mode="constant", truncate=2.5))
