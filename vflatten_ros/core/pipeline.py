"""The one place that knows the order of the stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from vflatten_ros.core.assembly import assemble
from vflatten_ros.core.automatic_pair import fill_up, flatten_best_pair
from vflatten_ros.core.category_outline import MOST_DEEP_M, deep_inside_m, with_category
from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import NotEnoughViews
from vflatten_ros.core.fused import fuse_views
from vflatten_ros.core.grain import suited, too_noisy
from vflatten_ros.core.held_end import held_end_below
from vflatten_ros.core.hypotheses import Helper, likeliest
from vflatten_ros.core.image_border import cut_off
from vflatten_ros.core.measurement import measure
from vflatten_ros.core.model_images import model_image_scores
from vflatten_ros.core.one_view import flatten_one_view
from vflatten_ros.core.recognition import (
    FREEDOM,
    UNKNOWN,
    Recognition,
    finish,
    recognise,
    recognise_again,
)
from vflatten_ros.core.registration import Folded, ViewSurface, view_surface
from vflatten_ros.core.rotation import turn_parts
from vflatten_ros.core.template_fit import place
from vflatten_ros.core.templates import Template
from vflatten_ros.core.two_views import flatten_two_views, named_views
from vflatten_ros.core.unseen import advice, coverage, enough, notice_of
from vflatten_ros.core.upright import upright
from vflatten_ros.core.values import (
    Correspondence,
    FlatGarment,
    Flattened,
    GeodesicLines,
    Notice,
    Outline,
    Progress,
    View,
    no_progress,
)

MOST_JUDGED = 3  # corresponding points given, up to which others are found to judge them
TURNS = 2  # of loose parts: the fit of the template is better once they lie nearly right
# Spread of a part's usual angle beyond which its cloth tells more: sleeves are cut at any angle,
# and hang on the body along all of their width, if it is one piece; what legs hang on is narrow
CLOTH_TELLS_RAD = np.radians(6.0)
AT_REST_M = 0.002  # by which an outline's vertices may be off with its parts at rest


def prepare_view(view: View, config: Config) -> ViewSurface:
    """What flattening needs of a view whatever the others are: do it as the view arrives.

    'kita2019' needs it only where no corresponding points are given.

    Raises
    ------
    VFlattenError
        As flatten_garment would of this view.
    """
    return view_surface(view, config.rotation, config.correspondences.features)


def flatten_garment(
    views: Sequence[View],
    correspondences: Sequence[Correspondence],
    templates: Sequence[Template],
    config: Config,
    progress: Progress = no_progress,
    prepared: Mapping[int, ViewSurface] | None = None,
    so_far: Folded | None = None,
    helper: Helper | None = None,
) -> FlatGarment:
    """Lay a hanging item flat: its outline, category, sizes and named places.

    Parameters
    ----------
    views : sequence of View
        Views of one item that hangs still; config.method says how many are needed.
    correspondences : sequence of Correspondence
        Points of the cloth seen in two views, as a person gives them. 'kita2019' uses the views
        that they name; without any it chooses two views, and finds points, by itself. 'rotation'
        needs none, and joins its surface by those that agree with the registration.
    templates : sequence of Template
        Categories to choose from.
    config : Config
    progress : Progress
    prepared : mapping of int to ViewSurface, optional
        Results of prepare_view by view_id, with the same config.
    so_far : Folded, optional
        Result of fold_in for them, made as the views arrived. 'kita2019' does not use it.
    helper : Helper, optional
        Another process that shares the work of 'rotation'; the result is the same without.

    Raises
    ------
    VFlattenError
        Says what came, what was expected, what to try.
    """
    if not views:
        raise NotEnoughViews("no views to flatten")
    done = prepared or {}
    if config.method == "rotation":
        views = sorted(views, key=lambda view: view.view_id)  # as they came, however they are named
        flattened, settled = _rotation(
            views, correspondences, templates, config, progress, done, so_far, helper
        )
    else:
        flattened, settled = _kita2019(views, correspondences, templates, config, progress, done)
    return _described(flattened, settled, views, templates, config, progress)


def _kita2019(
    views: Sequence[View],
    correspondences: Sequence[Correspondence],
    templates: Sequence[Template],
    config: Config,
    progress: Progress,
    prepared: Mapping[int, ViewSurface],
) -> tuple[Flattened, Recognition | None]:
    """The paper's method: two views and a few corresponding points, or one view alone."""
    if len(views) == 1:
        return flatten_one_view(views[0], config, progress), None

    def judge(flattened: Flattened) -> tuple[Flattened, Recognition, float]:
        placed, found = _recognised(flattened, tuple(templates), config, progress)
        measured = measure(found, placed.outline, placed.points, config.measurement)
        return placed, found, measured.quality

    if correspondences:
        named = named_views(views, correspondences)
        # the more are given, the better they judge one another
        more = () if len(correspondences) > MOST_JUDGED else fill_up(named, config, progress)
        return flatten_two_views(named, correspondences, config, progress, more), None
    best = flatten_best_pair(views, config, judge, progress, prepared)
    return best.flattened, best.recognition


def _rotation(
    views: Sequence[View],
    correspondences: Sequence[Correspondence],
    templates: Sequence[Template],
    config: Config,
    progress: Progress,
    prepared: Mapping[int, ViewSurface],
    so_far: Folded | None,
    helper: Helper | None,
) -> tuple[Flattened, Recognition | None]:
    """The automatic method: all views of a rotation."""
    fused = fuse_views(
        views,
        config.rotation,
        progress,
        prepared,
        correspondences,
        config.integration,
        config.correspondences,
        so_far,
    )
    noisy = too_noisy(config.rotation, fused.grain)
    config = replace(config, rotation=suited(config.rotation, fused.grain))
    given, told = fused.given, fused.notices + fused.given.notices
    best = likeliest(fused, tuple(templates), config, progress, helper)
    config = replace(config, rotation=best.rotation)
    calibration = fused.calibration or views[0].calibration
    used = set(fused.view_ids.tolist())
    about_axis = [replace(view, calibration=calibration) for view in views if view.view_id in used]
    del fused  # its points are many
    unfolded, found = best.unfolded, best.found
    # one cloth has no loose parts, and no slit that may come out
    turn, turns = 0, 0 if found.category == UNKNOWN or found.one_cloth else TURNS
    while turn < turns:
        progress("parts", turn / turns)
        fit = found.fits[found.category]
        rest = place(fit.template, fit.pose, fit.template.at_rest(fit.state))[0]
        k = fit.template.vertices
        swung = fit.points()[:k]
        by_cloth = len(unfolded.parts) == 1 and bool((fit.template.spread > CLOTH_TELLS_RAD).any())
        if turn and np.abs(swung - rest[:k]).max() < AT_REST_M:
            break
        unfolded = turn_parts(unfolded, swung, rest[:k], config.rotation, by_cloth)
        progress("parts", (turn + 0.6) / turns)
        found = recognise_again(
            found, unfolded.outline, unfolded.points, tuple(templates), config.recognition
        )
        turn += 1
        if not fit.template.parts and found.fits[found.category].template.parts:
            turns = TURNS + 1  # these were not turned yet
    best = best.weighed_again(found)
    none = np.zeros(0)
    notices = told + unfolded.notices
    if unfolded.points.astray_m is not None:
        astray = float((unfolded.points.astray_m > 0.0).mean())
        text = f"a part, {100 * astray:.0f} % of what was seen, fits as well turned over"
        notices = (*notices, Notice("turned_over", text))
    reason = _odd(unfolded.outline, found) or best.untrusted or noisy
    if reason:
        notices = (*notices, Notice("untrusted", reason))
    placed_m = config.assembly.sigma_m if len(unfolded.parts) > 1 else 0.0
    flattened = Flattened(
        points=unfolded.points,
        start_uv=None,
        lines=GeodesicLines(np.zeros((0, 2, 3)), none.astype(np.int64), none, none, none > 0),
        outline=unfolded.outline,
        correspondences=given.used,
        notices=notices,
        seen=coverage(unfolded.surface, about_axis),
        calibration=calibration,
        outline_sigma_m=float(
            np.linalg.norm([config.rotation.outline_sigma_m, placed_m, best.apart_sigma_m])
        ),
        size_sigma=best.size_sigma,
    )
    return flattened, found


def _odd(outline: Outline, found: Recognition) -> str:
    """Why the category does not explain what was seen of the outline; empty: it does."""
    if found.category == UNKNOWN:
        return ""
    deep = deep_inside_m(outline, found.fits[found.category])
    if deep <= MOST_DEEP_M:
        return ""
    return f"{100 * deep:.0f} cm of its outline lie far inside that of its category"


def _described(
    flattened: Flattened,
    settled: Recognition | None,
    views: Sequence[View],
    templates: Sequence[Template],
    config: Config,
    progress: Progress,
) -> FlatGarment:
    """Category, sizes and places of a flattened item."""
    if settled is not None:
        recognition = settled
    else:
        progress("recognition", 0.0)
        flattened, recognition = _recognised(flattened, tuple(templates), config, progress)
    points, outline = flattened.points, flattened.outline
    recognition = held_end_below(recognition, points)
    progress("measurement", 0.0)
    measured = measure(recognition, outline, points, config.measurement)
    automatic = config.method == "rotation"
    used = sorted({int(i) for i in points.view_id if i >= 0})
    shared = np.sqrt(2.0) * flattened.outline_sigma_m  # of two ends
    measurements = tuple(
        replace(
            m, sigma_m=float(np.linalg.norm([m.sigma_m, shared, flattened.size_sigma * m.value_m]))
        )
        for m in measured.measurements
    )
    if automatic and recognition.fit is not None and recognition.category != UNKNOWN:
        outline = with_category(outline, recognition.fit, config.recognition.misfit_m)
    shown = [view for view in views if view.view_id in used]
    notices = flattened.notices
    for more in (cut_off(shown), measured.notices):
        told = {notice.code for notice in notices}
        notices += tuple(notice for notice in more if notice.code not in told)
    garment = FlatGarment(
        method=config.method,
        view_ids=tuple(used),
        stamp_ns=max(view.stamp_ns for view in shown),
        points=points,
        start_uv=flattened.start_uv,
        lines=flattened.lines,
        outline=outline,
        category=recognition.category,
        scores=recognition.probabilities if automatic else recognition.scores,
        score_kind="probability" if automatic else "R",
        template_uv=recognition.template_uv,
        measurements=measurements,
        landmarks=measured.landmarks,
        correspondences=flattened.correspondences,
        coverage=measured.coverage,
        quality=measured.quality,
        calibration=flattened.calibration or views[0].calibration,
        notices=notices,
    )
    if recognition.fit is not None and recognition.category != UNKNOWN:
        garment = upright(garment, recognition.fit.pose)
    if flattened.seen is None:
        return garment
    unseen = advice(garment, flattened.seen, config.measurement.low_coverage)
    if unseen is not None:
        beyond = "truncated" in {notice.code for notice in notices}
        notices = (*notices, notice_of(unseen, beyond))
    garment = replace(
        garment,
        notices=notices,
        shares=flattened.seen.shares,
        unseen=unseen,
    )
    return replace(garment, enough=enough(garment, config.views))


def _recognised(
    flattened: Flattened, templates: tuple[Template, ...], config: Config, progress: Progress
) -> tuple[Flattened, Recognition]:
    """Category of the item; loose pieces are placed as the likeliest categories have them."""
    if not flattened.pieces or not config.assembly.alternations:
        return flattened, recognise(
            flattened.outline, flattened.points, templates, config.recognition
        )
    tried = assemble(flattened, templates, config, progress)
    best = tried[0]
    fit = finish(best.template, best.evidence, best.pose[None], best.state[None])
    if best.placing is not None:
        fit = replace(fit, covariance=fit.covariance + best.placing)
    unknown = -FREEDOM - config.recognition.unknown_misfit * 2.0 * best.evidence.total
    odds = {t.template.category: np.exp(t.chance - best.chance) for t in tried}
    odds[UNKNOWN] = np.exp(unknown - best.chance)
    everything = sum(odds.values())
    names = [*(t.category for t in templates), UNKNOWN]
    known = odds[UNKNOWN] < 1.0
    count = best.template.vertices if known else 0
    return best.flattened, Recognition(
        category=best.template.category if known else UNKNOWN,
        scores=model_image_scores(
            best.flattened.outline.uv,
            templates,
            config.recognition.decay,
            config.recognition.model_rotations,
        ),
        probabilities={name: float(odds.get(name, 0.0) / everything) for name in names},
        fit=fit,
        template_uv=fit.points()[:count],
        template_seen=fit.vertex_seen()[:count],
        fits={best.template.category: fit},
    )
