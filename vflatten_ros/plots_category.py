"""The parts of figures that show how the category was found."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes

from vflatten_ros.core.config import RecognitionConfig
from vflatten_ros.core.model_images import MARGIN, model_image
from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import FlatGarment, Float
from vflatten_ros.plots import BLUE, CM, INK, VERMILION, cm_axes, title, words


def draw_model(ax: Axes, template: Template) -> None:
    image = model_image(template, RecognitionConfig().decay)
    ax.imshow(image, cmap="Blues", origin="lower", vmin=0, vmax=1)
    ax.set_xticks([])
    ax.set_yticks([])


def draw_match(ax: Axes, garment: FlatGarment, template: Template | None) -> None:
    """The flattened outline on the best category's model image, both as the model lies."""
    outline = np.concatenate([garment.outline.uv, garment.outline.uv[:1]])
    if template is None or len(garment.template_uv) != template.vertices:
        ax.plot(*(CM * outline.T), color=VERMILION, lw=2, label="flattened outline")
        cm_axes(ax, "u (cm)", "v (cm)")
        ax.set_title("no category's outline fits" if template is None else title(garment))
        return
    typical = template.outline(np.zeros(template.dimensions))
    move = similarity(garment.template_uv, typical)
    fitted = move(np.concatenate([garment.template_uv, garment.template_uv[:1]]))
    image = model_image(template, RecognitionConfig().decay)
    middle, longest = _centre_and_length(typical)
    half = MARGIN * longest / 2
    extent = np.array([middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half])
    ax.imshow(image, cmap="Blues", origin="lower", extent=tuple(CM * extent), vmin=0, vmax=1)
    ax.plot(*(CM * fitted.T), color=INK, lw=1, ls="dotted", label="category's outline, fitted")
    ax.plot(*(CM * move(outline).T), color=VERMILION, lw=2, label="flattened outline")
    ax.legend(loc="lower right", fontsize=8, framealpha=0.9)
    ax.set_title(f"on the model image of {words(garment.category)}")
    ax.set_xlabel("cm, scaled to the model")
    ax.set_aspect("equal")


def draw_scores(ax: Axes, garment: FlatGarment) -> None:
    """Scores of all categories, best on top."""
    ranked = sorted(garment.scores, key=lambda name: (garment.scores[name], name))
    values = [garment.scores[name] for name in ranked]
    colours = [BLUE if name == garment.category else "#C8C8C8" for name in ranked]
    bars = ax.barh([words(name) for name in ranked], values, color=colours)
    ax.bar_label(bars, fmt="%.2f", padding=3)
    ax.set_xlim(0, max([*values, 0.1]) * 1.18)
    ax.set_xlabel("matching score R" if garment.score_kind == "R" else "probability")
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_title(f"category: {words(garment.category)}")


def similarity(a: Float, b: Float) -> Callable[[Float], Float]:
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
