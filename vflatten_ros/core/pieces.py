"""Points in space into pieces that hang together, and planes among them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vflatten_ros.core.values import Bool, Int

Points = NDArray[np.float32]
# Half of the 26 neighbours of a voxel; the other half are their opposites.
HALF_NEIGHBOURS = [(0, 0, 1)] + [(0, 1, k) for k in (-1, 0, 1)]
HALF_NEIGHBOURS += [(1, j, k) for j in (-1, 0, 1) for k in (-1, 0, 1)]
TABLE_CELLS = 8_000_000  # a table of voxels is faster than sorting them, up to this size
TRIALS = 100


def pieces(points: Points, size_m: float) -> tuple[Int, Points, Int]:
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
    centres : (voxels, 3) mean of the points of each voxel
    label : (voxels,) piece of each voxel
    """
    cell = np.floor(points / np.float32(size_m)).astype(np.int64)
    cell -= cell.min(axis=0) - 1
    nx, ny, nz = (int(extent) + 2 for extent in cell.max(axis=0))
    key, voxel = _distinct((cell[:, 0] * ny + cell[:, 1]) * nz + cell[:, 2], nx * ny * nz)
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
    count = np.bincount(voxel)
    centres = np.stack([np.bincount(voxel, points[:, k]) / count for k in range(3)], axis=1)
    return voxel, centres.astype(np.float32), label.astype(np.int64)


def _distinct(keys: Int, cells: int) -> tuple[Int, Int]:
    """Sorted distinct keys in [0, cells), and the place of each key among them."""
    if cells > TABLE_CELLS:
        distinct, place = np.unique(keys, return_inverse=True)
        return distinct, place.reshape(-1)
    occupied = np.zeros(cells, bool)
    occupied[keys] = True
    distinct = np.flatnonzero(occupied)
    table = np.empty(cells, np.int32)
    table[distinct] = np.arange(len(distinct))
    return distinct, table[keys].astype(np.int64)


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
