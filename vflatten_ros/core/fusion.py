"""All views' points -> evenly spread samples of the surface, each on its own layer.

Two layers of cloth may hang a millimetre or two apart. A sample is therefore fitted only to points
whose normals agree with its own and whose height above it lies within a band that narrows as the
fit settles: the other layer drops out instead of being averaged in.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.errors import DisconnectedSurface, NotEnoughViews
from vflatten_ros.core.geometry import tangents
from vflatten_ros.core.parallel import mapped
from vflatten_ros.core.values import Bool, Float, Int, Progress, no_progress

NEIGHBOURS, RADIUS_M, LEAST = 64, 0.007, 12  # most points for a fit of this radius, never fewer
CHUNK = 1024  # samples fitted at a time: they stay in the cache
BANDS = (3.0, 2.0, 1.5)  # height (Gaussian) of the successive fits, in standard deviations
MIN_CELL = 3  # points that make a sample
DRAW = np.array([0.8191725, 0.6710436, 0.5497005])  # steps that fill a cube evenly, in cells


@dataclass(frozen=True, eq=False)
class Points:
    """Registered points of all views, common frame."""

    xyz: Float  # (n, 3)
    normal: Float  # (n, 3) unit, outwards
    view: Int  # (n,) which view each comes from, from 0

    @cached_property
    def tree(self) -> cKDTree:
        """Of xyz."""
        return cKDTree(self.xyz, balanced_tree=False, compact_nodes=False)

    def __reduce__(self) -> tuple[type[Points], tuple[Float, Float, Int]]:
        """Another process makes its own tree."""
        return Points, (self.xyz, self.normal, self.view)


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of the outside of the cloth, hanger frame."""

    xyz: Float  # (n, 3)
    normal: Float  # (n, 3) unit, outwards
    sigma_m: Float  # (n,) standard deviation along the normal
    source: Int  # (n,) row, among all points, of the measured point nearest to the sample
    views: Bool  # (n, view) which views see it


def fuse(
    points: Points,
    config: RotationConfig,
    progress: Progress = no_progress,
    draw: int = 0,
) -> Samples:
    """Samples about `spacing_m` apart on every layer that any view saw.

    Parameters
    ----------
    points : Points
    config : RotationConfig
    progress : Progress
    draw : int
        Added to rotation.draw: another has its grid shifted, and other samples of the surface.

    Raises
    ------
    NotEnoughViews
        There are no points.
    DisconnectedSurface
        They are too far apart.
    """
    progress("fuse", 0.0)
    if not len(points.xyz):
        raise NotEnoughViews("fusion: got no points; take views that show the item")
    start, direction = _cells(points, config.spacing_m, ((config.draw + draw) * DRAW) % 1.0)
    if not len(start):
        raise DisconnectedSurface(
            f"fusion: of {len(points.xyz)} points no {MIN_CELL} lie within "
            f"{1e3 * config.spacing_m:.1f} mm; give denser clouds, or raise rotation.spacing_m"
        )
    firsts = range(0, len(start), CHUNK)

    def fitted(first: int) -> tuple[Float, Float, Float, Int, Bool]:
        some = slice(first, first + CHUNK)
        return _fit(start[some], direction[some], points, config)

    _ = points.tree  # made once, before the threads ask for it
    parts = []
    for part in mapped(fitted, firsts):
        parts.append(part)
        progress("fuse", len(parts) / len(firsts))
    joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
    xyz, normal, sigma, source, seen = joined
    keep = _thinned(xyz, normal, sigma, 0.55 * config.spacing_m)
    return Samples(xyz[keep], normal[keep], sigma[keep], source[keep], seen[keep])


def _cells(points: Points, size_m: float, shift: Float) -> tuple[Float, Float]:
    """Mean point and normal of each cube and direction (of six) that holds enough points.

    Parameters
    ----------
    points : Points
    size_m : float
        Of the cubes.
    shift : ndarray of shape (3,)
        Of their grid, in cubes.
    """
    xyz, normals = points.xyz, points.normal
    lead = np.abs(normals).argmax(1)
    sign = normals[np.arange(len(normals)), lead] > 0
    grid = np.floor((xyz - xyz.min(0)) / size_m + shift).astype(np.int64)
    extent = grid.max(0) + 1
    key = ((grid[:, 0] * extent[1] + grid[:, 1]) * extent[2] + grid[:, 2]) * 6 + 2 * lead + sign
    _, cell, count = np.unique(key, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(cell, column) for column in np.hstack([xyz, normals]).T], axis=1)
    sums = sums[count >= MIN_CELL] / count[count >= MIN_CELL, None]
    direction = sums[:, 3:] / np.linalg.norm(sums[:, 3:], axis=1, keepdims=True)
    return sums[:, :3], direction


def _fit(
    at: Float,
    normal: Float,
    points: Points,
    config: RotationConfig,
) -> tuple[Float, Float, Float, Int, Bool]:
    """Move samples onto their own layer by local fits: planes first, a quadric last."""
    radius, start = config.fit_m, at
    most = max(LEAST, round(NEIGHBOURS * (radius / RADIUS_M) ** 2))
    distance, near = points.tree.query(at, k=most, distance_upper_bound=radius * 1.2)
    found = np.isfinite(distance)
    near = np.where(found, near, 0)
    # a nanometre in a centimetre is enough: half the memory to go through
    around = (points.xyz[near] - start[:, None]).astype(np.float32)
    their_normals = points.normal[near].astype(np.float32)
    for band in BANDS:
        e1, e2 = tangents(normal)
        frame = np.stack([e1, e2, normal], axis=-1).astype(np.float32)
        alike = np.matmul(their_normals, frame[..., 2:])[..., 0] > 0.5
        local = np.matmul(around - (at - start)[:, None].astype(np.float32), frame)
        x, y, height = local[..., 0] / radius, local[..., 1] / radius, local[..., 2]
        off = height / (band * config.noise_m)
        weight = (1 - (x * x + y * y).clip(0, 1)) ** 2 * np.exp(-0.5 * off**2)
        weight = np.where(found & alike, weight, np.float32(0.0))
        basis = [np.ones_like(x), x, y]
        if band == BANDS[-1]:
            basis += [x * x, x * y, y * y]
        design = np.stack(basis, axis=1)  # (n, terms, k)
        weighted = design * weight[:, None]
        matrix = weighted @ design.transpose(0, 2, 1) + 1e-3 * np.eye(len(basis))
        right = (weighted @ height[..., None]).astype(np.float64)
        solved = np.linalg.solve(matrix, right)[..., 0]
        at = at + solved[:, :1] * normal
        normal = normal - (solved[:, 1:2] * e1 + solved[:, 2:3] * e2) / radius
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    sigma = config.noise_m * np.sqrt(1 / np.maximum(weight.sum(1), 0.05))
    inside = np.where(weight > 0.05, distance, np.inf)
    nearest = inside.argmin(1)
    rows = np.arange(len(at))
    source = np.where(np.isfinite(inside[rows, nearest]), near[rows, nearest], -1)
    seen = np.zeros((len(at), int(points.view.max()) + 1), dtype=bool)
    row, column = np.nonzero(weight > 0.3)
    seen[row, points.view[near[row, column]]] = True
    return at, normal, sigma, source.astype(np.int64), seen


def _thinned(xyz: Float, normal: Float, sigma: Float, apart_m: float) -> Bool:
    """Drop samples without support, and of two on one layer nearer than apart_m the vaguer one."""
    keep: Bool = np.isfinite(xyz).all(1) & (sigma < 4 * sigma.min())
    a, b = cKDTree(xyz).query_pairs(apart_m, output_type="ndarray").T
    same = (normal[a] * normal[b]).sum(1) > 0.7
    a, b = a[same], b[same]
    worse = np.where((sigma[a] > sigma[b]) | ((sigma[a] == sigma[b]) & (a > b)), a, b)
    better = a + b - worse
    for _ in range(8):  # a sample falls only to one that itself stays
        falls = np.zeros(len(xyz), dtype=bool)
        falls[worse[keep[better] & keep[worse]]] = True
        stays = keep & ~falls
        drop = np.zeros(len(xyz), dtype=bool)
        drop[worse[stays[better]]] = True
        drop &= keep
        if not drop.any():
            break
        keep = keep & ~drop
    return keep
