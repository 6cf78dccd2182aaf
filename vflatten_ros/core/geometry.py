"""Rigid transforms and the frames of the rig.

Frames (right-handed, metres):

rig
    The optical frame of the point clouds: x right, y down, z forward (REP-103 optical).
hanger
    The item's own frame. Origin at the gripper tip, z up along the wrist axis; at item angle 0
    its x axis points horizontally from the axis towards the rig, so y points to the right as the
    rig sees it. It turns with the wrist: what hangs still on the item has constant coordinates.
view
    The paper's frame of one observation: x right, y up along the axis, z towards the rig, origin
    at the gripper tip. It stands still: view (x, y, z) = hanger (y, z, x) at item angle 0.
flat
    The table plane (u, v).

`T_a_b` is the (4, 4) matrix that takes coordinates in b to coordinates in a.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

# rows: view x, y, z in hanger coordinates at item angle 0
R_VIEW_HANGER0: Float = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


def rotation_about(axis: Float, angle_rad: float) -> Float:
    """(3, 3) right-handed rotation about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Float = (
        np.eye(3) + np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * cross @ cross
    )
    return rotation


def rigid(rotation: Float, translation: Float) -> Float:
    """(4, 4) transform from a (3, 3) rotation and a translation of 3."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def inverse(transform: Float) -> Float:
    """T_b_a from T_a_b."""
    rotation = transform[:3, :3].T
    return rigid(rotation, -rotation @ transform[:3, 3])


def transform_points(transform: Float, points: Float) -> Float:
    """Apply a (4, 4) transform to (..., 3) points."""
    moved: Float = points @ transform[:3, :3].T + transform[:3, 3]
    return moved


def transform_directions(transform: Float, directions: Float) -> Float:
    """Rotate (..., 3) directions by a (4, 4) transform."""
    turned: Float = directions @ transform[:3, :3].T
    return turned


def tangents(normal: Float) -> tuple[Float, Float]:
    """Two (n, 3) unit tangents of (n, 3) unit normals; with them they are right-handed."""
    least = np.abs(normal).argmin(1)
    e1 = np.cross(normal, np.eye(3)[least])
    e1 /= np.maximum(np.linalg.norm(e1, axis=1, keepdims=True), 1e-12)
    return e1, np.cross(normal, e1)


def distances_m(points: Float, i: NDArray[np.int64], j: NDArray[np.int64]) -> Float:
    """(m,) distances between rows i and j (m,) of (n, d) points.

    Coordinate by coordinate: many times as fast as the norms of their differences.
    """
    squared = np.zeros(len(i))
    for along in np.ascontiguousarray(points.T):
        apart = along[i] - along[j]
        squared += apart * apart
    return np.sqrt(squared, out=squared)


def twice_area(uv: Float) -> float:
    """Of a closed line (n, 2), positive counter-clockwise."""
    after = np.roll(uv, -1, axis=0)
    return float((uv[:, 0] * after[:, 1] - uv[:, 1] * after[:, 0]).sum())


def loop_normals(uv: Float) -> Float:
    """(n, 2) unit outward normals of a closed line (n, 2), counter-clockwise, over five points."""
    along = np.roll(uv, -2, axis=0) - np.roll(uv, 2, axis=0)
    outward = np.column_stack([along[:, 1], -along[:, 0]])
    normals: Float = outward / np.maximum(np.linalg.norm(outward, axis=1), 1e-9)[:, None]
    return normals


def thinned_loop(uv: Float, reach: int = 2) -> Float:
    """Every second point of a closed line (n, 2), each the mean of those up to `reach` away."""
    smooth: Float = np.mean([np.roll(uv, k, axis=0) for k in range(-reach, reach + 1)], axis=0)
    return smooth[::2]
