"""Pictures of a result in the manner of Kita & Kita 2019, Figs. 3, 4, 6 and 8, and a summary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import Calibration, FlatGarment, View
from vflatten_ros.plots import (
    CM,
    VIEW_COLOURS,
    cm_axes,
    draw_cloth,
    draw_dots,
    draw_flat,
    draw_slice,
    draw_stress,
    draw_view,
    legend,
    shade,
    title,
    words,
)
from vflatten_ros.plots_3d import draw_hanging, draw_lines, hanging
from vflatten_ros.plots_category import draw_match, draw_model, draw_scores

VIEWS_SHOWN = 4
DPI = 120


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


def draw_axis(given: Calibration, views: Sequence[View], path: Path) -> None:
    """Write a picture of all views' cloth at one height, by two calibrations, from above.

    Parameters
    ----------
    given : Calibration
        The one that was given.
    views : sequence of View
        With the one that was found.
    path : Path
    """
    reverse = given.joint_sign * views[0].calibration.joint_sign
    before = [
        replace(view, calibration=given, angle_rad=reverse * view.angle_rad) for view in views
    ]
    figure = Figure(figsize=(11.0, 5.6), layout="constrained")
    for ax, name, shown in zip(_row(figure, 2), ("given", "found"), (before, views), strict=True):
        draw_slice(ax, shown)
        ax.set_title(f"the axis as {name}")
    figure.suptitle("Cloth of all views at one height, from above; a colour for each view")
    figure.savefig(path, dpi=DPI, metadata={"Software": None})


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
        ax.set_title(f"view {view.view_id}, item at {round(float(np.degrees(view.angle_rad)))}°")
    figure.suptitle("Points used (dots) and corresponding points (letters)")
    return figure


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
            cloud = hanging(garment.points.xyz_hanger, None)
            chosen = np.arange(len(lines.view_id))
        else:
            cloud = view.points_view
            chosen = np.flatnonzero(lines.view_id == view.view_id)
        draw_lines(ax, garment, view, cloud, chosen)
        name = "all views" if view is None else f"view {view.view_id}"
        total, flagged = len(chosen), int(lines.flagged[chosen].sum())
        ax.set_title(f"{name}: some of {total} geodesic lines\n({flagged} flagged, orange)")
    if not panels:
        draw_hanging(figure, garment)
    return figure


def flattening_figure(garment: FlatGarment) -> Figure:
    """Fig. 6: where the flattening started, and the flattened item with W and L."""
    figure = Figure(figsize=(11.0, 6.2), layout="constrained")
    left, right = _row(figure, 2)
    if garment.start_uv is not None and len(garment.start_uv):
        draw_dots(left, garment, garment.start_uv)
        left.set_title("start (u₀, v₀)")
        legend(left)
    else:
        draw_stress(left, garment)
    cm_axes(left, "u (cm)", "v (cm)")
    draw_flat(right, garment)
    right.set_title(title(garment))
    return figure


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
        draw_model(ax, by_name[name])
        ax.set_title(f"{words(name)}\n{_score(garment)} = {garment.scores[name]:.2f}", fontsize=9)
    bottom = grid[1].subgridspec(1, 2, width_ratios=[1.3, 1])
    draw_match(figure.add_subplot(bottom[0]), garment, by_name.get(garment.category))
    draw_scores(figure.add_subplot(bottom[1]), garment)
    return figure


def _score(garment: FlatGarment) -> str:
    return "R" if garment.score_kind == "R" else "p"


def summary_figure(garment: FlatGarment, views: Sequence[View]) -> Figure:
    """Views of the hanging item, then what it would look like laid flat."""
    figure = Figure(figsize=(12.0, 5.2), layout="constrained")
    shown = shown_views(garment, views)[:3]
    grid = figure.add_gridspec(1, len(shown) + 1, width_ratios=[1.0] * len(shown) + [2.2])
    for k, view in enumerate(shown):
        ax = figure.add_subplot(grid[k])
        x, y, _ = CM * view.points_view.T
        ax.scatter(x, y, s=2.0, c=shade(view), marker="s", linewidths=0, rasterized=True)
        ax.set_title(f"seen at {round(float(np.degrees(view.angle_rad)))}°")
        cm_axes(ax, "cm", "cm" if k == 0 else "")
    flat = figure.add_subplot(grid[-1])
    if len(garment.view_ids) <= len(VIEW_COLOURS):
        draw_cloth(flat, garment, views)
    else:  # the colours of front and back would mix
        draw_flat(flat, garment)
    flat.set_title(title(garment), fontsize=11)
    return figure


def _row(figure: Figure, count: int) -> list[Axes]:
    axes = figure.subplots(1, max(count, 1), squeeze=False)
    return list(axes[0][:count])
