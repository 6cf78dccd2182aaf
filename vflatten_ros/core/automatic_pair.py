"""The paper's method without a person: the views and the points are chosen here.

Like the pipeline, this module knows the order of its stages, which do not know each other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import cv2
import numpy as np

from vflatten_ros.core.config import Config
from vflatten_ros.core.correspondences import (
    Matches,
    PlacedView,
    as_pairs,
    common_cloth,
    place_views,
    spread,
)
from vflatten_ros.core.errors import DisconnectedSurface, NotEnoughViews, VFlattenError
from vflatten_ros.core.observation import Observation
from vflatten_ros.core.prints import common_features
from vflatten_ros.core.recognition import Recognition
from vflatten_ros.core.registration import ViewSurface, view_surface
from vflatten_ros.core.turntable import angle_between
from vflatten_ros.core.two_views import flatten_pair, observed
from vflatten_ros.core.values import Correspondence, Flattened, Notice, Progress, View
from vflatten_ros.core.view_choice import PairValue, pair_values

OFFERED = 5  # times as many points as are used: those beside smooth patches fall away
OTHERWISE_RAD = np.radians(20.0)  # a pair is worth trying if one of its views is so far from others
CERTAIN = 0.6  # quality times share of the side at which no further pair is tried

Judge = Callable[[Flattened], tuple[Flattened, Recognition, float]]
"""The item with its loose pieces placed, what it is, and the quality (0-1) of that."""


@dataclass(frozen=True, eq=False)
class Tried:
    """One pair of views, flattened."""

    pair: PairValue
    flattened: Flattened
    recognition: Recognition
    value: float


def placed_views(
    views: Sequence[View],
    config: Config,
    progress: Progress,
    prepared: Mapping[int, ViewSurface],
) -> list[PlacedView]:
    """The views in one frame; those with hardly any points are left out."""
    kept, surfaces, prints = [], [], config.correspondences.features
    for k, view in enumerate(views):
        progress("surface", k / len(views))
        with suppress(NotEnoughViews):
            surface = prepared.get(view.view_id)
            surfaces.append(surface or view_surface(view, config.rotation, prints))
            kept.append(view)
    progress("register", 0.0)
    return place_views(kept, surfaces, config.rotation, progress)


def corresponding(a: PlacedView, b: PlacedView, config: Config) -> tuple[Correspondence, ...]:
    """Points that both views show, the surest first and well spread; more than are needed."""
    settings = config.correspondences
    found = common_cloth(a, b, settings)
    if settings.features:
        seen = common_features(a, b, settings)
        found = Matches(
            np.r_[found.a, seen.a], np.r_[found.b, seen.b], np.r_[found.confidence, seen.confidence]
        )
    chosen = spread(a.points[found.a], found.confidence, OFFERED * settings.count)
    return as_pairs(a, b, found.part(chosen))


def flatten_best_pair(
    views: Sequence[View],
    config: Config,
    judge: Judge,
    progress: Progress,
    prepared: Mapping[int, ViewSurface],
) -> Tried:
    """Try the most promising pairs of views; the one that shows most of an item, and best, wins.

    Parameters
    ----------
    views : sequence of View
        Two or more.
    config : Config
    judge : callable
    progress : Progress
    prepared : mapping of int to ViewSurface
        Results of view_surface by view_id.

    Raises
    ------
    NotEnoughViews
        Fewer than two views with enough points.
    DisconnectedSurface
        No two views have enough cloth in common.
    """
    placed = {p.view.view_id: p for p in placed_views(views, config, progress, prepared)}
    if len(placed) < 2:
        raise NotEnoughViews(f"the two-view method needs two views, got {len(placed)} with points")
    progress("choose", 0.0)
    ranked = _apart(pair_values(list(placed.values()), config), placed)[: config.views.pairs]
    seen: dict[int, Observation] = {}
    tried: list[Tried] = []
    failures: list[VFlattenError] = []
    for number, pair in enumerate(ranked):
        ids = pair.view_a, pair.view_b
        progress("surface", number / len(ranked))
        new = [i for i in ids if i not in seen]
        seen |= zip(new, observed([placed[i].view for i in new], config, progress), strict=True)
        found = corresponding(placed[ids[0]], placed[ids[1]], config)
        try:
            flattened = flatten_pair(seen[ids[0]], seen[ids[1]], (), found, config, progress)
            progress("recognition", 0.0)
            flattened, recognition, quality = judge(flattened)
        except VFlattenError as error:
            failures.append(error)
            continue
        share = _area_m2(flattened) / pair.half_m2
        tried.append(Tried(pair, flattened, recognition, quality * share))
        if quality * min(share, 1.0) > CERTAIN:
            break
    if not tried:
        raise _none_joined(failures)
    best = max(tried, key=lambda one: one.value)
    note = _chosen(best, placed, len(tried) + len(failures))
    flattened = replace(best.flattened, notices=(note, *best.flattened.notices))
    return replace(best, flattened=flattened)


def fill_up(
    named: tuple[View, View], config: Config, progress: Progress
) -> tuple[Correspondence, ...]:
    """Points beside those that a person gave for two views; none if these show too little."""
    placed = placed_views(named, config, progress, {})
    return corresponding(placed[0], placed[1], config) if len(placed) == len(named) else ()


def _apart(pairs: Sequence[PairValue], placed: Mapping[int, PlacedView]) -> list[PairValue]:
    """Without pairs that show the same as a better one."""
    angle = {i: view.view.angle_rad for i, view in placed.items()}

    def alike(one: PairValue, other: PairValue) -> bool:
        return any(
            angle_between(angle[one.view_a], angle[p]) < OTHERWISE_RAD
            and angle_between(angle[one.view_b], angle[q]) < OTHERWISE_RAD
            for p, q in ((other.view_a, other.view_b), (other.view_b, other.view_a))
        )

    kept: list[PairValue] = []
    for pair in pairs:
        if pair.value > 0.0 and not any(alike(pair, better) for better in kept):
            kept.append(pair)
    return kept


def _area_m2(flattened: Flattened) -> float:
    return float(cv2.contourArea(flattened.outline.uv.astype(np.float32)))


def _none_joined(failures: Sequence[VFlattenError]) -> VFlattenError:
    if failures:
        return failures[0]
    return DisconnectedSurface(
        "no two views have enough cloth in common: take more views, or give corresponding points"
    )


def _chosen(best: Tried, placed: Mapping[int, PlacedView], tried: int) -> Notice:
    pair = best.pair
    between = angle_between(placed[pair.view_a].view.angle_rad, placed[pair.view_b].view.angle_rad)
    points = len(best.flattened.correspondences)
    pairs = "pair" if tried == 1 else "pairs"
    text = (
        f"views {pair.view_a} and {pair.view_b}, {np.degrees(between):.0f} degrees apart, by "
        f"{points} corresponding points found; {tried} {pairs} of views tried"
    )
    return Notice("views_chosen", text)
