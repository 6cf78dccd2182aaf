"""The paper's moving least squares: planes z(x, y), fourth-order spline weight (eqs. 2 to 5)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.values import Bool, Float


def view_frame(toward: Float) -> Float:
    """(3, 3) rows x, y, z of the paper's frame: z towards the viewer."""
    side = np.eye(3)[np.argmin(np.abs(toward))]
    x = np.cross(side, toward)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(toward, x), toward])


def spline_weight(s: Float) -> Float:
    """Fourth-order spline 1 - 6 s^2 + 8 s^3 - 3 s^4 of s = r / r0, zero beyond 1."""
    inside = np.minimum(s, 1.0)
    return np.asarray(1 - 6 * inside**2 + 8 * inside**3 - 3 * inside**4)


def linear_fit(
    points: Float, tree: cKDTree, xy: Float, radius_m: float, most: int
) -> tuple[Float, Float, Bool]:
    """Plane z = a1 + a2 x + a3 y by weighted least squares around each place (eqs. 2 to 5).

    Parameters
    ----------
    points : ndarray of shape (n, 3)
        x and y across the view, z towards the viewer.
    tree : cKDTree
        Of the points' x and y.
    xy : ndarray of shape (k, 2)
        Where to fit.
    radius_m : float
        Radius r0 of the weight.
    most : int
        At most so many nearest points count.

    Returns
    -------
    z (k,), normal (k, 3), supported (k,): at least 4 points that span a plane
    """
    distance, near = tree.query(xy, most, distance_upper_bound=radius_m)
    inside = np.isfinite(distance)
    weight = np.where(inside, spline_weight(np.where(inside, distance, 0) / radius_m), 0.0)
    p = points[np.where(inside, near, 0)]
    # centred at the place: the same plane, better conditioned
    dx, dy = (p[..., 0] - xy[:, None, 0]) / radius_m, (p[..., 1] - xy[:, None, 1]) / radius_m
    basis = np.stack([np.ones_like(dx), dx, dy], axis=-1)
    scaled = basis * weight[..., None]
    normal = np.matmul(scaled.swapaxes(1, 2), basis)
    right = np.einsum("kni,kn->ki", scaled, p[..., 2])
    spans = np.linalg.det(normal) > 1e-5 * normal[:, 0, 0] ** 3
    supported = (inside.sum(axis=1) >= 4) & spans
    normal[~supported] = np.eye(3)
    a = np.linalg.solve(normal, right[..., None])[..., 0]
    n = np.stack([-a[:, 1] / radius_m, -a[:, 2] / radius_m, np.ones(len(a))], axis=1)
    return a[:, 0], n / np.linalg.norm(n, axis=1, keepdims=True), supported
