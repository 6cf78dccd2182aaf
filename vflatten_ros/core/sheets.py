"""Which samples are neighbours on the cloth: links on one sheet, and links round sharp rims.

Where the edge of one layer lies on another, their samples are as near as neighbours are. The chord
of a smooth surface is square to the mean of the normals at its ends, however curved the surface;
where it is not, there is a step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.values import Bool, Float, Int

RIM_GAP_RAD = np.radians(120)  # a sample with no neighbour in so wide a sector is at an edge
RIM_REACH_M = 0.010  # rims over which the gap between the two sides is averaged


@dataclass(frozen=True, eq=False)
class Links:
    """Pairs of neighbouring samples."""

    a: Int  # (m,) smaller row
    b: Int  # (m,)
    length_m: Float  # (m,) along the cloth
    rim: Bool  # (m,) round a sharp edge, rather than on one sheet
    doubt: Float  # (m,) that a rim is the edge of a stack of layers, as of ramps; 0 on a sheet

    def part(self, keep: Bool) -> Links:
        """Some of the links."""
        return Links(
            self.a[keep], self.b[keep], self.length_m[keep], self.rim[keep], self.doubt[keep]
        )

    def among(self, some: Bool) -> Links:
        """Links between some of the (n,) samples, numbered as these alone are."""
        number = np.cumsum(some) - 1
        kept = self.part(some[self.a] & some[self.b])
        return Links(number[kept.a], number[kept.b], kept.length_m, kept.rim, kept.doubt)

    def with_links(self, a: Int, b: Int, length_m: float) -> Links:
        """With links on one sheet between some pairs of samples, in place of what was there."""
        if not len(a):
            return self
        pairs = np.unique(np.sort(np.column_stack([a, b]), axis=1), axis=0)
        told = set(map(tuple, pairs.tolist()))
        rest = self.part(
            np.array([p not in told for p in zip(self.a.tolist(), self.b.tolist(), strict=True)])
        )
        count = len(pairs)
        return Links(
            np.r_[rest.a, pairs[:, 0]],
            np.r_[rest.b, pairs[:, 1]],
            np.r_[rest.length_m, np.full(count, length_m)],
            np.r_[rest.rim, np.zeros(count, dtype=bool)],
            np.r_[rest.doubt, np.zeros(count)],
        )


def link_samples(xyz: Float, normal: Float, config: RotationConfig) -> Links:
    """Links of every sample to those around it on its own sheet and round its edge.

    Parameters
    ----------
    xyz, normal : ndarray of shape (n, 3)
        Samples and their outward normals.
    """
    a, b = cKDTree(xyz).query_pairs(config.link_m, output_type="ndarray").T
    chord = xyz[b] - xyz[a]
    alike = (normal[a] * normal[b]).sum(1)
    mean = normal[a] + normal[b]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    length = np.linalg.norm(chord, axis=1)
    sheet = (alike > 0.5) & (np.abs((chord * mean).sum(1)) < config.step_m)
    sheet = _supported(a, b, sheet, len(xyz), config)
    edge = _at_edge(a[sheet], b[sheet], xyz, normal)
    # round a rim the normals part; where two layers face each other, they point across the gap
    apart = ((normal[b] - normal[a]) * chord).sum(1) / 2
    convex = apart > -config.valley_m
    rim = ~sheet & edge[a] & edge[b] & (alike < 0.3) & (length < config.rim_m) & convex
    doubt = np.zeros(len(a))
    doubt[rim] = _thickness(xyz, normal, a[rim], b[rim])
    along = _arc(length, alike) + np.where(rim, config.rim_detour_m, 0.0)
    return Links(a, b, along, rim, doubt).part(sheet | rim)


def _thickness(xyz: Float, normal: Float, a: Int, b: Int) -> Float:
    """How much thicker than most a rim is: 0.6 at the upper quartile of all, 1 one range above it.

    The outer sides of a stack of layers whose edges lie flush are farther apart than the two sides
    of one seam or hem.
    """
    if len(a) < 8:
        return np.zeros(len(a))
    across = normal[b] - normal[a]
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    gap = ((xyz[b] - xyz[a]) * across).sum(1)
    i, j = cKDTree((xyz[a] + xyz[b]) / 2).query_pairs(RIM_REACH_M, output_type="ndarray").T
    along = np.abs((across[i] * across[j]).sum(1)) > 0.5
    i, j = i[along], j[along]
    total = gap + np.bincount(i, gap[j], len(a)) + np.bincount(j, gap[i], len(a))
    mean = total / (1 + np.bincount(i, minlength=len(a)) + np.bincount(j, minlength=len(a)))
    low, high = np.quantile(mean, (0.25, 0.75))
    thickness: Float = 0.4 * (mean - high) / max(high - low, 1e-6) + 0.6
    return thickness.clip(0.0)


def sheet_edges(xyz: Float, normal: Float, a: Int, b: Int, config: RotationConfig) -> Int:
    """Samples at the edge of what was seen of their sheet.

    Returns
    -------
    ndarray of shape (n,)
        0: not at an edge; 1: at an edge of the cloth or a fold; 2: another sheet lies close by in
        front of the sample's tangent plane, so that the cloth probably goes on beneath it.
    """
    n = len(xyz)
    one, other = cKDTree(xyz).query_pairs(config.hidden_m, output_type="ndarray").T
    ones = np.ones(2 * len(a), dtype=np.float32)
    adjacent = csr_matrix((ones, (np.r_[a, b], np.r_[b, a])), shape=(n, n))
    two = adjacent @ adjacent + adjacent
    near = np.zeros(len(one), dtype=bool)
    if len(one):  # a sparse matrix takes no empty index
        near = np.asarray(two[one, other]).ravel() > 0
    one, other = one[~near], other[~near]
    chord = xyz[other] - xyz[one]
    hidden = np.zeros(n, dtype=bool)
    hidden[one[(chord * normal[one]).sum(1) > config.step_m]] = True
    hidden[other[-(chord * normal[other]).sum(1) > config.step_m]] = True
    edge: Int = _at_edge(a, b, xyz, normal) * np.where(hidden, 2, 1)
    return edge


def outward(xyz: Float, normal: Float, a: Int, b: Int) -> Float:
    """(n, 3) unit directions along the sheet away from the samples that each is linked to."""
    step, n = xyz[b] - xyz[a], len(xyz)
    away = np.column_stack(
        [np.bincount(b, along, n) - np.bincount(a, along, n) for along in step.T]
    )
    away -= (away * normal).sum(1, keepdims=True) * normal
    unit: Float = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return unit


def _arc(chord: Float, alike: Float) -> Float:
    """Length of the circular arc over each chord, from the cosine between its normals."""
    half = np.arccos(alike.clip(0.3, 1.0)) / 2
    arc: Float = chord * np.where(half > 1e-3, half / np.maximum(np.sin(half), 1e-3), 1.0)
    return arc


def _supported(a: Int, b: Int, sheet: Bool, n: int, config: RotationConfig) -> Bool:
    """Keep links whose ends share neighbours: on a sheet the neighbourhoods overlap."""
    sheet = sheet.copy()
    changed = np.ones(n, dtype=bool)
    for _ in range(3):
        rows = np.flatnonzero(sheet)
        i, j = a[rows], b[rows]
        ones = np.ones(2 * len(rows), dtype=np.float32)
        adjacent = csr_matrix((ones, (np.r_[i, j], np.r_[j, i])), shape=(n, n))
        degree = np.diff(adjacent.indptr)
        again = changed[i] | changed[j]  # the others are as they were
        rows, i, j = rows[again], i[again], j[again]
        common = np.asarray(adjacent[i].multiply(adjacent[j]).sum(1)).ravel()
        weak = (common < config.overlap * np.minimum(degree[i], degree[j])) | (common < 2)
        sheet[rows[weak]] = False
        changed[:] = False
        changed[i[weak]] = changed[j[weak]] = True
    return sheet


def _at_edge(a: Int, b: Int, xyz: Float, normal: Float) -> Bool:
    """Samples whose linked neighbours leave a wide sector empty."""
    n = len(xyz)
    centre, other = np.r_[a, b], np.r_[b, a]
    least = np.abs(normal).argmin(1)
    e1 = np.cross(normal, np.eye(3)[least])
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    e2 = np.cross(normal, e1)
    offset = xyz[other] - xyz[centre]
    angle = np.arctan2(
        np.einsum("ni,ni->n", offset, e2[centre]), np.einsum("ni,ni->n", offset, e1[centre])
    )
    order = np.lexsort((angle, centre))
    angle = angle[order]
    count = np.bincount(centre, minlength=n)
    first = np.r_[0, np.cumsum(count)[:-1]]
    last = first + count - 1
    following = np.r_[angle[1:], 0.0]
    some = count > 0
    following[last[some]] = angle[first[some]] + 2 * np.pi
    gap = np.full(n, 2 * np.pi)
    gap[some] = np.maximum.reduceat(following - angle, first[some])
    wide: Bool = gap > RIM_GAP_RAD
    return wide
