"""The one place that knows the order of the stages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vflatten_ros.core.assembly import place_pieces
import numpy as np

from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import NotEnoughViews
from vflatten_ros.core.measurement import measure
from vflatten_ros.core.recognition import Recognition, recognise
from vflatten_ros.core.rotation import unfold_views
from vflatten_ros.core.templates import Template
from vflatten_ros.core.two_views import flatten_two_views
from vflatten_ros.core.values import (
    Correspondence,
    FlatGarment,
    Flattened,
    GeodesicLines,
    Progress,
    View,
    no_progress,
)

HALF_PIXEL_M = 0.00125  # how far cloth reaches beyond its outermost pixels' centres


def flatten_garment(
    views: Sequence[View],
    correspondences: Sequence[Correspondence],
    templates: Sequence[Template],
    config: Config,
    progress: Progress = no_progress,
) -> FlatGarment:
    """Lay a hanging item flat: its outline, category, sizes and named places.

    Parameters
    ----------
    views : sequence of View
        Views of one item that hangs still; config.method says how many are needed.
    correspondences : sequence of Correspondence
        Points of the cloth seen in two views; 'kita2019' needs two or more, 'rotation' none.
    templates : sequence of Template
        Categories to choose from.
    config : Config
    progress : Progress

    Raises
    ------
    VFlattenError
        Says what came, what was expected, what to try.
    """
    if not views:
        raise NotEnoughViews("no views to flatten")
    method = {"kita2019": _kita2019, "rotation": _rotation}[config.method]
    flattened = method(views, correspondences, config, progress)
    return _described(flattened, views, templates, config, progress)


def _kita2019(
    views: Sequence[View],
    correspondences: Sequence[Correspondence],
    config: Config,
    progress: Progress,
) -> Flattened:
    """The paper's method: two views, a few corresponding points."""
    return flatten_two_views(views, correspondences, config, progress)


def _rotation(
    views: Sequence[View],
    correspondences: Sequence[Correspondence],
    config: Config,
    progress: Progress,
) -> Flattened:
    """The automatic method: all views of a rotation."""
    unfolded = unfold_views(views, correspondences, config.rotation, progress)
    none = np.zeros(0)
    return Flattened(
        points=unfolded.points,
        start_uv=None,
        lines=GeodesicLines(np.zeros((0, 2, 3)), none.astype(np.int64), none, none, none > 0),
        outline=unfolded.outline,
        correspondences=(),
        notices=unfolded.notices,
    )


def _described(
    flattened: Flattened,
    views: Sequence[View],
    templates: Sequence[Template],
    config: Config,
    progress: Progress,
) -> FlatGarment:
    """Category, sizes and places of a flattened item."""
    progress("recognition", 0.0)
    flattened, recognition = _recognised(flattened, tuple(templates), config, progress)
    points, outline = flattened.points, flattened.outline
    progress("measurement", 0.0)
    measured = measure(recognition, outline, points, config.measurement)
    automatic = config.method == "rotation"
    used = sorted({int(i) for i in points.view_id if i >= 0})
    return FlatGarment(
        method=config.method,
        view_ids=tuple(used),
        stamp_ns=max(v.stamp_ns for v in views if v.view_id in used),
        points=points,
        start_uv=flattened.start_uv,
        lines=flattened.lines,
        outline=outline,
        category=recognition.category,
        scores=recognition.probabilities if automatic else recognition.scores,
        score_kind="probability" if automatic else "R",
        template_uv=recognition.template_uv,
        measurements=measured.measurements,
        landmarks=measured.landmarks,
        correspondences=flattened.correspondences,
        coverage=measured.coverage,
        quality=measured.quality,
        notices=flattened.notices + measured.notices,
    )


def _recognised(
    flattened: Flattened, templates: tuple[Template, ...], config: Config, progress: Progress
) -> tuple[Flattened, Recognition]:
    """Category of the item; loose pieces are placed as the likeliest categories have them."""
    found = recognise(flattened.outline, flattened.points, templates, config.recognition)
    if len(flattened.pieces) < 2 or not config.assembly.categories:
        return flattened, found
    placed = []
    for template in templates:
        fit = found.fits[template.category]
        outline = fit.points()[: template.vertices]
        whole, cost = place_pieces(flattened, outline, HALF_PIXEL_M, config.assembly, config.contour)
        chance = np.log(max(found.probabilities[template.category], 1e-6)) - cost
        placed.append((chance, cost, template.category, whole))
    placed.sort(key=lambda p: -p[0])
    best: tuple[float, Flattened, Recognition] | None = None
    for done, (_, cost, category, whole) in enumerate(placed[: config.assembly.categories]):
        progress("recognition", (done + 1) / (config.assembly.categories + 1))
        again = recognise(whole.outline, whole.points, templates, config.recognition)
        chance = np.log(max(again.probabilities[category], 1e-6)) - cost
        if best is None or chance > best[0]:
            best = (chance, whole, again)
    assert best is not None
    return best[1], best[2]
