"""Local quadratic fits of a noisy depth image.

A fit is six numbers at a grid place: depth, its slopes by row and column, and the terms of
row**2, row * col and col**2, in grid steps from the place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import correlate1d
from scipy.sparse import csr_matrix, identity, vstack
from scipy.sparse.linalg import spsolve

from vflatten_ros.core.geometry import Float
from vflatten_ros.core.raygrid import RayGrid
from vflatten_ros.core.values import Bool, Int

OBLIQUE = 0.6  # cosine of the angle to the rays below which fits become wider
WIDEST = 2.5
# second differences by row, by column and mixed (twice in the bending energy)
BENDING = (
    (((-1, 0), (0, 0), (1, 0)), (1.0, -2.0, 1.0)),
    (((0, -1), (0, 0), (0, 1)), (1.0, -2.0, 1.0)),
    (((0, 0), (0, 1), (1, 0), (1, 1)), (1.41421, -1.41421, -1.41421, 1.41421)),
)
POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))


def value_at(fit: Float, offset: Float) -> Float:
    """Depth of (..., 6) fits at (..., 2) grid steps from their places."""
    r, c = offset[..., 0], offset[..., 1]
    out: Float = (
        fit[..., 0] + fit[..., 1] * r + fit[..., 2] * c
        + fit[..., 3] * r * r + fit[..., 4] * r * c + fit[..., 5] * c * c
    )  # fmt: skip
    return out


def slope_at(fit: Float, offset: Float) -> Float:
    """(..., 2) change of depth a row and a column."""
    r, c = offset[..., 0], offset[..., 1]
    by_row = fit[..., 1] + 2 * fit[..., 3] * r + fit[..., 4] * c
    by_col = fit[..., 2] + fit[..., 4] * r + 2 * fit[..., 5] * c
    return np.stack([by_row, by_col], axis=-1)


def moved_by(fit: Float, offset: Float) -> Float:
    """The same surfaces as (..., 6) fits at (..., 2) grid steps from their places."""
    out = fit.copy()
    out[..., 0] = value_at(fit, offset)
    out[..., 1:3] = slope_at(fit, offset)
    return out


@dataclass(frozen=True, eq=False)
class Sums:
    """Normal equations of Gaussian-weighted quadratics, in units of the weight's width."""

    normal: Float  # (k, 6, 6)
    right: Float  # (k, 6) of depth less `level`
    place: tuple[Int, Int]  # rows and columns
    level: float
    width: float  # standard deviation of the weight, grid steps

    def part(self, keep: Bool) -> Sums:
        """Those of some of the places; `keep` is (k,)."""
        rows, cols = self.place
        place = (rows[keep], cols[keep])
        return replace(self, normal=self.normal[keep], right=self.right[keep], place=place)

    def solved(self) -> tuple[Float, Float]:
        """(k, 6) fits in grid steps, (k,) variance of their depth over that of a measured one."""
        fits, gain = _solve(self.normal, self.right)
        fits /= self.width ** np.array([0, 1, 1, 2, 2, 2])
        fits[:, 0] += self.level
        return fits, gain


def quadratic_image(depth: Float, seen: Bool, where: Bool, width: float) -> tuple[Float, Float]:
    """Gaussian-weighted quadratic of the depth image by separable sums.

    Parameters
    ----------
    depth : ndarray of shape (rows, cols)
        Depth, any value where not seen.
    seen, where : ndarray of shape (rows, cols)
        Measured places, and places that want a fit.
    width : float
        Standard deviation of the weight in grid steps.

    Returns
    -------
    fits : ndarray of shape (rows, cols, 6)
        Zero outside `where`.
    gain : ndarray of shape (rows, cols)
        Variance of the fitted depth over that of a measured one.
    """
    return image_of(quadratic_sums(depth, seen, where, width), seen.shape)


def image_of(sums: Sums, shape: tuple[int, ...]) -> tuple[Float, Float]:
    """The solved fits and their gain as images, zero elsewhere."""
    fits, gain = np.zeros((*shape, 6)), np.zeros(shape)
    fits[sums.place], gain[sums.place] = sums.solved()
    return fits, gain


def quadratic_sums(depth: Float, seen: Bool, where: Bool, width: float) -> Sums:
    """Normal equations of `quadratic_image`."""
    reach = int(np.ceil(2.5 * width))
    t = np.arange(-reach, reach + 1) / width
    kernels = [np.exp(-t * t / 2) * t**a for a in range(5)]
    level = float(depth[seen].mean())
    mass = _moments(seen.astype(float), kernels, 4)
    lifted = _moments(np.where(seen, depth - level, 0.0), kernels, 2)
    rows, cols = np.nonzero(where)
    normal = np.empty((len(rows), 6, 6))
    right = np.empty((len(rows), 6))
    for i, (a, b) in enumerate(POWERS):
        right[:, i] = lifted[a, b][rows, cols]
        for j, (c, d) in enumerate(POWERS[: i + 1]):
            normal[:, i, j] = normal[:, j, i] = mass[a + c, b + d][rows, cols]
    return Sums(normal, right, (rows, cols), level, width)


def noise_inflation(residual: Float, seen: Bool, width: float) -> float:
    """By how much the noise's correlation raises the variance of a local fit.

    The noise is taken as a white part and a part with a Gaussian correlation; both and the width
    come from the residuals' correlation at small distances, less a constant that the fit took.

    Parameters
    ----------
    residual : ndarray of shape (rows, cols)
        Measured less fitted depth.
    seen : ndarray of shape (rows, cols)
    width : float
        Standard deviation of the fit's weight, grid steps.
    """
    limit = 4 * float(np.median(np.abs(residual[seen])))
    good = seen & (np.abs(residual) < limit)
    noise = np.where(good, residual, 0.0)
    own = float((noise**2).sum()) / max(int(good.sum()), 1)
    if own <= 0:
        return 1.0
    lags = np.array([(r, c) for r in range(5) for c in range(5) if 0 < r * r + c * c <= 16])
    found = np.array([_product(noise, good, r, c) for r, c in lags]) / own
    squared = (lags**2).sum(axis=1)
    best, inflation = np.inf, 1.0
    for scale in np.arange(0.6, 3.1, 0.2):
        shape = np.stack([np.exp(-squared / (4 * scale**2)), np.ones(len(lags))], axis=1)
        (share, offset), *_ = np.linalg.lstsq(shape, found, rcond=None)
        misfit = float(((shape @ (share, offset) - found) ** 2).sum())
        if misfit < best:
            taken = min(offset, 0.0)
            share = float(np.clip((share + taken) / (1 + taken), 0.0, 1.0))
            spread = 4 * np.pi * scale**2 * width**2 / (width**2 + scale**2)
            best, inflation = misfit, 1 + share * max(spread - 1, 0.0)
    return inflation


def _product(noise: Float, good: Bool, r: int, c: int) -> float:
    """Mean product of values r rows and c columns apart, in both diagonals."""
    rows, cols = noise.shape
    total, count = 0.0, 0
    for c_from, c_to in (
        (slice(0, cols - c), slice(c, cols)),
        (slice(c, cols), slice(0, cols - c)),
    ):
        a, b = (slice(0, rows - r), c_from), (slice(r, rows), c_to)
        total += float((noise[a] * noise[b]).sum())
        count += int((good[a] & good[b]).sum())
    return total / max(count, 1)


def fill_holes(fits: Float, known: Bool, holes: Bool) -> Float:
    """Fits in large holes: the surface of least bending that continues what is known around."""
    if not holes.any():
        return fits
    image = np.where(known, fits[..., 0], 0.0)
    level = image[known].mean()
    number = np.full(holes.shape, -1)
    number[holes] = np.arange(holes.sum())
    bending = []
    right = []
    flat, given, index = image.ravel() - level, known.ravel(), number.ravel()
    for steps, factors in BENDING:
        offset = np.array(steps) @ (holes.shape[1], 1)
        low, high = np.min(steps, axis=0), np.max(steps, axis=0)
        r, c = np.indices(holes.shape).reshape(2, -1)
        fits_in = (r + low[0] >= 0) & (r + high[0] < holes.shape[0])
        fits_in &= (c + low[1] >= 0) & (c + high[1] < holes.shape[1])
        at = np.flatnonzero(fits_in)[:, None] + offset
        use = (index[at] >= 0).any(axis=1) & ((index[at] >= 0) | given[at]).all(axis=1)
        at = at[use]
        free = index[at] >= 0
        row = np.broadcast_to(np.arange(len(at))[:, None], at.shape)
        weights = np.broadcast_to(np.array(factors), at.shape)
        shape = (len(at), int(holes.sum()))
        bending.append(csr_matrix((weights[free], (row[free], index[at][free])), shape=shape))
        right.append(-(weights * np.where(free, 0.0, flat[at])).sum(axis=1))
    a, b = vstack(bending), np.concatenate(right)
    hold = 1e-9 * identity(a.shape[1])
    image[holes] = level + spsolve((a.T @ a + hold).tocsc(), a.T @ b)
    return _differences(fits, image, holes)


def _differences(fits: Float, image: Float, where: Bool) -> Float:
    """Fits from the differences of neighbouring depths."""
    out = fits.copy()
    r, c = np.nonzero(where)
    z = image[r, c]
    up, down, left, right = image[r - 1, c], image[r + 1, c], image[r, c - 1], image[r, c + 1]
    mixed = image[r + 1, c + 1] - image[r + 1, c - 1] - image[r - 1, c + 1] + image[r - 1, c - 1]
    out[r, c] = np.stack(
        [
            z,
            (down - up) / 2,
            (right - left) / 2,
            (up + down) / 2 - z,
            mixed / 4,
            (left + right) / 2 - z,
        ],
        axis=1,
    )
    return out


def _moments(values: Float, kernels: list[Float], order: int) -> dict[tuple[int, int], Float]:
    out = {}
    for a in range(order + 1):
        along = correlate1d(values, kernels[a], axis=0, mode="constant")
        for b in range(order + 1 - a):
            out[a, b] = correlate1d(along, kernels[b], axis=1, mode="constant")
    return out


def _solve(normal: Float, right: Float) -> tuple[Float, Float]:
    """Solutions of small systems, held back where the data do not settle curvature."""
    total = normal[:, 0, 0]
    hold = np.array([1e-9, 1e-6, 1e-6, 3e-3, 3e-3, 3e-3])
    normal = normal + (total[:, None] * hold)[:, :, None] * np.eye(6)
    both = np.zeros((len(right), 6, 2))
    both[:, :, 0] = right
    both[:, 0, 1] = 1.0
    solved = np.linalg.solve(normal, both)
    return solved[:, :, 0], solved[:, 0, 1]


def tangent_fits(
    rays: RayGrid,
    rc: Float,
    points: Float,
    clean: Float,
    window: Int,
    near: Bool,
    middle: Float,
    width_m: float,
) -> tuple[Float, Float, Bool]:
    """Quadratics in the local tangent frame, for steep places and beside jumps.

    Sums run over the window, each term for all places at once: the arrays stay small.

    Parameters
    ----------
    rays : RayGrid
    rc : ndarray of shape (k, 2)
        Grid places of the fits.
    points : ndarray of shape (3, all)
        Measured points.
    clean : ndarray of shape (3, all)
        The same, moved along their rays to where the surface is thought to be. They say where in
        the tangent plane a point lies: by the measured places themselves noise would move points
        within the plane too, and steep borders would come out too steep.
    window : ndarray of shape (n, k)
        Which of them are around each place.
    near : ndarray of shape (n, k)
        Which of those count.
    middle : ndarray of shape (3, k)
        Clean point nearest to each place.
    width_m : float
        Standard deviation of the weight along the surface, metres.

    Returns
    -------
    fits (k, 6), gain (k,), good (k,)
    """
    axes = _principal_axes(clean, window, near, middle, 1.5 * width_m)
    width = width_m * _widening(rays, rc, axes[2])
    normal = np.zeros((6, 6, len(rc)))
    right = np.zeros((6, len(rc)))
    for at, counts in zip(window, near):
        away = (clean[:, at] - middle) / width
        u, v = (a[0] * away[0] + a[1] * away[1] + a[2] * away[2] for a in axes[:2])
        away = (points[:, at] - middle) / width
        w = axes[2][0] * away[0] + axes[2][1] * away[1] + axes[2][2] * away[2]
        weight = np.exp(-0.5 * (u * u + v * v)) * counts
        basis = (weight, weight * u, weight * v, weight * u * u, weight * u * v, weight * v * v)
        plain = (1.0, u, v, u * u, u * v, v * v)
        for i in range(6):
            right[i] += basis[i] * w
            for j in range(i + 1):
                normal[i, j] += basis[i] * plain[j]
    for i in range(6):
        for j in range(i):
            normal[j, i] = normal[i, j]
    normal[0, 0] += 1e-9
    surface, gain = _solve(np.moveaxis(normal, 2, 0), right.T)
    return _to_rays(rays, rc, middle.T, np.moveaxis(axes, 2, 0), surface, width, gain)


def _widening(rays: RayGrid, rc: Float, normal: Float) -> Float:
    """(k,) how much wider fits are where the rays hit the surface, and so sample it, obliquely."""
    ray = rays.rays(rc)
    cosine = np.abs(np.einsum("ik,ki->k", normal, ray)) / np.linalg.norm(ray, axis=1)
    return np.asarray(np.clip(OBLIQUE / np.maximum(cosine, 1e-9), 1.0, WIDEST))


def plane_fits(rays: RayGrid, rc: Float, foot: Float, normal: Float) -> Float:
    """(k, 6) fits of planes through (k, 3) feet with (k, 3) normals at (k, 2) grid places."""
    ray = rays.rays(rc)
    base = rays.to_points(rc, np.zeros(len(rc)))
    facing = np.einsum("ki,ki->k", normal, ray)
    depth = np.einsum("ki,ki->k", normal, foot - base) / facing
    d_row = rays.e_row + depth[:, None] * rays.ray_row
    d_col = rays.e_col + depth[:, None] * rays.ray_col
    fits = np.zeros((len(rc), 6))
    fits[:, 0] = depth
    fits[:, 1] = -np.einsum("ki,ki->k", normal, d_row) / facing
    fits[:, 2] = -np.einsum("ki,ki->k", normal, d_col) / facing
    return fits


def _principal_axes(points: Float, window: Int, near: Bool, middle: Float, width_m: float) -> Float:
    """(3, 3, k) axes by component: two tangents and the normal."""
    count = middle.shape[1]
    total, mean = np.full(count, 1e-12), np.zeros((3, count))
    spread = np.zeros((3, 3, count))
    for at, counts in zip(window[::2], near[::2]):  # every other one, as on a chessboard
        away = (points[:, at] - middle) / width_m
        weight = counts * (np.exp(-0.5 * (away[0] ** 2 + away[1] ** 2 + away[2] ** 2)) + 1e-6)
        total += weight
        for i in range(3):
            part = weight * away[i]
            mean[i] += part
            for j in range(i + 1):
                spread[i, j] += part * away[j]
    mean /= total
    for i in range(3):
        for j in range(i + 1):
            spread[i, j] = spread[j, i] = spread[i, j] / total - mean[i] * mean[j]
    _, vectors = np.linalg.eigh(np.moveaxis(spread, 2, 0))
    return np.moveaxis(vectors[:, :, ::-1], (2, 1, 0), (0, 1, 2))


def _to_rays(
    rays: RayGrid,
    rc: Float,
    centre: Float,
    axes: Float,
    surface: Float,
    width_m: Float,
    gain: Float,
) -> tuple[Float, Float, Bool]:
    """Fits as depth along the rays, by implicit differentiation of w - f(u, v) = 0."""
    depth = rays.to_grid(centre)[1]
    good = np.ones(len(rc), bool)
    for _ in range(4):
        gradient, _, value = _implicit(rays, rc, depth, centre, axes, surface, width_m)
        slope = gradient[:, 2]
        steep = np.abs(slope) * width_m < 0.1 * np.linalg.norm(rays.rays(rc), axis=1)
        step = np.where(steep, 0.0, -value / np.where(steep, 1.0, slope))
        depth = depth + np.clip(step, -2 * width_m, 2 * width_m)
        good &= ~steep
    good &= np.abs(step) < 0.05 * width_m
    gradient, hessian, _ = _implicit(rays, rc, depth, centre, axes, surface, width_m)
    by = gradient[:, 2]
    by = np.where(good, by, 1.0)
    g_r, g_c = -gradient[:, 0] / by, -gradient[:, 1] / by
    along_r = np.stack([np.ones_like(g_r), np.zeros_like(g_r), g_r], axis=1)
    along_c = np.stack([np.zeros_like(g_c), np.ones_like(g_c), g_c], axis=1)
    second = [
        -np.einsum("ki,kij,kj->k", a, hessian, b) / by
        for a, b in ((along_r, along_r), (along_r, along_c), (along_c, along_c))
    ]
    fits = np.stack([depth, g_r, g_c, second[0] / 2, second[1], second[2] / 2], axis=1)
    return fits, gain, good


def _implicit(
    rays: RayGrid,
    rc: Float,
    depth: Float,
    centre: Float,
    axes: Float,
    surface: Float,
    width_m: Float,
) -> tuple[Float, Float, Float]:
    """Gradient (k, 3) and Hessian (k, 3, 3) of w - f(u, v) by (row, col, depth), its value."""
    ray = rays.rays(rc)
    p = np.einsum("kij,kj->ki", axes, rays.to_points(rc, depth) - centre) / width_m[:, None]
    d_row = rays.e_row + depth[:, None] * rays.ray_row
    d_col = rays.e_col + depth[:, None] * rays.ray_col
    motion = np.stack([d_row, d_col, ray], axis=2)  # (k, 3, 3) columns: point by row, col, depth
    local = np.matmul(axes, motion) / width_m[:, None, None]
    u, v = p[:, 0], p[:, 1]
    f_u = surface[:, 1] + 2 * surface[:, 3] * u + surface[:, 4] * v
    f_v = surface[:, 2] + surface[:, 4] * u + 2 * surface[:, 5] * v
    f = surface[:, 0] + 0.5 * ((surface[:, 1] + f_u) * u + (surface[:, 2] + f_v) * v)
    gradient = local[:, 2] - f_u[:, None] * local[:, 0] - f_v[:, None] * local[:, 1]
    bend = np.zeros((len(rc), 3, 3))
    bend[:, 0, 0], bend[:, 1, 1] = -2 * surface[:, 3], -2 * surface[:, 5]
    bend[:, 0, 1] = bend[:, 1, 0] = -surface[:, 4]
    hessian = np.matmul(local.swapaxes(1, 2), np.matmul(bend, local))
    return gradient, hessian, p[:, 2] - f
