"""The one place that knows the order of the stages."""

from __future__ import annotations

from collections.abc import Sequence

from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import NotEnoughViews
from vflatten_ros.core.measurement import measure
from vflatten_ros.core.recognition import recognise
from vflatten_ros.core.templates import Template
from vflatten_ros.core.two_views import flatten_two_views
from vflatten_ros.core.values import (
    Correspondence,
    FlatGarment,
    Flattened,
    Progress,
    View,
    no_progress,
)


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
    raise NotImplementedError("method 'rotation'")


def _described(
    flattened: Flattened,
    views: Sequence[View],
    templates: Sequence[Template],
    config: Config,
    progress: Progress,
) -> FlatGarment:
    """Category, sizes and places of a flattened item."""
    points, outline = flattened.points, flattened.outline
    progress("recognition", 0.0)
    recognition = recognise(outline, points, tuple(templates), config.recognition)
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
