"""One view, prepared for flattening: its surface, its smooth patches, where cloth is hidden."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vflatten_ros.core.config import Config
from vflatten_ros.core.edges import with_rows
from vflatten_ros.core.errors import InvalidCorrespondence
from vflatten_ros.core.patches import find_patches
from vflatten_ros.core.surface import Surface, fit_surface
from vflatten_ros.core.thinning import thinned
from vflatten_ros.core.values import Bool, Float, Int, Progress, View

GRAZING = 0.25  # cosine of the angle between ray and normal beyond which the cloth turns away
TURNING_M = 0.012  # across the view, within which cloth that curves away would turn its back
TURNING_PX = 6  # reach of the fit that foretells it
PARALLEL_M = 1e3  # depth of parallel rays is counted from so far away, that its inverse is linear


@dataclass(frozen=True, eq=False)
class Observation:
    """What one view shows."""

    view: View
    surface: Surface  # hanger frame
    place: Int  # (n, 2) row and column of every point on the grid of rays
    patch: Int  # (n,) smooth patch, largest first; -1: none
    fringe: Int  # (n,) the same with the points between patches
    depth: Float  # (n,) along the rays, m
    facing: Float  # (n,) cosine of the angle between the normal and the direction to the camera
    ends: Int  # (e, 2) points at an end of what is seen; the next point beyond, -1: none near
    turning: Bool  # (e,) there the cloth curves away from the camera: it goes on behind


def observe(view: View, config: Config, progress: Progress) -> Observation:
    """Fit the surface of a view and part it into smooth patches; see thinned for its points."""
    smaller, needed = thinned(view, config.rotation)
    if smaller is not view:
        view = with_rows(view, needed)  # its pixels are those of the whole image
    points = view.points_hanger
    toward = _camera(view) - points
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    pixel, shape = (smaller.pixel, smaller.shape) if view.shape[0] > 1 else (None, None)
    surface = fit_surface(points, config.surface, toward, pixel, shape, progress)
    at, depth = surface.rays.to_grid(points)
    place: Int = np.rint(at).astype(np.int64)
    depth = depth - depth.min() + PARALLEL_M if surface.rays.parallel else depth
    cells, first, cell = np.unique(place, axis=0, return_index=True, return_inverse=True)
    found = find_patches(cells, depth[first], config.patches)
    cell = cell.reshape(-1)
    facing = np.einsum("ij,ij->i", surface.normals, toward)
    ends = np.where(found.ends >= 0, first[found.ends], -1)
    fringe = found.fringe[cell]
    turning = turns_away(place, facing, fringe, ends[:, 0], TURNING_M / surface.spacing_m)
    return Observation(
        view, surface, place, found.patch[cell], fringe, depth, facing, ends, turning
    )


def turns_away(place: Int, facing: Float, patch: Int, at: Int, within_px: float) -> Bool:
    """Where the cloth, as it curves, would turn its back just beyond the points: no end of it.

    At the silhouette of a round fold the facing squared falls linearly to zero across the image. At
    a hem the cloth ends as it faces. The fall is fitted over the same patch around each point.

    Parameters
    ----------
    place : ndarray of shape (n, 2)
        Row and column of every point.
    facing : ndarray of shape (n,)
        Cosine of the angle between the normal and the direction to the camera.
    patch : ndarray of shape (n,)
        Patch of every point, -1: none.
    at : ndarray of shape (e,)
        Points at an end of what is seen.
    within_px : float
        The cloth must turn its back this near, rows or columns.

    Returns
    -------
    ndarray of shape (e,)
    """
    point, inverse = np.unique(at, return_inverse=True)
    reach = TURNING_PX
    grid = np.full(np.ptp(place, axis=0) + 2 * reach + 1, -1, dtype=np.int64)
    own = place - place.min(axis=0) + reach
    grid[tuple(own.T)] = np.arange(len(place))
    step = np.argwhere(np.ones((2 * reach + 1, 2 * reach + 1))) - reach
    step = step[(step**2).sum(axis=1) <= reach**2]
    around = own[point][:, None] + step
    near = grid[around[..., 0], around[..., 1]]
    same = (near >= 0) & (patch[near] == patch[point, None]) & (patch[point, None] >= 0)
    value = np.where(same, np.clip(facing[near], 0.0, 1.0) ** 2, 0.0)
    design = np.column_stack([np.ones(len(step)), step])
    normal = np.einsum("ks,si,sj->kij", same.astype(float), design, design)
    plane = np.linalg.solve(normal + 1e-6 * np.eye(3), (value @ design)[..., None])[..., 0]
    outward = -(same @ step).astype(float)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    fall = -(plane[:, 1:] * outward).sum(axis=1)
    enough = same.sum(axis=1) >= 2 * reach
    turning = enough & (fall > 0.0) & (plane[:, 0] < within_px * fall)
    result: Bool = turning[inverse.reshape(-1)]
    return result


def edges(observation: Observation, uv: Float, step_m: float) -> Bool:
    """Points at which the item may end, once they are flattened; elsewhere it goes on unseen.

    At an end of what is seen, the next cloth in the image tells: if it lies as far away in the
    plane as in space, it is the far side of a hole in the data; if it is as near to the camera or
    nearer, and lies elsewhere in the plane, it hides how the cloth goes on; otherwise the item
    may end there. Cloth that turns away from the camera, or is about to, goes on, too.

    Parameters
    ----------
    observation : Observation
    uv : ndarray of shape (n, 2)
        Flat places of its points, m; nan: elsewhere.
    step_m : float
        Cloth nearer in depth than this is as near.
    """
    i, j = observation.ends.T
    points, depth = observation.surface.points, observation.depth
    space = np.linalg.norm(points[i] - points[j], axis=1)
    flat = np.linalg.norm(uv[i] - uv[j], axis=1)
    hole = (j >= 0) & (flat < 1.5 * space + 0.004)  # False where either is nan
    before = ((j >= 0) & ~hole & (depth[j] < depth[i] + step_m)) | (~hole & observation.turning)
    balance = np.zeros(observation.place.max(axis=0) + 1)
    np.add.at(
        balance, tuple(observation.place[i].T), np.where(hole, 0.0, np.where(before, 1.0, -1.0))
    )
    # the outline is ragged: single pixels face their neighbours along it
    around = cv2.boxFilter(balance, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
    hidden = around[tuple(observation.place.T)] > 0.5
    result: Bool = ~hidden & (observation.facing > GRAZING)
    return result


def _camera(view: View) -> Float:
    """Where the camera is in the hanger frame of the view: the rig frame's origin."""
    T_rig_hanger = view.calibration.T_rig_hanger(view.angle_rad)
    camera: Float = -T_rig_hanger[:3, :3].T @ T_rig_hanger[:3, 3]
    return camera


def locate(observation: Observation, pixel: tuple[int, int], reach_px: int) -> int:
    """The item's point at a pixel, or the nearest within reach, on a patch if there is one.

    Raises
    ------
    InvalidCorrespondence
        The item is farther away.
    """
    view = observation.view
    away = np.abs(view.pixel - np.asarray(pixel)).max(axis=1)
    nearest = int(away.argmin())
    if away[nearest] > reach_px:
        row, col = view.pixel[nearest]
        raise InvalidCorrespondence(
            f"corresponding point (row {pixel[0]}, col {pixel[1]}) of view {view.view_id} is not "
            f"on the item; the item's nearest pixel is ({row}, {col})"
        )
    if observation.patch[nearest] >= 0:
        return nearest
    depth = np.linalg.norm(observation.surface.raw - observation.surface.raw[nearest], axis=1)
    usable = (away <= reach_px) & (observation.patch >= 0) & (depth < 0.012)
    return int(np.where(usable, depth, np.inf).argmin()) if usable.any() else nearest


def quads(observation: Observation, keep: Bool) -> Int:
    """(m, 4) points around every square of grid places on one patch, among those to keep."""
    place = observation.place[keep] - observation.place.min(axis=0)
    index = np.full(place.max(axis=0, initial=0) + 1, -1, dtype=np.int64)
    index[tuple(place.T)] = np.flatnonzero(keep)
    corner = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1)
    corner = corner.reshape(-1, 4)
    corner = corner[(corner >= 0).all(axis=1)]
    patch = observation.fringe[corner]
    result: Int = corner[(patch == patch[:, :1]).all(axis=1)]
    return result
