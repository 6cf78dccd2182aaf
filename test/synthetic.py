"""Developable surfaces with their exact flat coordinates, as one depth camera would see them.

The camera looks along -z with parallel rays on a square grid that is turned about z. On a
developable surface the geodesic distance is the straight distance of the flat coordinates
wherever the straight line between them stays on the surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Map = Callable[[Float, Float], tuple[Float, Float]]
Height = Callable[[Float, Float], Float]
Inside = Callable[[Float, Float], Bool]

TOWARD = np.array([0.0, 0.0, 1.0])
STEP_M = 0.0025  # a 480 x 360 camera with a 520 pixel focal length, 1.3 m away


@dataclass(frozen=True, eq=False)
class Patch:
    """A surface seen on a grid."""

    name: str
    xyz: Float  # (rows, cols, 3) exact points
    uv: Float  # (rows, cols, 2) exact flat coordinates
    mask: Bool  # (rows, cols) seen
    inverse: Map  # flat (u, v) to the surface's own (x, y)
    inside: Inside  # own (x, y) seen

    @property
    def pixel(self) -> NDArray[np.int32]:
        """(n, 2) row and column of the seen points."""
        return np.argwhere(self.mask).astype(np.int32)

    @property
    def flat(self) -> Float:
        """(n, 2) exact flat coordinates of the seen points."""
        return self.uv[self.mask]

    def points(self, noise_m: float = 0.0, correlation: float = 0.0, seed: int = 1) -> Float:
        """(n, 3) seen points with Gaussian noise along the view, correlated over some pixels."""
        noise = np.random.default_rng(seed).standard_normal(self.mask.shape)
        if correlation > 0:
            noise = gaussian_filter(noise, correlation, mode="wrap")
            noise /= noise.std()
        points = self.xyz.copy()
        points[..., 2] += noise_m * noise
        return points[self.mask]

    def sees_line(self, a: Float, b: Float) -> Bool:
        """(m,) whether the straight line between flat places (m, 2) stays on the seen surface."""
        t = np.linspace(0, 1, 150)[:, None, None]
        place = a + t * (b - a)
        return np.asarray(self.inside(*self.inverse(place[..., 0], place[..., 1])).all(axis=0))

    def pairs(
        self, count: int, low_m: float = 0.05, high_m: float = 0.4, seed: int = 7,
        among: Bool | None = None, to: Bool | None = None, straight: bool = True,
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], Float]:  # fmt: skip
        """Indices a, b into the seen points and their exact distance (count,)."""
        random = np.random.default_rng(seed)
        core = binary_erosion(self.mask, iterations=2)[self.mask]
        first = np.flatnonzero(core if among is None else core & among)
        second = np.flatnonzero(core if to is None else core & to)
        found: list[NDArray[np.int64]] = []
        have = 0
        while have < count:
            a, b = random.choice(first, 4 * count), random.choice(second, 4 * count)
            away = np.linalg.norm(self.flat[a] - self.flat[b], axis=1)
            good = (away > low_m) & (away < high_m)
            if straight:
                good &= self.sees_line(self.flat[a], self.flat[b])
            found.append(np.stack([a[good], b[good]]))
            have += int(good.sum())
        a, b = np.concatenate(found, axis=1)[:, :count]
        return a, b, np.linalg.norm(self.flat[a] - self.flat[b], axis=1)


def _seen(
    name: str, height: Height, flat: Map, inverse: Map, inside: Inside,
    box: tuple[float, float, float, float], turn_deg: float, step_m: float,
) -> Patch:  # fmt: skip
    cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    corners = np.array([(x, y) for x in box[:2] for y in box[2:]]) @ [[cos, sin], [-sin, cos]]
    low, high = corners.min(axis=0), corners.max(axis=0)
    gx, gy = np.meshgrid(
        np.arange(low[0] + step_m / 2, high[0], step_m),
        np.arange(low[1] + step_m / 2, high[1], step_m),
    )
    x, y = cos * gx + sin * gy, -sin * gx + cos * gy

    def within(x: Float, y: Float) -> Bool:
        edge = 1e-9
        in_box = (
            (x > box[0] - edge) & (x < box[1] + edge) & (y > box[2] - edge) & (y < box[3] + edge)
        )
        return np.asarray(in_box & inside(x, y))

    mask = within(x, y)
    safe_x, safe_y = (
        np.where(mask, x, (box[0] + box[1]) / 2),
        np.where(mask, y, (box[2] + box[3]) / 2),
    )
    xyz = np.stack([gx, gy, np.where(mask, height(safe_x, safe_y), 0.0)], axis=-1)
    return Patch(name, xyz, np.stack(flat(safe_x, safe_y), axis=-1), mask, inverse, within)


def everywhere(x: Float, y: Float) -> Bool:
    """No part is hidden."""
    return np.ones(np.shape(x), bool)


def plane(step_m: float = STEP_M, turn_deg: float = 20.0) -> Patch:
    """A tilted plane, 0.44 m wide."""
    along = np.array([1.0, 0.0, 0.3]) / np.hypot(1.0, 0.3)
    normal = np.array([-0.3, -0.2, 1.0]) / np.sqrt(1.13)
    across = np.cross(normal, along)
    to_flat = np.array([[v[0] + 0.3 * v[2], v[1] + 0.2 * v[2]] for v in (along, across)])
    back = np.linalg.inv(to_flat)

    def turned(m: Float) -> Map:
        return lambda p, q: (m[0, 0] * p + m[0, 1] * q, m[1, 0] * p + m[1, 1] * q)

    return _seen(
        "plane", lambda x, y: 0.3 * x + 0.2 * y, turned(to_flat), turned(back), everywhere,
        (-0.22, 0.22, -0.22, 0.22), turn_deg, step_m,
    )  # fmt: skip


def half_cylinder(
    step_m: float = STEP_M, turn_deg: float = 30.0, radius_m: float = 0.1, part: float = 1.0
) -> Patch:
    """z = sqrt(r^2 - x^2) for |x| < part * r, as in Fig. 2 of the paper."""
    r = radius_m
    return _seen(
        "half cylinder", lambda x, y: np.sqrt(np.maximum(r * r - x * x, 0)),
        lambda x, y: (r * np.arcsin(np.clip(x / r, -1, 1)), y), lambda u, v: (r * np.sin(u / r), v),
        lambda x, y: np.abs(x) <= part * r, (-r, r, -3.5 * r, 3.5 * r), turn_deg, step_m,
    )  # fmt: skip


def cone(step_m: float = STEP_M, turn_deg: float = 30.0) -> Patch:
    """A cone with its axis along y, seen up to 80 degrees of slope."""
    widening = 0.35
    half = np.arctan(widening)
    widest = np.sin(np.radians(80.0)) * widening

    def flat(x: Float, y: Float) -> tuple[Float, Float]:
        rho, angle = y / np.cos(half), np.arcsin(np.clip(x / (y * widening), -1, 1)) * np.sin(half)
        return rho * np.sin(angle), rho * np.cos(angle)

    def inverse(u: Float, v: Float) -> tuple[Float, Float]:
        y = np.hypot(u, v) * np.cos(half)
        return y * widening * np.sin(np.arctan2(u, v) / np.sin(half)), y

    return _seen(
        "cone", lambda x, y: np.sqrt(np.maximum((y * widening) ** 2 - x * x, 0)), flat, inverse,
        lambda x, y: np.abs(x) < widest * y, (-0.25, 0.25, 0.15, 0.65), turn_deg, step_m,
    )  # fmt: skip


def curtain(
    amplitude_m: float, step_m: float = STEP_M, turn_deg: float = 30.0, period_m: float = 0.12,
    hidden: Inside | None = None, name: str = "",
) -> Patch:  # fmt: skip
    """z = A sin(2 pi x / P), 0.4 m by 0.5 m; `hidden` cuts a part out."""
    w = 2 * np.pi / period_m
    xs = np.linspace(-0.25, 0.25, 40001)
    speed = np.sqrt(1 + (amplitude_m * w * np.cos(w * xs)) ** 2)
    arc = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * (xs[1] - xs[0]))])
    arc -= arc[len(arc) // 2]
    return _seen(
        name or f"curtain {amplitude_m * 1e3:.0f} mm", lambda x, y: amplitude_m * np.sin(w * x),
        lambda x, y: (np.interp(x, xs, arc), y), lambda u, v: (np.interp(u, arc, xs), v),
        everywhere if hidden is None else (lambda x, y: ~hidden(x, y)), (-0.2, 0.2, -0.25, 0.25),
        turn_deg, step_m,
    )  # fmt: skip


def stripe(x: Float, y: Float) -> Bool:
    """A missing band of 30 mm across most of the folds."""
    return np.asarray((np.abs(x) < 0.1) & (np.abs(y - 0.03) < 0.015))


def slit(x: Float, y: Float) -> Bool:
    """A cut of 8 mm in from one side."""
    return np.asarray((x > -0.05) & (np.abs(y + 0.02) < 0.004))


def flap(raise_m: float = 0.03, step_m: float = STEP_M) -> tuple[Patch, Bool]:
    """A flat cloth, a flap 80 mm wide `raise_m` in front of it, and which points are the flap's."""
    sheet = _seen(
        "flap", lambda x, y: np.where(np.abs(x) < 0.04, raise_m, 0.0), lambda x, y: (x, y),
        lambda u, v: (u, v), everywhere, (-0.15, 0.15, -0.1, 0.1), 0.0, step_m,
    )  # fmt: skip
    return sheet, sheet.xyz[sheet.mask][:, 2] > raise_m / 2
