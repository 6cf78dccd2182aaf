"""Points in space into pieces that hang together, and planes among them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vflatten_ros.core.values import Bool, Int

Points = NDArray[np.float32]
Labels = NDArray[Any]  # int32 or int64
# Half of the 26 neighbours of a voxel; the other half are their opposites.
HALF_NEIGHBOURS = [(0, 0, 1)] + [(0, 1, k) for k in (-1, 0, 1)]
HALF_NEIGHBOURS += [(1, j, k) for j in (-1, 0, 1) for k in (-1, 0, 1)]
TABLE_CELLS = 8_000_000  # a table of voxels is faster than sorting them, up to this size
TRIALS = 100


def pieces(points: Points, size_m: float) -> tuple[Labels, Labels]:
    """Occupied voxels, and which of them hang together by sides, edges or corners.

    Parameters
    ----------
    points : ndarray of shape (n, 3)
    size_m : float
        Side of a voxel. Points nearer than this are always in one piece, points farther than
        3.5 times this never without others between them.

    Returns
    -------
    voxel : (n,) voxel of each point
    label : (voxels,) piece of each voxel
    """
    cells, shape = _cells(points, size_m)
    _, ny, nz = shape
    key, voxel = _distinct(cells, math.prod(shape))
    first, second = [], []
    for i, j, k in HALF_NEIGHBOURS:
        wanted = key + (i * ny + j) * nz + k
        place = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        found = np.flatnonzero(key[place] == wanted)
        first.append(found)
        second.append(place[found])
    pairs = (np.concatenate(first), np.concatenate(second))
    graph = coo_array((np.ones(len(pairs[0]), bool), pairs), shape=(len(key), len(key)))
    _, label = connected_components(graph, directed=False)
    return voxel, label


def centres(points: Points, voxel: Labels) -> Points:
    """(voxels, 3) mean of the points in each voxel."""
    count = np.bincount(voxel)
    means = [np.bincount(voxel, points[:, k]) / count for k in range(3)]
    return np.stack(means, axis=1).astype(np.float32)


def _cells(points: Points, size_m: float) -> tuple[Int, tuple[int, ...]]:
    """Number of each point's voxel in a grid with an empty border, and the grid's shape."""
    places = []
    for k in range(3):
        along = points[:, k] - points[:, k].min()
        along *= np.float32(1.0 / size_m)
        places.append(along.astype(np.int32))  # rounds down, as none is negative
    shape = tuple(int(place.max()) + 3 for place in places)
    wide = np.int32 if math.prod(shape) < 2**31 else np.int64
    x, y, z = (place.astype(wide) + wide(1) for place in places)
    cells: Int = (x * wide(shape[1]) + y) * wide(shape[2]) + z
    return cells, shape


def _distinct(cells: Int, total: int) -> tuple[Int, Labels]:
    """Sorted distinct numbers in [0, total), and the place of each number among them."""
    if total > TABLE_CELLS:
        distinct, place = np.unique(cells, return_inverse=True)
        return distinct.astype(np.int64), place.reshape(-1)
    occupied = np.zeros(total, bool)
    occupied[cells] = True
    distinct = np.flatnonzero(occupied)
    table = np.empty(total, np.int32)
    table[distinct] = np.arange(len(distinct), dtype=np.int32)
    return distinct, table[cells]


def dominant_plane(points: Points, tolerance_m: float) -> tuple[Points, Bool]:
    """The plane with most points within a tolerance: RANSAC with a fixed seed, then refined.

    Returns
    -------
    plane : (4,) a, b, c, d with a x + b y + c z + d the distance from it
    on : (n,) points within the tolerance of it
    """
    chance = np.random.default_rng(0)
    corners = points[chance.integers(0, len(points), (TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + np.float32(1e-12)
    offsets = -np.einsum("ij,ij->i", normals, corners[:, 0])
    near = np.abs(points @ normals.T + offsets) < tolerance_m  # (n, trials)
    inliers = points[near[:, near.sum(axis=0).argmax()]]
    centre = inliers.mean(axis=0)
    normal = np.linalg.svd(inliers - centre, full_matrices=False)[2][2]
    plane: Points = np.append(normal, -normal @ centre).astype(np.float32)
    return plane, plane_distance(points, plane) < tolerance_m


def plane_distance(points: Points, plane: Points) -> Points:
    """Distance of (n, 3) points from a plane, without sign."""
    distance: Points = np.abs(points @ plane[:3] + plane[3])
    return distance
