"""The cloth's surface near every observed point, from noisy points of one view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from vflatten_ros.core.arrays import as_points
from vflatten_ros.core.breaks import Layers, connected_window, find_layers, near_measured
from vflatten_ros.core.config import SurfaceConfig
from vflatten_ros.core.depth_image import depth_image
from vflatten_ros.core.errors import InvalidInput
from vflatten_ros.core.raygrid import RayGrid
from vflatten_ros.core.refinement import settle_borders, sharpen_folds
from vflatten_ros.core.rulings import average_along_rulings
from vflatten_ros.core.smoothing import (
    fill_holes,
    image_of,
    moved_by,
    noise_inflation,
    plane_fits,
    quadratic_sums,
    slope_at,
    tangent_fits,
    value_at,
)
from vflatten_ros.core.values import Bool, Float, Int, Progress, no_progress
from vflatten_ros.core.weighted_planes import linear_fit, view_frame

CHUNK = 4000  # places fitted at a time, so that the arrays stay in the cache
STEEP = 1.7  # grid steps deep for one across: 60 degrees from the view
STEEPEST = 6.0  # grid steps deep for one across: 80 degrees from the view
REACH = 5  # grid steps to each side in a fit in the tangent frame


@dataclass(frozen=True, eq=False)
class Surface:
    """Smoothed surface of one view: points as given, and fits on the grid of its rays."""

    points: Float  # (n, 3) input points moved along their rays onto the surface
    normals: Float  # (n, 3) unit, towards the viewer
    sigma_m: Float  # (n,) one standard deviation of points along the ray
    layer: NDArray[np.int32]  # (n,) piece of the surface that joins without a depth jump
    raw: Float  # (n, 3) input points
    rays: RayGrid
    fits: Float  # (rows, cols, 6) quadratics of depth, see smoothing
    layers: Layers
    sigma_grid_m: Float  # (rows, cols) standard deviation of depth along the ray
    noise_m: float  # standard deviation of the input along the ray
    spacing_m: float  # distance of grid lines across the rays
    toward: Float  # (3,) unit, mean direction to the viewer
    config: SurfaceConfig


def fit_surface(
    points: Float,
    config: SurfaceConfig,
    toward: Float,
    pixel: NDArray[np.int32] | None = None,
    shape: tuple[int, int] | None = None,
    progress: Progress = no_progress,
) -> Surface:
    """Smooth the points of one view and find the surface between them.

    Parameters
    ----------
    points : ndarray of shape (n, 3)
        Observed points, metres, any frame.
    config : SurfaceConfig
        Fit and radius.
    toward : ndarray of shape (3,) or (n, 3)
        Direction from the points to the viewer.
    pixel : ndarray of shape (n, 2), optional
        Row and column of each point, for organised clouds.
    shape : (int, int), optional
        Rows and columns of the cloud.

    Returns
    -------
    Surface

    Raises
    ------
    InvalidInput
        Wrong shapes, values that are not finite, or fewer than 6 points.
    """
    points = as_points(points, "points")
    if len(points) < 6:
        raise InvalidInput(f"points: expected at least 6 to fit a surface, got {len(points)}")
    toward = np.broadcast_to(np.asarray(toward, float), points.shape)
    rays, rc, image, seen = depth_image(points, toward, pixel, shape, config.radius_m / 1.75)
    progress("surface", 0.2)
    cell = rays.spacing(float(np.median(image[seen])))
    width = max(config.radius_m / 1.75 / cell, 1.2)
    sums = quadratic_sums(image, seen, near_measured(seen), width)
    fits, gain = image_of(sums, seen.shape)
    noise = 1.4826 * float(np.median(np.abs(image - fits[..., 0])[seen]))
    places = np.moveaxis(np.indices(seen.shape), 0, -1).astype(float)
    measured = rays.to_points(places, image)
    steepness = np.sqrt(1 + (fits[..., 1] ** 2 + fits[..., 2] ** 2) / cell**2)
    misfit = (image - fits[..., 0]) / steepness
    layers = find_layers(image, seen, measured, cell, noise, misfit)
    progress("surface", 0.5)
    cut = _beside_cuts(layers)
    near_cut = maximum_filter(cut, 2 * int(np.ceil(2 * width)) + 1)
    steep = np.hypot(fits[..., 1], fits[..., 2]) > STEEP * cell
    special = layers.valid & ~layers.bridged & (near_cut | steep)
    if config.fit == "linear":
        fits = _linear_fits(points, toward, rays, layers, measured, fits, cell, config.radius_m)
    else:
        usable = layers.valid & ~layers.bridged
        fits, gain = settle_borders(fits, gain, sums, usable & ~special, noise)
        _refit(rays, layers, image, measured, special, width * cell, fits, gain, noise)
        _mend_cliffs(layers, fits, cell)
        variance = noise**2 * gain * noise_inflation(image - fits[..., 0], seen, width)
        if config.along_rulings:
            fits, variance = average_along_rulings(fits, variance, layers, cell, width * cell)
        fits = sharpen_folds(fits, variance, usable, special | near_cut, width)
        gain = variance / max(noise, 1e-12) ** 2
    fits = fill_holes(fits, layers.valid & ~layers.bridged, layers.bridged)
    progress("surface", 0.9)
    return _assemble(
        points, toward, rays, rc, fits, layers, noise * np.sqrt(gain), noise, cell, config
    )


def _assemble(
    points: Float, toward: Float, rays: RayGrid, rc: Float, fits: Float, layers: Layers,
    sigma: Float, noise: float, cell: float, config: SurfaceConfig,
) -> Surface:  # fmt: skip
    at = tuple(np.round(rc).astype(int).T)
    offset = rc - np.round(rc)
    depth, slope = value_at(fits[at], offset), slope_at(fits[at], offset)
    normals = np.cross(*rays.tangents(rc, depth, slope))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mean = toward.mean(axis=0)
    normals *= np.where(np.einsum("ij,ij->i", normals, toward) < 0, -1.0, 1.0)[:, None]
    return Surface(
        rays.to_points(rc, depth), normals, sigma[at], layers.label[at], points, rays, fits, layers,
        sigma, noise, cell, mean / np.linalg.norm(mean), config,
    )  # fmt: skip


def _beside_cuts(layers: Layers) -> Bool:
    """Places from which a jump parts the next."""
    cut = np.zeros(layers.valid.shape, bool)
    cut[:, :-1] |= layers.valid[:, :-1] & layers.valid[:, 1:] & ~layers.smooth_right[:, :-1]
    cut[:-1] |= layers.valid[:-1] & layers.valid[1:] & ~layers.smooth_down[:-1]
    return cut


def _mend_cliffs(layers: Layers, fits: Float, cell: float) -> None:
    """Where a fit mixes two layers, put the gentlest fit that it is joined to.

    Such a fit is steeper than 80 degrees and does not meet those of its neighbours half way.
    """
    steepness = np.hypot(fits[..., 1], fits[..., 2]) / cell
    wild = np.zeros(steepness.shape, bool)
    gentlest = np.full(steepness.shape, STEEPEST)
    mended = fits.copy()
    right, down = layers.right[:, :-1], layers.down[:-1]
    for tied, here, there, to in (
        (right, np.s_[:, :-1], np.s_[:, 1:], (0, 1)),
        (right, np.s_[:, 1:], np.s_[:, :-1], (0, -1)),
        (down, np.s_[:-1], np.s_[1:], (1, 0)),
        (down, np.s_[1:], np.s_[:-1], (-1, 0)),
    ):
        way = np.array(to, float)
        apart = np.abs(value_at(fits[here], way / 2) - value_at(fits[there], -way / 2)) > cell
        wild[here] |= tied & apart & (steepness[here] > STEEPEST)
        better = tied & (steepness[there] < gentlest[here])
        gentlest[here][better] = steepness[there][better]
        mended[here][better] = moved_by(fits[there][better], -way)
    put = wild & (gentlest < STEEPEST)
    fits[put] = mended[put]


def _refit(
    rays: RayGrid,
    layers: Layers,
    image: Float,
    measured: Float,
    special: Bool,
    width_m: float,
    fits: Float,
    gain: Float,
    noise_m: float,
) -> None:
    """Replace fits and gain at special places by fits in the local tangent frame."""
    rows, cols = np.nonzero(special)
    wide = special.shape[1] + 2 * REACH
    pad = ((REACH, REACH), (REACH, REACH))
    points = np.pad(measured, (*pad, (0, 0))).reshape(-1, 3).T.copy()
    moved = _onto_fits(rays, layers.seen, image, measured, fits, noise_m)
    clean = np.pad(moved, (*pad, (0, 0))).reshape(-1, 3).T.copy()
    seen = np.pad(layers.seen, pad).ravel()
    span = np.arange(-REACH, REACH + 1)
    offsets = (span[:, None] * wide + span).reshape(-1, 1)
    for k in range(0, len(rows), CHUNK):
        r, c = rows[k : k + CHUNK], cols[k : k + CHUNK]
        window = offsets + (r + REACH) * wide + c + REACH
        near = connected_window(layers, r, c, REACH).reshape(window.shape) & seen[window]
        source = moved.reshape(-1, 3)[layers.source[r, c]].T
        rc = np.stack([r, c], axis=1).astype(float)
        fit, variance, good = tangent_fits(rays, rc, points, clean, window, near, source, width_m)
        fits[r[good], c[good]] = fit[good]
        gain[r[good], c[good]] = variance[good]


def _onto_fits(
    rays: RayGrid, seen: Bool, image: Float, measured: Float, fits: Float, noise_m: float
) -> Float:
    """Measured points moved along their rays onto the fits, where these are not far."""
    places = np.moveaxis(np.indices(seen.shape), 0, -1).astype(float)
    close = seen & (np.abs(image - fits[..., 0]) < 4 * noise_m)
    return np.where(close[..., None], rays.to_points(places, fits[..., 0]), measured)


def _linear_fits(
    points: Float, toward: Float, rays: RayGrid, layers: Layers, measured: Float, fits: Float,
    cell: float, radius_m: float,
) -> Float:  # fmt: skip
    """The paper's planes z(x, y) at the grid places, where enough points are near."""
    frame = view_frame(toward.mean(axis=0))
    local = points @ frame.T
    at = measured.reshape(-1, 3)[layers.source[layers.valid]] @ frame.T
    most = int(3.3 * (radius_m / cell) ** 2) + 12
    z, normal, supported = linear_fit(local, cKDTree(local[:, :2]), at[:, :2], radius_m, most)
    foot = np.concatenate([at[:, :2], z[:, None]], axis=1) @ frame
    planes = plane_fits(rays, np.argwhere(layers.valid).astype(float), foot, normal @ frame)
    out = fits.copy()
    out[layers.valid] = np.where(supported[:, None], planes, fits[layers.valid])
    return out


def depth_at(surface: Surface, rc: Float) -> tuple[Float, Float, Bool]:
    """Depth and slope of the surface between grid places, and whether it is observed there.

    The quadratics of the four grid places around blend with smooth weights; places that a jump
    separates from the nearest one do not count.

    Parameters
    ----------
    rc : ndarray of shape (k, 2)
        Grid places.

    Returns
    -------
    depth (k,), slope (k, 2), observed (k,)
    """
    rows, cols = surface.layers.valid.shape
    base = np.clip(np.floor(rc), 0, (rows - 2, cols - 2))
    f = np.clip(rc - base, 0.0, 1.0)
    corner = base.astype(np.int64) @ np.array([cols, 1])
    joined = _corners(surface.layers, corner, f > 0.5)
    smooth, rate = f * f * (3 - 2 * f), 6 * f * (1 - f)
    by_row, by_col = ((1 - smooth[:, 0], smooth[:, 0]), (1 - smooth[:, 1], smooth[:, 1]))
    flat = surface.fits.reshape(-1, 6)
    top, mass = np.zeros(len(rc)), np.full(len(rc), 1e-300)
    d_top, d_mass = np.zeros((len(rc), 2)), np.zeros((len(rc), 2))
    for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        w = by_row[i] * by_col[j] * joined[k]
        dw = np.stack(
            [(2 * i - 1) * rate[:, 0] * by_col[j], (2 * j - 1) * rate[:, 1] * by_row[i]], 1
        )
        dw *= joined[k][:, None]
        fit, offset = flat[corner + i * cols + j], rc - base - (i, j)
        value = value_at(fit, offset)
        top += w * value
        d_top += dw * value[:, None] + w[:, None] * slope_at(fit, offset)
        mass += w
        d_mass += dw
    depth = top / mass
    slope = (d_top - depth[:, None] * d_mass) / mass[:, None]
    observed = mass > 1e-9
    lost = ~observed  # as deep as the nearest measured place
    depth[lost] = flat[surface.layers.source.ravel()[corner[lost]], 0]
    slope[lost] = 0.0
    return depth, slope, observed


def _corners(layers: Layers, corner: Int, far: Bool) -> Bool:
    """(4, k) which corners of its cell are joined to the corner nearest to each place."""
    cols = layers.valid.shape[1]
    valid, right, down = layers.valid.ravel(), layers.right.ravel(), layers.down.ravel()
    top, bottom = right[corner], right[corner + cols]
    left, side = down[corner], down[corner + 1]
    here = [valid[corner], valid[corner + 1], valid[corner + cols], valid[corner + cols + 1]]
    across = np.where(far[:, 0], bottom, top)
    along = np.where(far[:, 1], side, left)
    beyond = (across & np.where(far[:, 1], left, side)) | (along & np.where(far[:, 0], top, bottom))
    nearest = 2 * far[:, 0].astype(int) + far[:, 1]
    out = np.zeros((4, len(corner)), bool)
    k = np.arange(len(corner))
    own = np.stack(here)[nearest, k]
    out[nearest, k] = own
    out[nearest ^ 1, k] = own & across
    out[nearest ^ 2, k] = own & along
    out[nearest ^ 3, k] = own & beyond
    # nearest corner unobserved: the others carry the surface a little over its border
    return np.where(own, out, np.stack(here))
