"""The parts of figures that lie in a plane: a view, the flattened item. Centimetres."""

from __future__ import annotations

from collections.abc import Sequence
from string import ascii_uppercase
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patheffects import withStroke

from vflatten_ros.core.turntable import TURN
from vflatten_ros.core.values import FlatGarment, Float, View

# colour-blind-safe (Okabe and Ito 2008)
BLUE, ORANGE, VERMILION, GREEN = "#0072B2", "#E69F00", "#D55E00", "#009E73"
PURPLE, SKY, INK, CLOTH = "#CC79A7", "#56B4E9", "#333333", "#E3ECF3"
VIEW_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION)
FLAT_COLOURS = "cividis"  # by u in the flat plane
CM = 100.0
SLICE_M = 0.004  # above and below the height of a slice


def draw_view(ax: Axes, garment: FlatGarment, view: View, colour: str) -> None:
    """One view as the rig sees it, with its points; x right, y up, in cm from the gripper tip."""
    x, y, _ = CM * view.points_view.T
    faded = 0.45 + 0.55 * shade(view)
    ax.scatter(x, y, s=2.0, c=faded, marker="s", linewidths=0, rasterized=True)
    own = (garment.points.view_id == view.view_id) & (garment.points.pixel[:, 0] >= 0)
    at = CM * view.points_view[_rows(view, garment.points.pixel[own])[0]]
    size = float(np.clip(3000 / max(len(at), 1), 3.0, 9.0))
    ax.scatter(at[:, 0], at[:, 1], s=size, c=colour, linewidths=0)
    for letter, place in _lettered(garment, view):
        x_cm, y_cm = (CM * place[:2]).tolist()
        ax.plot(x_cm, y_cm, "o", ms=8, mfc="none", mec=VERMILION, mew=2)
        ax.annotate(
            letter, (x_cm, y_cm), (7, 5), textcoords="offset points", color=VERMILION,
            fontweight="bold", fontsize=12, path_effects=halo(),
        )  # fmt: skip
    cm_axes(ax, "x (cm)", "y, up (cm)")


def draw_slice(ax: Axes, views: Sequence[View]) -> None:
    """What the views see of the item at its middle height, from above; cm from the wrist axis."""
    seen = [view.points_hanger for view in views]
    middle = float(np.median(np.concatenate(seen)[:, 2]))
    for view, xyz in zip(views, seen, strict=True):
        x, y, _ = CM * xyz[np.abs(xyz[:, 2] - middle) < SLICE_M].T
        colour = colormaps["twilight"](view.angle_rad / TURN % 1.0)
        ax.plot(x, y, ".", ms=2, color=colour)
    ax.plot(0.0, 0.0, "+", ms=12, color=INK)
    cm_axes(ax, "x (cm)", "y (cm)")


def draw_stress(ax: Axes, garment: FlatGarment) -> None:
    """Flattened points coloured by their misfit."""
    u, v = CM * garment.points.uv.T
    worst = max(float(np.quantile(garment.points.stress, 0.98)) if len(u) else 0.0, 1e-4)
    dots = ax.scatter(u, v, s=8, c=1000 * garment.points.stress, vmin=0, vmax=1000 * worst)
    ax.figure.colorbar(dots, ax=ax, label="misfit of distances (mm)", shrink=0.8)
    ax.set_title("misfit of the flattened points")


def draw_flat(ax: Axes, garment: FlatGarment) -> None:
    """The flattened item: cloth, points by view, outline seen or inferred, W and L."""
    if len(garment.outline.uv) >= 3:
        ax.fill(*(CM * garment.outline.uv.T), color=CLOTH, zorder=0)
    draw_outline(ax, garment)
    draw_dots(ax, garment, garment.points.uv)
    draw_sizes(ax, garment)
    for mark in garment.landmarks:
        ax.plot(CM * mark.uv[0], CM * mark.uv[1], "D", ms=4, color=PURPLE, zorder=4)
    if garment.landmarks:
        ax.plot([], [], "D", ms=4, color=PURPLE, label="landmarks")
    legend(ax)
    cm_axes(ax, "u (cm)", "v (cm)")


def draw_outline(ax: Axes, garment: FlatGarment) -> None:
    """Outline of the flattened item: solid where seen, dashed where inferred."""
    if len(garment.outline.uv) < 3:
        return
    outline = CM * garment.outline.uv
    closed = np.concatenate([outline, outline[:1]])
    ends = np.stack([closed[:-1], closed[1:]], axis=1)
    for inferred, colour, name in ((False, INK, "outline, seen"), (True, ORANGE, "inferred")):
        part = ends[garment.outline.inferred == inferred]
        style = "dashed" if inferred else "solid"
        if len(part):
            ax.add_collection(LineCollection(list(part), colors=colour, lw=2, ls=style, label=name))


def draw_sizes(ax: Axes, garment: FlatGarment) -> None:
    """W and L as arrows."""
    for measurement in garment.measurements:
        if measurement.name in ("width", "length") and measurement.ends_uv is not None:
            _draw_size(ax, measurement.name[0].upper(), measurement.value_m, measurement.ends_uv)


def _draw_size(ax: Axes, letter: str, value_m: float, ends_uv: Any) -> None:
    start, end = CM * np.array(ends_uv)
    arrow = {"arrowstyle": "<->", "color": VERMILION, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", start, end, arrowprops=arrow, zorder=5)
    text = f"{letter} {CM * value_m:.1f} cm"
    ax.annotate(
        text, start + 0.38 * (end - start), color=VERMILION, fontsize=11, fontweight="bold",
        ha="center", va="center", path_effects=halo(), zorder=6,
    )  # fmt: skip


def draw_dots(ax: Axes, garment: FlatGarment, uv: Float) -> None:
    """Points in the plane, a colour a view where the views are few."""
    points = garment.points
    ids = [i for i in garment.view_ids if (points.view_id == i).any()]
    size = 14 if len(uv) < 1500 else 2.5
    if len(ids) > len(VIEW_COLOURS):
        seen = points.view_id >= 0
        u, v = CM * uv[seen].T
        colour = points.uv[seen, 0]
        ax.scatter(u, v, s=size, c=colour, cmap=FLAT_COLOURS, alpha=0.5, lw=0, label="seen points")
    else:
        for view_id, colour in zip(sorted(ids), VIEW_COLOURS, strict=False):
            u, v = CM * uv[points.view_id == view_id].T
            ax.scatter(u, v, s=size, c=colour, lw=0, label=f"view {view_id}", zorder=2)
    unseen = points.view_id < 0
    if unseen.any():
        u, v = CM * uv[unseen].T
        ax.scatter(u, v, s=size, c="#999999", lw=0, label="in no view")


def draw_cloth(ax: Axes, garment: FlatGarment, views: Sequence[View]) -> None:
    """The flattened item in the colours of its cloth, with outline, W and L."""
    places, colours = [np.empty((0, 2))], [np.empty((0, 3))]
    for view in views:
        own = garment.points.view_id == view.view_id
        index, known = _rows(view, garment.points.pixel[own])
        places.append(garment.points.uv[own][known])
        colours.append(shade(view)[index])
    colour = np.concatenate(colours)
    bright = np.argsort(colour.sum(axis=1), kind="stable")  # what faces its camera goes on top
    u, v = CM * np.concatenate(places)[bright].T
    size = float(np.clip(4e4 / max(len(u), 1), 4.0, 20.0))
    ax.scatter(u, v, s=size, c=colour[bright], marker="s", lw=0, rasterized=True)
    draw_outline(ax, garment)
    draw_sizes(ax, garment)
    cm_axes(ax, "u (cm)", "v (cm)")


def cm_axes(ax: Axes, x: str, y: str) -> None:
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.grid(color="#E6E6E6", lw=0.6)
    ax.set_axisbelow(True)


def legend(ax: Axes) -> None:
    handles, names = ax.get_legend_handles_labels()
    if names:
        ax.legend(handles, names, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def halo() -> list[Any]:
    return [withStroke(linewidth=3, foreground="white")]


def title(garment: FlatGarment) -> str:
    parts = [words(garment.category)]
    for letter, name in (("W", "width"), ("L", "length")):
        size = garment.measurement(name)
        if size is not None:
            mark = ", inferred" if size.inferred else ""
            parts.append(f"{letter} {CM * size.value_m:.1f} ± {CM * size.sigma_m:.1f} cm{mark}")
    return "   ".join(parts)


def words(name: str) -> str:
    return name.replace("_", " ")


def shade(view: View) -> Any:
    """Colours of a view's points: the camera's, or light by depth."""
    if view.rgb is not None:
        return view.rgb / 255.0
    depth = view.points_view[:, 2]
    near = (depth - depth.min()) / max(float(np.ptp(depth)), 1e-6)
    return np.repeat(0.45 + 0.45 * near[:, None], 3, axis=1)


def _rows(view: View, pixel: Any) -> tuple[Any, Any]:
    """Rows of a view's points at some pixels, and which of the pixels the view has."""
    width = view.shape[1]
    keys = view.pixel[:, 0].astype(np.int64) * width + view.pixel[:, 1]
    order = np.argsort(keys)
    wanted = pixel[:, 0] * width + pixel[:, 1]
    index = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
    known = keys[index] == wanted
    return index[known], known


def _lettered(garment: FlatGarment, view: View) -> list[tuple[str, Float]]:
    """Letter and place of every corresponding point in a view, at most 26."""
    found = []
    for letter, pair in zip(ascii_uppercase, garment.correspondences, strict=False):
        sides = ((pair.view_a, pair.pixel_a), (pair.view_b, pair.pixel_b))
        for view_id, pixel in sides:
            if view_id == view.view_id:
                index, _ = _rows(view, np.array([pixel]))
                found += [(letter, place) for place in view.points_view[index]]
    return found
