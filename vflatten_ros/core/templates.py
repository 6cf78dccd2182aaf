"""Families of garment outlines: named sizes with typical values and spreads, parts that turn.

A template is data (config/categories): this module checks it and turns it into arrays. A cut is
given by its `state`, one number for every degree of freedom in units of its own spread: zeros are
the typical cut, and a standard normal state is the family.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.errors import InvalidConfig

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_TERM = re.compile(r"([+-]?)(?:(\d+\.?\d*|\.\d+)\*?)?([A-Za-z_]\w*)?")
MOST_BEND = np.radians(110.0)  # of an outline at a joint
_KEYS = {
    "category",
    "single_sheet",
    "sizes",
    "parts",
    "half",
    "landmarks",
    "measurements",
    "order",
}
_POINT_KEYS = {"at", "bend", "name", "open", "part"}


@dataclass(frozen=True, eq=False)
class Template:
    """One category's outlines. Points are the outline's vertices, then further named points.

    The state is (sizes, angle of each part, swing of each right part, swing of each left part).
    """

    category: str
    sizes: tuple[str, ...]
    parts: tuple[str, ...]
    points: tuple[str, ...]  # (p,) names, "" where unnamed
    vertices: int  # the first `vertices` points are the outline, counter-clockwise
    helpers: int  # the last `helpers` points only serve measurements
    log_typical: Float  # (s,) logarithm of the typical sizes, m
    log_spread: Float  # (s, s) logarithm of the sizes per unit of state
    angle: Float  # (a,) typical angle of each part, rad
    spread: Float  # (a,) rad per unit of state
    swing: Float  # (a,) rad per unit of state, each side by itself
    fixed: Float  # (p, 2, s) right half: coordinates per size, of the pivot for points of a part
    turned: Float  # (p, 2, s) coordinates from the pivot per size, before turning
    part: Int  # (p,) index of the point's part, -1: none
    bend: NDArray[np.bool_]  # (p,) on the mitre between its part and the body
    side: Float  # (p,) 1 right or middle, -1 left: mirrored
    paths: Mapping[str, tuple[Int, ...]]  # measurement -> its path, and its mirror image
    order: tuple[str, ...]  # measurements that ascend by definition
    seam: NDArray[np.bool_]  # (k,) front and back hang together from this vertex to the next
    single_sheet: bool = False  # both faces are of one sheet, as a towel's

    @property
    def dimensions(self) -> int:
        """Length of a state."""
        return len(self.sizes) + 3 * len(self.parts)

    @property
    def landmarks(self) -> dict[str, int]:
        """Named points -> index."""
        named = self.points[: len(self.points) - self.helpers]
        return {name: i for i, name in enumerate(named) if name}

    def size_values(self, state: Float) -> Float:
        """(..., s) sizes in metres of (..., m) states."""
        values: Float = np.exp(self.log_typical + state[..., : len(self.sizes)] @ self.log_spread.T)
        return values

    def place(self, state: Float) -> tuple[Float, Float]:
        """Points of the template and how they move with the state.

        Parameters
        ----------
        state : ndarray of shape (..., m)

        Returns
        -------
        points : ndarray of shape (..., p, 2)
            Metres, u right, v up.
        slope : ndarray of shape (..., p, 2, m)
            Derivative of the points by the state.
        """
        size = self.size_values(state)
        by_state = size[..., :, None] * self.log_spread  # (..., s, s)
        slope = np.zeros((*state.shape[:-1], len(self.points), 2, self.dimensions))
        points = np.einsum("pis,...s->...pi", self.fixed, size)
        n, a = len(self.sizes), len(self.parts)
        slope[..., :n] = np.einsum("pis,...st->...pit", self.fixed, by_state)
        if a:
            index = np.maximum(self.part, 0)
            arm = np.einsum("pis,...s->...pi", self.turned, size)
            grow = np.einsum("pis,...st->...pit", self.turned, by_state)
            own = np.where(self.side > 0, n + a, n + 2 * a) + index
            angle = (
                self.angle[index]
                + state[..., n + index] * self.spread[index]
                + state[..., own] * self.swing[index]
            )
            matrix, change = _turn(angle, self.bend)
            points = points + np.einsum("...pij,...pj->...pi", matrix, arm)
            slope[..., :n] += np.einsum("...pij,...pjt->...pit", matrix, grow)
            across = np.einsum("...pij,...pj->...pi", change, arm)
            every = np.arange(len(self.points))
            for column, scale in ((n + index, self.spread[index]), (own, self.swing[index])):
                columns = np.moveaxis(slope, (-3, -1), (0, 1))  # view: (p, m, ..., 2)
                columns[every, column] += np.moveaxis(across * scale[:, None], -2, 0)
        points[..., 0] *= self.side
        slope[..., 0, :] *= self.side[:, None]
        return points, slope

    def outline(self, state: Float) -> Float:
        """(..., k, 2) outline of (..., m) states, counter-clockwise, metres."""
        return self.place(state)[0][..., : self.vertices, :]

    def at_rest(self, state: Float) -> Float:
        """The same cut with every part at the angle at which it was cut."""
        rest = state.copy()
        rest[..., len(self.sizes) + len(self.parts) :] = 0.0
        return rest

    def same_build(self, other: Template) -> bool:
        """Whether only typical sizes and angles tell the two apart, as shorts and trousers."""
        return (self.sizes, self.parts, self.points) == (other.sizes, other.parts, other.points)

    def state_of(self, other: Template, state: Float) -> Float:
        """State (m,) with the sizes and angles of another category's, of the same build."""
        n, a = len(self.sizes), len(self.parts)
        off = np.log(other.size_values(state)) - self.log_typical
        turned = other.angle + state[n : n + a] * other.spread - self.angle
        swung = state[n + a :] * np.tile(other.swing, 2)
        scale = np.r_[self.spread, self.swing, self.swing]
        parts = np.zeros(3 * a)  # a part that cannot turn stays as it is
        np.divide(np.r_[turned, swung], scale, out=parts, where=scale > 0)
        taken: Float = np.r_[np.linalg.solve(self.log_spread, off), parts]
        return taken

    def measure(self, state: Float, covariance: Float) -> dict[str, tuple[float, float]]:
        """Named sizes of one cut.

        Parameters
        ----------
        state : ndarray of shape (m,)
        covariance : ndarray of shape (m, m)
            Of the state.

        Returns
        -------
        dict
            Measurement -> value and standard deviation, metres.
        """
        points, slope = self.place(self.at_rest(state))
        slope[..., len(self.sizes) + len(self.parts) :] = 0.0
        found = {name: _path(paths[0], points, slope) for name, paths in self.paths.items()}
        values = sorted((found[name] for name in self.order), key=lambda pair: float(pair[0]))
        found.update(zip(self.order, values, strict=True))
        return {
            name: (value, float(np.sqrt(max(float(row @ covariance @ row), 0.0))))
            for name, (value, row) in found.items()
        }


def _turn(angle: Float, bend: NDArray[np.bool_]) -> tuple[Float, Float]:
    """(..., p, 2, 2) rotations and their derivatives; to the mitre where the outline bends.

    The mitre of two edges at a distance from their common pivot lies at half the angle between
    them, farther away by 1 / cos of it: the matrix is I + tan(angle / 2) J.
    """
    half = np.tan(0.5 * np.clip(angle, -MOST_BEND, MOST_BEND))
    one, none = np.ones_like(angle), np.zeros_like(angle)
    cos, sin = np.where(bend, one, np.cos(angle)), np.where(bend, half, np.sin(angle))
    cos_slope = np.where(bend, none, -np.sin(angle))
    sin_slope = np.where(bend, 0.5 * (1.0 + half**2), np.cos(angle))
    matrix = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    change = np.stack(
        [np.stack([cos_slope, -sin_slope], -1), np.stack([sin_slope, cos_slope], -1)], -2
    )
    return matrix, change


def _path(path: Int, points: Float, slope: Float) -> tuple[float, Float]:
    """Length of a path along points and its derivative by the state."""
    step = np.diff(points[path], axis=0)
    length = np.linalg.norm(step, axis=1)
    along = step / np.maximum(length, 1e-9)[:, None]
    row: Float = np.einsum("ei,eim->m", along, np.diff(slope[path], axis=0))
    return float(length.sum()), row


def templates_from(mappings: Sequence[Mapping[str, Any]]) -> tuple[Template, ...]:
    """Templates from descriptions as in config/categories/README.md, sorted by category.

    Raises
    ------
    InvalidConfig
        A description that lacks a key, names what is not there, or outlines nothing.
    """
    templates = sorted((_template(m) for m in mappings), key=lambda t: t.category)
    names = [t.category for t in templates]
    for name in names:
        if names.count(name) > 1:
            raise InvalidConfig(f"category {name!r} is described twice; remove one of the files")
    return tuple(templates)


def _template(data: Mapping[str, Any]) -> Template:
    name = data.get("category")
    if not isinstance(name, str) or not name or name == "unknown":
        raise InvalidConfig(f"category: expected a name other than 'unknown', got {name!r}")
    try:
        return _Reader(data).template(name)
    except InvalidConfig as error:
        raise InvalidConfig(f"category {name!r}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise InvalidConfig(
            f"category {name!r}: not understood ({type(error).__name__}: {error}); "
            "see config/categories/README.md"
        ) from error


def _number(part: Mapping[str, Any], key: str, low: float = -np.inf) -> float:
    value = float(part[key])
    if not (np.isfinite(value) and value >= low):
        least = "" if low == -np.inf else f" of {low:g} or more"
        raise InvalidConfig(f"parts: {key}: expected a number{least}, got {value}")
    return value


class _Reader:
    """Turns one description into arrays."""

    def __init__(self, data: Mapping[str, Any]) -> None:
        self.data = data
        unknown = sorted(set(data) - _KEYS)
        if unknown:
            raise InvalidConfig(f"unknown key {unknown[0]!r}; known are {', '.join(sorted(_KEYS))}")
        for key in ("sizes", "half", "measurements"):
            if not data.get(key):
                raise InvalidConfig(f"{key} is missing or empty")
        self.sizes: list[str] = list(data["sizes"])
        self.parts: list[str] = list(data.get("parts") or {})
        self.names: list[str] = []
        self.rows: list[
            tuple[Float, Float, int, bool, float]
        ] = []  # fixed, turned, part, bend, side

    def template(self, name: str) -> Template:
        log_typical, log_spread = self.spreads()
        self.outline()
        vertices = len(self.names)
        for point in self.data.get("landmarks") or []:
            self.landmark(point)
        named = len(self.names)
        paths = {m: self.paths(p) for m, p in self.data["measurements"].items()}
        for size in ("width", "length"):
            if size not in paths:
                raise InvalidConfig(f"measurements.{size} is missing")
        order = tuple(self.data.get("order") or ())
        if len(set(order)) < len(order):
            raise InvalidConfig(f"order names a measurement twice: {order}")
        if not set(order) <= set(paths):
            raise InvalidConfig(f"order names a measurement that is not there: {order}")
        parts = [self.data["parts"][p] for p in self.parts]
        fixed, turned, part, bend, side = zip(*self.rows)
        template = Template(
            category=name,
            sizes=tuple(self.sizes),
            parts=tuple(self.parts),
            points=tuple(self.names),
            vertices=vertices,
            helpers=len(self.names) - named,
            log_typical=log_typical,
            log_spread=log_spread,
            angle=np.radians([_number(p, "angle") for p in parts]),
            spread=np.radians([_number(p, "spread", 0.0) for p in parts]),
            swing=np.radians([_number(p, "swing", 0.0) for p in parts]),
            fixed=np.array(fixed),
            turned=np.array(turned),
            part=np.array(part, dtype=np.int64),
            bend=np.array(bend, dtype=bool),
            side=np.array(side),
            paths=paths,
            order=order,
            seam=self.seam(),
            single_sheet=self.single_sheet(),
        )
        rest = np.zeros(template.dimensions)
        _check_outline(template.outline(rest))
        for measured, (metres, _) in template.measure(rest, np.eye(template.dimensions)).items():
            if not metres > 0.0:
                raise InvalidConfig(f"measurements.{measured}: its path has no length")
        return template

    def single_sheet(self) -> bool:
        single = self.data.get("single_sheet", False)
        if not isinstance(single, bool):
            raise InvalidConfig(f"single_sheet: expected true or false, got {single!r}")
        return single

    def seam(self) -> NDArray[np.bool_]:
        """Edges that are no openings; none if no opening is described: then nothing is known."""
        half = [point.get("open", False) for point in self.data["half"][:-1]]
        for value in half:
            if not isinstance(value, bool):
                raise InvalidConfig(f"open: expected true or false, got {value!r}")
        return ~np.array(half + half[::-1]) if any(half) else np.zeros(2 * len(half), dtype=bool)

    def spreads(self) -> tuple[Float, Float]:
        """Typical sizes and how they vary together: a ratio follows the size that it is of."""
        n = len(self.sizes)
        typical, spread = np.zeros(n), np.zeros((n, n))
        for i, name in enumerate(self.sizes):
            size = self.data["sizes"][name]
            value, width = float(size["typical"]), float(size["spread"])
            if not (0.0 < value < np.inf and 0.0 < width < np.inf):
                raise InvalidConfig(f"sizes.{name}: typical and spread must be > 0, got {size}")
            typical[i], spread[i, i] = np.log(value), width
            if size.get("of") is not None:
                if size["of"] not in self.sizes[:i]:
                    raise InvalidConfig(
                        f"sizes.{name}: {size['of']!r} is no size described above it"
                    )
                base = self.sizes.index(size["of"])
                typical[i] += typical[base]
                spread[i] += spread[base]
        return typical, spread

    def outline(self) -> None:
        half = list(self.data["half"])
        middle = [self.point(p) for p in half]
        ends = [
            np.abs(row[0][0]).max() + np.abs(row[1][0]).max() for row in (middle[0], middle[-1])
        ]
        if max(ends) > 0.0:
            raise InvalidConfig("half must begin and end on the middle line, at u = 0")
        for point, row in zip(half, middle):
            name = point.get("name", "")
            on_line = row is middle[0] or row is middle[-1]
            self.add(name if on_line or not name else f"right_{name}", row, 1.0)
        for point, row in zip(half[-2:0:-1], middle[-2:0:-1]):
            name = point.get("name", "")
            self.add(f"left_{name}" if name else "", row, -1.0)

    def landmark(self, point: Mapping[str, Any]) -> None:
        row = self.point(point)
        if not np.abs(row[0][0]).max() and row[2] < 0:
            self.add(point["name"], row, 1.0)
            return
        self.add(f"right_{point['name']}", row, 1.0)
        self.add(f"left_{point['name']}", row, -1.0)

    def add(self, name: str, row: tuple[Float, Float, int, bool], side: float) -> None:
        if name and name in self.names:
            raise InvalidConfig(f"point {name!r} is described twice")
        self.names.append(name)
        self.rows.append((*row, side))

    def point(self, point: Mapping[str, Any]) -> tuple[Float, Float, int, bool]:
        unknown = sorted(set(point) - _POINT_KEYS)
        if unknown:
            keys = ", ".join(sorted(_POINT_KEYS))
            raise InvalidConfig(f"unknown key {unknown[0]!r} of a point; known are {keys}")
        at = np.array([self.sum(value) for value in point["at"]])
        if at.shape != (2, len(self.sizes)):
            raise InvalidConfig(f"at: expected [u, v], got {point['at']!r}")
        if point.get("part") is None:
            return at, np.zeros_like(at), -1, False
        if point["part"] not in self.parts:
            raise InvalidConfig(f"no part {point['part']!r} among {self.parts}")
        pivot = self.data["parts"][point["part"]]["pivot"]
        return (
            np.array([self.sum(v) for v in pivot]),
            at,
            self.parts.index(point["part"]),
            bool(point.get("bend", False)),
        )

    def sum(self, value: Any) -> Float:
        """Coefficients of the sizes in '0.5 * waist - height' or 0."""
        factors = np.zeros(len(self.sizes))
        text = str(value).replace(" ", "")
        if text in ("0", "0.0"):
            return factors
        end = 0
        for term in _TERM.finditer(text):
            if term.start() != end or not term.group(0):
                break
            sign, factor, name = term.groups()
            if name is None or name not in self.sizes or (end and not sign):
                break
            factors[self.sizes.index(name)] += float(factor or 1.0) * (-1.0 if sign == "-" else 1.0)
            end = term.end()
        if end != len(text):
            raise InvalidConfig(
                f"{value!r} is not a sum of sizes, like '0.5 * {self.sizes[0]}'; "
                f"sizes are {', '.join(self.sizes)}"
            )
        return factors

    def paths(self, path: Sequence[Any]) -> tuple[Int, ...]:
        """Indices of a path and of its mirror image."""
        if len(path) < 2:
            raise InvalidConfig(f"a measurement needs two points or more, got {path!r}")
        here, mirrored = zip(*(self.step(point) for point in path))
        return np.array(here, dtype=np.int64), np.array(mirrored, dtype=np.int64)

    def step(self, point: Any) -> tuple[int, int]:
        if isinstance(point, str):
            if point not in self.names:
                raise InvalidConfig(
                    f"no point {point!r}; points are {', '.join(filter(None, self.names))}"
                )
            return self.names.index(point), self.names.index(_mirror_name(point))
        row = self.point({"at": point})
        self.add("", row, 1.0)
        self.add("", row, -1.0)
        return len(self.names) - 2, len(self.names) - 1


def _mirror_name(name: str) -> str:
    if name.startswith("left_"):
        return "right_" + name[5:]
    return "left_" + name[6:] if name.startswith("right_") else name


def _check_outline(outline: Float) -> None:
    after = np.roll(outline, -1, axis=0)
    twice_area = (outline[:, 0] * after[:, 1] - outline[:, 1] * after[:, 0]).sum()
    if twice_area <= 0.0:
        raise InvalidConfig(
            "the typical outline encloses nothing or runs clockwise; list the right half from the "
            "middle of the bottom edge counter-clockwise"
        )
