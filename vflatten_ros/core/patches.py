"""Smooth patches of one view: parts of the item that no crease and no depth jump cuts apart.

Two layers of cloth that touch in the image are told apart by the step between them. Both sides of
every border between neighbouring pixels are extrapolated to it by planes, so that a slope is not
taken for a step; inverse depth is used because there a plane is linear in the pixel's place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vflatten_ros.core.config import PatchConfig
from vflatten_ros.core.values import Bool, Float, Int

REACH = 4  # pixels of the planes along the direction of extrapolation
SIDE = 1  # and to either side of it
FAR_M = 1e3  # a step where a plane cannot be fitted


@dataclass(frozen=True, eq=False)
class _Borders:
    """Borders between neighbours of the image in one direction."""

    first: tuple[slice, slice]  # the nearer pixels of the pairs
    second: tuple[slice, slice]
    step: Float  # m, nan where either pixel is unmeasured
    open: Bool  # measured on both sides and without a step


@dataclass(frozen=True, eq=False)
class Patches:
    """Smooth patches of one view; n points."""

    patch: Int  # (n,) the point's patch, largest first; -1: beside a step, or patch too small
    fringe: (
        Int  # (n,) the same with the points between patches, which may be of the one or the other
    )
    ends: Int  # (e, 2) points at an end of what is seen; the next point beyond, -1: none near


def find_patches(place: Int, depth: Float, config: PatchConfig) -> Patches:
    """Part the measured pixels of one view into smooth patches.

    Parameters
    ----------
    place : ndarray of shape (n, 2)
        Row and column of every point, each used once.
    depth : ndarray of shape (n,)
        Depth along the optical axis, metres, > 0.
    config : PatchConfig

    Returns
    -------
    Patches
    """
    index = np.full(np.ptp(place, axis=0) + 3, -1, dtype=np.int64)
    index[tuple((place - place.min(axis=0) + 1).T)] = np.arange(len(place))
    borders = _borders(index, depth, config)
    links = np.concatenate(
        [np.stack([index[b.first][b.open], index[b.second][b.open]], axis=1) for b in borders]
    )
    solid = _solid(index, borders, config.margin_px)[index >= 0]
    order = index[index >= 0]
    core = np.zeros(len(place), dtype=bool)
    core[order] = solid
    patch = _components(links[core[links].all(axis=1)], core, config.min_points)
    patch = _grown(patch, links, config.margin_px + 2)
    fringe = _grown(patch, links, config.gap_px)
    return Patches(patch, fringe, _ends(index, borders, config.gap_px))


def _borders(index: Int, depth: Float, config: PatchConfig) -> list[_Borders]:
    known = index >= 0
    z = np.ones(index.shape)
    z[known] = depth[index[known]]
    inverse = np.where(known, 1.0 / z - 1.0 / np.median(depth), 0.0)
    pairs = []
    for axis in (1, 0):
        first = (slice(None), slice(None, -1)) if axis else (slice(None, -1), slice(None))
        second = (slice(None), slice(1, None)) if axis else (slice(1, None), slice(None))
        ahead = _extrapolate(inverse, known, axis, 1)[first]
        back = _extrapolate(inverse, known, axis, -1)[second]
        raw = np.abs(z[first] - z[second])
        step = np.abs(ahead - back) * z[first] * z[second]
        step = np.where(np.isnan(step), np.where(raw > config.lone_step_m, FAR_M, 0.0), step)
        step = np.where(raw > config.jump_m, FAR_M, step)
        pairs.append((first, second, np.where(known[first] & known[second], step, np.nan)))
    usual = np.concatenate([s[(s > 0) & (s < FAR_M)] for _, _, s in pairs])
    noise = np.median(usual) / 0.6745 if len(usual) else 0.0
    limit = max(config.step_m, config.step_sigmas * noise)
    return [_Borders(first, second, s, s <= limit) for first, second, s in pairs]


def _extrapolate(values: Float, known: Bool, axis: int, way: int) -> Float:
    """Plane through the pixels behind each pixel, taken half a pixel ahead of it; nan: too few."""
    along = np.arange(1 - REACH, REACH) * way
    behind = (along <= 0).astype(float)
    across = np.arange(-SIDE, SIDE + 1.0)

    def moment(image: Float, a: int, b: int) -> Float:
        rows, cols = (across**b, behind * along**a) if axis else (behind * along**a, across**b)
        out: Float = cv2.filter2D(image, -1, np.outer(rows, cols), borderType=cv2.BORDER_CONSTANT)
        return out

    mass = known.astype(float)
    m = {q: moment(mass, *q)[known] for q in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))}
    right = np.stack([moment(values, *q)[known] for q in ((0, 0), (1, 0), (0, 1))], axis=-1)
    normal = np.stack(
        [m[0, 0], m[1, 0], m[0, 1], m[1, 0], m[2, 0], m[1, 1], m[0, 1], m[1, 1], m[0, 2]], axis=-1
    ).reshape(-1, 3, 3)
    enough = (m[0, 0] >= 5) & (np.linalg.det(normal) > 1.0)
    plane = np.full((len(right), 3), np.nan)
    plane[enough] = np.linalg.solve(normal[enough], right[enough][..., None])[..., 0]
    out = np.full(values.shape, np.nan)
    out[known] = plane[:, 0] + 0.5 * plane[:, 1]
    return out


def _solid(index: Int, borders: list[_Borders], margin: int) -> Bool:
    """Pixels amid their patch: no line of steps near, and most neighbours measured."""
    cut = np.zeros(index.shape, dtype=bool)
    degree = np.zeros(index.shape, dtype=np.int64)
    for b in borders:
        step = ~np.isnan(b.step) & ~b.open
        for side in (b.first, b.second):
            cut[side] |= step
            degree[side] += b.open
    # a line of steps cuts more than the two pixels of one noisy border
    count = cv2.boxFilter(
        cut.astype(float), -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    line = (cut & (count > 3.5)).astype(np.uint8)
    size = 2 * margin + 1
    near: Bool = cv2.dilate(line, np.ones((size, size), np.uint8)) > 0
    return (index >= 0) & ~near & (degree >= 3)


def _components(links: Int, core: Bool, least: int) -> Int:
    graph = coo_matrix((np.ones(len(links)), links.T), shape=(len(core), len(core)))
    label = connected_components(graph, directed=False)[1]
    size = np.bincount(label[core], minlength=label.max() + 1)
    order = np.argsort(-size, kind="stable")
    number = np.full(len(size), -1, dtype=np.int64)
    large = order[size[order] >= least]
    number[large] = np.arange(len(large))
    return np.where(core, number[label], -1)


def _grown(patch: Int, links: Int, rounds: int) -> Int:
    """Give the pixels between core and step back to their patch."""
    for _ in range(rounds):
        grown = patch.copy()
        for a, b in ((0, 1), (1, 0)):
            new = (patch[links[:, a]] < 0) & (patch[links[:, b]] >= 0)
            grown[links[new, a]] = patch[links[new, b]]
        patch = grown
    return patch


def _ends(index: Int, borders: list[_Borders], reach: int) -> Int:
    """(e, 2) points that are not joined to the next pixel, and the next measured point that way."""
    right, down = (np.zeros(index.shape, dtype=bool) for _ in range(2))
    right[borders[0].first] = borders[0].open
    down[borders[1].first] = borders[1].open
    found = []
    for axis, way, joined in ((1, 1, right), (1, -1, right), (0, 1, down), (0, -1, down)):
        joined = joined if way > 0 else _beyond(joined, axis, -1, False)
        end = (index >= 0) & ~joined
        next_one = np.full(index.shape, -1, dtype=np.int64)
        for step in range(1, reach + 1):
            other = _beyond(index, axis, step * way, -1)
            next_one = np.where(next_one < 0, other, next_one)
        found.append(np.stack([index[end], next_one[end]], axis=1))
    return np.concatenate(found)


def _beyond(image: NDArray[Any], axis: int, by: int, outside: int) -> NDArray[Any]:
    """The image's value so many pixels further along the axis."""
    moved = np.roll(image, -by, axis=axis)
    lost = slice(-by, None) if by > 0 else slice(None, -by)
    moved[(slice(None), lost) if axis else (lost, slice(None))] = outside
    return moved
