"""Pictures of a result in the manner of Kita & Kita 2019, Figs. 3, 4, 6 and 8, and a summary."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from vflatten_ros.core.config import RecognitionConfig
from vflatten_ros.core.geometry import R_VIEW_HANGER0, transform_points
from vflatten_ros.core.model_images import MARGIN, model_image
from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import FlatGarment, Float, View

# colour-blind-safe (Okabe and Ito 2008)
BLUE, ORANGE, VERMILION, GREEN = "#0072B2", "#E69F00", "#D55E00", "#009E73"
PURPLE, SKY, INK, CLOTH = "#CC79A7", "#56B4E9", "#333333", "#E3ECF3"
VIEW_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION)
FLAT_COLOURS = "cividis"  # by u in the flat plane
VIEWS_SHOWN = 4
DOTS_3D = 9000
LINES_SHOWN = 40
DPI = 120
CM = 100.0


def draw_figures(
    garment: FlatGarment,
    views: Sequence[View],
    folder: Path,
    templates: Sequence[Template] = (),
) -> list[Path]:
    """Write views.png, geodesics.png, flattening.png, category.png and summary.png.

    Parameters
    ----------
    garment : FlatGarment
    views : sequence of View
        Those that the garment was flattened from.
    folder : path
        Made if it is missing.
    templates : sequence of Template
        Categories whose model images are shown.

    Returns
    -------
    list of Path
    """
    folder.mkdir(parents=True, exist_ok=True)
    shown = shown_views(garment, views)
    figures = {
        "views": views_figure(garment, shown),
        "geodesics": geodesics_figure(garment, shown),
        "flattening": flattening_figure(garment),
        "category": category_figure(garment, templates),
        "summary": summary_figure(garment, views),
    }
    paths = []
    for name, figure in figures.items():
        paths.append(folder / f"{name}.png")
        figure.savefig(paths[-1], dpi=DPI, metadata={"Software": None})
    return paths


def shown_views(garment: FlatGarment, views: Sequence[View]) -> list[View]:
    """The views used, no more than four, evenly spread."""
    used = sorted((v for v in views if v.view_id in garment.view_ids), key=lambda v: v.view_id)
    if len(used) <= VIEWS_SHOWN:
        return used
    return [used[round(i * len(used) / VIEWS_SHOWN)] for i in range(VIEWS_SHOWN)]


def views_figure(garment: FlatGarment, views: Sequence[View]) -> Figure:
    """Fig. 3: the views, the points used (boundary) and the corresponding points, lettered."""
    figure = Figure(figsize=(3.4 * max(len(views), 1), 6.0), layout="constrained")
    for k, (ax, view) in enumerate(zip(_row(figure, len(views)), views, strict=True)):
        draw_view(ax, garment, view, VIEW_COLOURS[k])
        ax.set_title(f"view {view.view_id}, item at {np.degrees(view.angle_rad):.0f}°")
    figure.suptitle("Points used (dots) and corresponding points (letters)")
    return figure


def draw_view(ax: Axes, garment: FlatGarment, view: View, colour: str) -> None:
    """One view as the rig sees it, with its points; x right, y up, in cm from the gripper tip."""
    x, y, _ = CM * view.points_view.T
    faded = 0.45 + 0.55 * _shade(view)
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
            fontweight="bold", fontsize=12, path_effects=_halo(),
        )  # fmt: skip
    _cm_axes(ax, "x (cm)", "y, up (cm)")


def geodesics_figure(garment: FlatGarment, views: Sequence[View]) -> Figure:
    """Fig. 4: geodesic lines in 3-D on the cloud of each view."""
    lines = garment.lines
    having = [v for v in views if (lines.view_id == v.view_id).any()]
    whole = (lines.view_id < 0).any() or (len(lines.view_id) > 0 and not having)
    panels: list[View | None] = list(having) or ([None] if whole else [])
    figure = Figure(figsize=(4.6 * max(len(panels), 1), 6.2), layout="constrained")
    for k, view in enumerate(panels):
        ax: Any = figure.add_subplot(1, len(panels), k + 1, projection="3d")
        if view is None:
            cloud = _hanging(garment.points.xyz_hanger, None)
            chosen = np.arange(len(lines.view_id))
        else:
            cloud = view.points_view
            chosen = np.flatnonzero(lines.view_id == view.view_id)
        _draw_lines(ax, garment, view, cloud, chosen)
        name = "all views" if view is None else f"view {view.view_id}"
        total, flagged = len(chosen), int(lines.flagged[chosen].sum())
        ax.set_title(f"{name}: some of {total} geodesic lines\n({flagged} flagged, orange)")
    if not panels:
        _draw_hanging(figure, garment)
    return figure


def _draw_lines(
    ax: Any, garment: FlatGarment, view: View | None, cloud: Float, chosen: Any
) -> None:
    """Lines over a cloud. Drawn axes: x right, depth away from the rig, y up."""
    axes = CM * np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # view -> drawn
    x, depth, y = (cloud[:: max(1, len(cloud) // DOTS_3D)] @ axes).T
    ax.scatter(x, depth, y, s=0.8, c="#A5A5A5", alpha=0.4, linewidths=0, depthshade=False)
    for i in _long_ones(garment, chosen):
        nodes = _hanging(garment.lines.nodes_hanger[i], view) @ axes
        colour = ORANGE if garment.lines.flagged[i] else VERMILION
        ax.plot(*nodes.T, color=colour, lw=1.6)
        ax.plot(*nodes[[0, -1]].T, color=BLUE, marker=".", ls="none", ms=5)
    spans = np.maximum([np.ptp(x), np.ptp(depth), np.ptp(y)], 1.0)
    ax.set_box_aspect(spans, zoom=1.0)
    ax.view_init(elev=14, azim=-62)
    for axis, name, span in zip(
        (ax.xaxis, ax.yaxis, ax.zaxis), ("x", "depth", "y"), spans, strict=True
    ):
        axis.set_major_locator(MaxNLocator(max(2, round(6 * span / spans.max()))))
        axis.set_label_text(f"{name} (cm)")
        axis.labelpad = 16 if name == "y" else 6
        axis.set_tick_params(pad=6 if name == "y" else 2)


def _draw_hanging(figure: Figure, garment: FlatGarment) -> None:
    """Where no lines were kept: the hanging points from two sides, coloured by their flat place."""
    figure.set_size_inches(9.2, 6.2)
    seen = garment.points.view_id >= 0
    step = max(1, int(seen.sum()) // DOTS_3D)
    x, y, z = CM * garment.points.xyz_hanger[seen][::step].T
    for k, side in enumerate((0, 180)):
        ax: Any = figure.add_subplot(1, 2, k + 1, projection="3d")
        u = garment.points.uv[seen][::step, 0]
        ax.scatter(x, y, z, s=2, c=u, cmap=FLAT_COLOURS, linewidths=0, depthshade=False)
        ax.set_box_aspect([max(float(np.ptp(v)), 1.0) if len(v) else 1.0 for v in (x, y, z)])
        ax.view_init(elev=14, azim=side)
        ax.set_axis_off()
        ax.set_title(f"hanging, from {side}°; colour: u when flat")


def _long_ones(garment: FlatGarment, chosen: Any) -> Any:
    """Some of the longer half of the lines, evenly spread over their order."""
    length = garment.lines.length_m[chosen]
    longer = chosen[length >= np.median(length)] if len(chosen) else chosen
    return longer[:: max(1, -(-len(longer) // LINES_SHOWN))]


def flattening_figure(garment: FlatGarment) -> Figure:
    """Fig. 6: where the flattening started, and the flattened item with W and L."""
    figure = Figure(figsize=(11.0, 6.2), layout="constrained")
    left, right = _row(figure, 2)
    if garment.start_uv is not None and len(garment.start_uv):
        _dots(left, garment, garment.start_uv)
        left.set_title("start (u₀, v₀)")
        _legend(left)
    else:
        draw_stress(left, garment)
    _cm_axes(left, "u (cm)", "v (cm)")
    draw_flat(right, garment)
    right.set_title(_title(garment))
    return figure


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
    _dots(ax, garment, garment.points.uv)
    draw_sizes(ax, garment)
    for mark in garment.landmarks:
        ax.plot(CM * mark.uv[0], CM * mark.uv[1], "D", ms=4, color=PURPLE, zorder=4)
    if garment.landmarks:
        ax.plot([], [], "D", ms=4, color=PURPLE, label="landmarks")
    _legend(ax)
    _cm_axes(ax, "u (cm)", "v (cm)")


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


def _dots(ax: Axes, garment: FlatGarment, uv: Float) -> None:
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


def _draw_size(ax: Axes, letter: str, value_m: float, ends_uv: Any) -> None:
    start, end = CM * np.array(ends_uv)
    arrow = {"arrowstyle": "<->", "color": VERMILION, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", start, end, arrowprops=arrow, zorder=5)
    text = f"{letter} {CM * value_m:.1f} cm"
    ax.annotate(
        text, start + 0.38 * (end - start), color=VERMILION, fontsize=11, fontweight="bold",
        ha="center", va="center", path_effects=_halo(), zorder=6,
    )  # fmt: skip


def category_figure(garment: FlatGarment, templates: Sequence[Template]) -> Figure:
    """Fig. 8: the model images, the flattened outline on the best one, and the scores."""
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    ranked = sorted(garment.scores, key=lambda name: (-garment.scores[name], name))
    by_name = {template.category: template for template in templates}
    drawn = [name for name in ranked if name in by_name][:6]
    grid = figure.add_gridspec(2, 1, height_ratios=[1, 2.2])
    top = grid[0].subgridspec(1, max(len(drawn), 1))
    for k, name in enumerate(drawn):
        ax = figure.add_subplot(top[k])
        _draw_model(ax, by_name[name])
        ax.set_title(f"{_words(name)}\n{_score(garment)} = {garment.scores[name]:.2f}", fontsize=9)
    bottom = grid[1].subgridspec(1, 2, width_ratios=[1.3, 1])
    draw_match(figure.add_subplot(bottom[0]), garment, by_name.get(garment.category))
    draw_scores(figure.add_subplot(bottom[1]), garment)
    return figure


def _draw_model(ax: Axes, template: Template) -> None:
    image = model_image(template, RecognitionConfig().decay)
    ax.imshow(image, cmap="Blues", origin="lower", vmin=0, vmax=1)
    ax.set_xticks([])
    ax.set_yticks([])


def draw_match(ax: Axes, garment: FlatGarment, template: Template | None) -> None:
    """The flattened outline on the best category's model image, both as the model lies."""
    outline = np.concatenate([garment.outline.uv, garment.outline.uv[:1]])
    if template is None or len(garment.template_uv) != template.vertices:
        ax.plot(*(CM * outline.T), color=VERMILION, lw=2, label="flattened outline")
        _cm_axes(ax, "u (cm)", "v (cm)")
        ax.set_title("no category's outline fits" if template is None else _title(garment))
        return
    typical = template.outline(np.zeros(template.dimensions))
    move = _similarity(garment.template_uv, typical)
    fitted = move(np.concatenate([garment.template_uv, garment.template_uv[:1]]))
    image = model_image(template, RecognitionConfig().decay)
    middle, longest = _centre_and_length(typical)
    half = MARGIN * longest / 2
    extent = np.array([middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half])
    ax.imshow(image, cmap="Blues", origin="lower", extent=tuple(CM * extent), vmin=0, vmax=1)
    ax.plot(*(CM * fitted.T), color=INK, lw=1, ls="dotted", label="category's outline, fitted")
    ax.plot(*(CM * move(outline).T), color=VERMILION, lw=2, label="flattened outline")
    ax.legend(loc="lower right", fontsize=8, framealpha=0.9)
    ax.set_title(f"on the model image of {_words(garment.category)}")
    ax.set_xlabel("cm, scaled to the model")
    ax.set_aspect("equal")


def draw_scores(ax: Axes, garment: FlatGarment) -> None:
    """Scores of all categories, best on top."""
    ranked = sorted(garment.scores, key=lambda name: (garment.scores[name], name))
    values = [garment.scores[name] for name in ranked]
    colours = [BLUE if name == garment.category else "#C8C8C8" for name in ranked]
    bars = ax.barh([_words(name) for name in ranked], values, color=colours)
    ax.bar_label(bars, fmt="%.2f", padding=3)
    ax.set_xlim(0, max([*values, 0.1]) * 1.18)
    ax.set_xlabel("matching score R" if garment.score_kind == "R" else "probability")
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_title(f"category: {_words(garment.category)}")


def summary_figure(garment: FlatGarment, views: Sequence[View]) -> Figure:
    """Views of the hanging item, then what it would look like laid flat."""
    figure = Figure(figsize=(12.0, 5.2), layout="constrained")
    shown = shown_views(garment, views)[:3]
    grid = figure.add_gridspec(1, len(shown) + 1, width_ratios=[1.0] * len(shown) + [2.2])
    for k, view in enumerate(shown):
        ax = figure.add_subplot(grid[k])
        x, y, _ = CM * view.points_view.T
        ax.scatter(x, y, s=2.0, c=_shade(view), marker="s", linewidths=0, rasterized=True)
        ax.set_title(f"seen at {np.degrees(view.angle_rad):.0f}°")
        _cm_axes(ax, "cm", "cm" if k == 0 else "")
    flat = figure.add_subplot(grid[-1])
    if len(garment.view_ids) <= len(VIEW_COLOURS):
        draw_cloth(flat, garment, views)
    else:  # the colours of front and back would mix
        draw_flat(flat, garment)
    flat.set_title(_title(garment), fontsize=11)
    return figure


def draw_cloth(ax: Axes, garment: FlatGarment, views: Sequence[View]) -> None:
    """The flattened item in the colours of its cloth, with outline, W and L."""
    places, colours = [np.empty((0, 2))], [np.empty((0, 3))]
    for view in views:
        own = garment.points.view_id == view.view_id
        index, known = _rows(view, garment.points.pixel[own])
        places.append(garment.points.uv[own][known])
        colours.append(_shade(view)[index])
    colour = np.concatenate(colours)
    bright = np.argsort(colour.sum(axis=1), kind="stable")  # what faces its camera goes on top
    u, v = CM * np.concatenate(places)[bright].T
    size = float(np.clip(4e4 / max(len(u), 1), 4.0, 20.0))
    ax.scatter(u, v, s=size, c=colour[bright], marker="s", lw=0, rasterized=True)
    draw_outline(ax, garment)
    draw_sizes(ax, garment)
    _cm_axes(ax, "u (cm)", "v (cm)")


def _row(figure: Figure, count: int) -> list[Axes]:
    axes = figure.subplots(1, max(count, 1), squeeze=False)
    return list(axes[0][:count])


def _cm_axes(ax: Axes, x: str, y: str) -> None:
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.grid(color="#E6E6E6", lw=0.6)
    ax.set_axisbelow(True)


def _legend(ax: Axes) -> None:
    handles, names = ax.get_legend_handles_labels()
    if names:
        ax.legend(handles, names, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _halo() -> list[Any]:
    return [withStroke(linewidth=3, foreground="white")]


def _title(garment: FlatGarment) -> str:
    parts = [_words(garment.category)]
    for letter, name in (("W", "width"), ("L", "length")):
        size = garment.measurement(name)
        if size is not None:
            mark = ", inferred" if size.inferred else ""
            parts.append(f"{letter} {CM * size.value_m:.1f} ± {CM * size.sigma_m:.1f} cm{mark}")
    return "   ".join(parts)


def _words(name: str) -> str:
    return name.replace("_", " ")


def _score(garment: FlatGarment) -> str:
    return "R" if garment.score_kind == "R" else "p"


def _shade(view: View) -> Any:
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


def _hanging(nodes_hanger: Float, view: View | None) -> Float:
    """Hanger frame to the view frame as a view sees the item, or at item angle 0."""
    if view is None:
        return nodes_hanger @ R_VIEW_HANGER0.T
    calibration = view.calibration
    return transform_points(
        calibration.T_view_rig @ calibration.T_rig_hanger(view.angle_rad), nodes_hanger
    )


def _similarity(a: Float, b: Float) -> Any:
    """The scaled motion, mirror images allowed, that takes rows of a nearest to rows of b."""
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    left, strength, right = np.linalg.svd((a - mean_a).T @ (b - mean_b))
    scale = strength.sum() / max(float(np.square(a - mean_a).sum()), 1e-12)

    def move(points: Float) -> Float:
        moved: Float = scale * (points - mean_a) @ left @ right + mean_b
        return moved

    return move


def _centre_and_length(outline: Float) -> tuple[Float, float]:
    """Centroid of the enclosed area and longest length, as model images are scaled."""
    after = np.roll(outline, -1, axis=0)
    cross = outline[:, 0] * after[:, 1] - outline[:, 1] * after[:, 0]
    middle = ((outline + after) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum())
    longest = np.linalg.norm(outline[:, None] - outline[None], axis=-1).max()
    return middle, float(longest)
