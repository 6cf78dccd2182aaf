"""What a user would pick instead of ours: smoothing, then another library on a mesh."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from synthetic import Patch

from vflatten_ros.core.smoothing import quadratic_image

Float = NDArray[np.float64]
Int = NDArray[np.int64]

SMOOTHING_M = 0.0075  # Gaussian weight of the peers' quadratic smoothing: best over the surfaces


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles over the grid of a patch."""

    vertices: Float  # (n, 3)
    faces: Int  # (f, 3)
    of_point: Int  # (seen points,) vertex of each seen point, -1: none
    seconds: float  # to smooth and to mesh


def grid_mesh(patch: Patch, points: Float, smooth: bool = True, jump_m: float = 0.015) -> Mesh:
    """Two triangles for every four neighbours without a depth jump; the largest piece."""
    start = time.process_time()
    xyz = patch.xyz.copy()
    xyz[patch.mask] = points
    if smooth:
        step = xyz[0, 1, 0] - xyz[0, 0, 0]
        xyz[..., 2] = quadratic_image(xyz[..., 2], patch.mask, patch.mask, SMOOTHING_M / step)[0][
            ..., 0
        ]
    return mesh_of(xyz, patch.mask, jump_m, time.process_time() - start)


def mesh_of(xyz: Float, mask: NDArray[np.bool_], jump_m: float, seconds: float) -> Mesh:
    """Mesh of (rows, cols, 3) points; `seconds` were spent before."""
    start = time.process_time()
    full = _full_squares(xyz[..., 2], mask, jump_m)
    number = np.arange(mask.size).reshape(mask.shape)
    a, b, c, d = (
        n[full] for n in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    faces = _largest(faces, mask.size)
    used = np.unique(faces)
    vertex = np.full(mask.size, -1)
    vertex[used] = np.arange(len(used))
    vertices = np.ascontiguousarray(xyz.reshape(-1, 3)[used])
    seconds += time.process_time() - start
    return Mesh(vertices, vertex[faces], vertex[mask.ravel()], seconds)


def _full_squares(z: Float, mask: NDArray[np.bool_], jump_m: float) -> NDArray[np.bool_]:
    """Squares of four seen neighbours without a jump, and no two that meet in one corner alone."""
    corners = np.stack([z[:-1, :-1], z[:-1, 1:], z[1:, 1:], z[1:, :-1]])
    seen = np.stack([mask[:-1, :-1], mask[:-1, 1:], mask[1:, 1:], mask[1:, :-1]]).all(axis=0)
    change = np.abs(corners - np.roll(corners, 1, axis=0)).max(axis=0)
    full = seen & (change < jump_m)
    for _ in range(20):
        p = np.pad(full, 1)
        a, b, c, d = p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]
        i, j = np.nonzero((a & c & ~b & ~d) | (b & d & ~a & ~c))
        if not len(i):
            break
        p[i, j] = p[i, j + 1] = False
        full = p[1:-1, 1:-1]
    return full


def _largest(faces: Int, count: int) -> Int:
    a, b = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count))
    piece = connected_components(graph, directed=False)[1][faces[:, 0]]
    return faces[piece == np.bincount(piece).argmax()]


def _path_length(path: Float) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def edge_flip(mesh: Mesh, a: Int, b: Int) -> Float:
    """potpourri3d: exact local geodesics by edge flips, pair by pair."""
    import potpourri3d

    solver = potpourri3d.EdgeFlipGeodesicSolver(mesh.vertices, mesh.faces)
    pairs = zip(mesh.of_point[a].tolist(), mesh.of_point[b].tolist())
    return np.array([_path_length(solver.find_geodesic_path(i, j)) for i, j in pairs])


def arap_flat(mesh: Mesh) -> Float:
    """libigl: conformal start (LSCM), then as-rigid-as-possible; (vertices, 2)."""
    import igl

    faces = mesh.faces.astype(np.int64)
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    first = int(np.argmin(centred @ np.linalg.svd(centred, full_matrices=False)[2][0]))
    second = int(np.argmax(np.linalg.norm(mesh.vertices - mesh.vertices[first], axis=1)))
    apart = np.linalg.norm(mesh.vertices[first] - mesh.vertices[second])
    pins = np.array([[0.0, 0.0], [apart, 0.0]])
    start = igl.lscm(mesh.vertices, faces, np.array([first, second]), pins)[0]
    start *= np.sqrt(_area(mesh.vertices, faces) / _area(np.pad(start, ((0, 0), (0, 1))), faces))
    data = igl.ARAPData()
    data.max_iter = 60
    data.with_dynamics = True
    igl.arap_precomputation(mesh.vertices, faces, 2, np.zeros(0, np.int32), data)
    return np.asarray(igl.arap_solve(np.zeros((0, 2)), data, start))


def _area(vertices: Float, faces: Int) -> float:
    p, q, r = (vertices[faces[:, i]] for i in range(3))
    return float(np.linalg.norm(np.cross(q - p, r - p), axis=1).sum() / 2)


def arap_distance(mesh: Mesh, a: Int, b: Int) -> Float:
    """Straight distances after ARAP flattening."""
    flat = arap_flat(mesh)
    return np.asarray(np.linalg.norm(flat[mesh.of_point[a]] - flat[mesh.of_point[b]], axis=1))


def _by_source(solve: Callable[[int], Float], mesh: Mesh, a: Int, b: Int) -> Float:
    out = np.empty(len(a))
    for source in np.unique(a):
        here = a == source
        out[here] = solve(int(mesh.of_point[source]))[mesh.of_point[b[here]]]
    return out


def heat(mesh: Mesh, a: Int, b: Int) -> Float:
    """potpourri3d: heat method on the mesh."""
    import potpourri3d

    solver = potpourri3d.MeshHeatMethodDistanceSolver(mesh.vertices, mesh.faces)
    return _by_source(solver.compute_distance, mesh, a, b)


def exact(mesh: Mesh, a: Int, b: Int) -> Float:
    """pygeodesic: exact polyhedral distances (MMP)."""
    from pygeodesic import geodesic

    solver = geodesic.PyGeodesicAlgorithmExact(mesh.vertices, mesh.faces.astype(np.int32))
    return _by_source(
        lambda s: solver.geodesicDistances(np.array([s], np.int32), None)[0], mesh, a, b
    )


def poisson_heat(mesh: Mesh, a: Int, b: Int) -> Float:
    """pymeshlab: screened Poisson reconstruction, then the heat method."""
    import potpourri3d
    import pymeshlab
    from scipy.spatial import cKDTree

    work = pymeshlab.MeshSet(verbose=False)
    work.add_mesh(pymeshlab.Mesh(vertex_matrix=mesh.vertices))
    work.compute_normal_for_point_clouds(k=16, flipflag=True, viewpos=np.array([0.0, 0.0, 10.0]))
    work.generate_surface_reconstruction_screened_poisson(depth=7, preclean=True)
    for _ in range(3):
        work.meshing_repair_non_manifold_edges()
    made = work.current_mesh()
    vertices, faces = made.vertex_matrix(), made.face_matrix()
    close = cKDTree(mesh.vertices).query(vertices)[0] < 0.0075
    faces = _largest(faces[close[faces].all(axis=1)].astype(np.int64), len(vertices))
    used = np.unique(faces)
    vertices, faces = np.ascontiguousarray(vertices[used]), np.searchsorted(used, faces)
    near = cKDTree(vertices).query(mesh.vertices)[1][mesh.of_point]
    solver = potpourri3d.MeshHeatMethodDistanceSolver(vertices, faces)
    made_mesh = Mesh(vertices, faces, near, 0.0)
    return _by_source(solver.compute_distance, made_mesh, a, b)


def isomap_distance(mesh: Mesh, a: Int, b: Int, most: int = 1500) -> Float:
    """scikit-learn: Isomap of a sample, straight distances of its plane."""
    from sklearn.manifold import Isomap

    ends = np.unique(mesh.of_point[np.concatenate([a, b])])
    sample = np.random.default_rng(3).choice(len(mesh.vertices), most, replace=False)
    keep = np.union1d(sample, ends)
    flat = Isomap(n_neighbors=10, n_components=2).fit_transform(mesh.vertices[keep])
    i, j = (np.searchsorted(keep, mesh.of_point[x]) for x in (a, b))
    return np.asarray(np.linalg.norm(flat[i] - flat[j], axis=1))
