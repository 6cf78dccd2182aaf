"""What each view adds, where cloth goes on unseen, what angle would show it, and when to stop.

Cloth goes on unseen where no camera that sees the end of a sheet looks past it, and where it
turns away from all cameras that saw it. Under a sheet one looks from the side that lies open;
round a bend one looks from beyond it. Where a view was taken from there already, turning shows no
more.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vflatten_ros.core.config import ViewsConfig
from vflatten_ros.core.geometry import inverse
from vflatten_ros.core.recognition import UNKNOWN
from vflatten_ros.core.rotation import Surface
from vflatten_ros.core.sheets import outward
from vflatten_ros.core.turntable import TURN
from vflatten_ros.core.values import (
    Bool,
    Coverage,
    FlatGarment,
    Float,
    Notice,
    Unseen,
    View,
    ViewShare,
)

GRAZING = 0.5  # cosine towards the camera that saw an end best, below which cloth turns away there
NEAR_RAD = np.radians(20.0)  # a view so near to an angle shows what there is to be seen from it
LEAST_SHARE = 0.02  # of the edges, going on unseen, that is worth another view
MOST_INFERRED = 0.2  # of the outline, above which much is missing
STEPS = 72  # angles looked at


def coverage(surface: Surface, views: Sequence[View]) -> Coverage:
    """What each view shows of the surface, and from where more of it would be seen.

    Parameters
    ----------
    surface : Surface
    views : sequence of View
        In the order in which the surface was made of them.
    """
    angles = np.array([view.angle_rad for view in views])
    look = _directions(surface, views)
    best = np.mod(
        -np.arctan2(look[:, 1], look[:, 0]), TURN
    )  # the camera goes back as the item turns
    elsewhere = _apart(best, angles) > NEAR_RAD
    edges = max(int((surface.edge > 0).sum()), 1)
    return Coverage(
        shares=_shares(surface.samples.views, views),
        unseen_share=len(look) / edges,
        open_share=float(elsewhere.sum()) / edges,
        turn_to_rad=_best_angle(look[elsewhere], edges, angles),
    )


def _best_angle(look: Float, edges: int, angles: Float) -> float | None:
    """The item angle that promises most, None if views were taken near every angle.

    What lies round an end of what was seen, and, of cloth about which nothing is known, the
    share of directions that the camera would face from there and no view has faced.
    """
    tried = np.arange(STEPS) * (TURN / STEPS)
    away = _apart(tried, angles)
    if (away <= NEAR_RAD).all():
        return None
    camera = np.column_stack([np.cos(-tried), np.sin(-tried)])
    ends = ((look[:, :2] @ camera.T).clip(0.0) ** 2).sum(axis=0) / edges
    faced = np.cos(tried[:, None] - tried).clip(0.0) ** 2
    unknown = faced @ (1.0 - np.cos(np.minimum(away, np.pi / 2))) / faced.sum(axis=1)
    return float(tried[np.where(away > NEAR_RAD, unknown + ends, -1.0).argmax()])


def _shares(seen: Bool, views: Sequence[View]) -> tuple[ViewShare, ...]:
    order = np.argsort([view.view_id for view in views])
    before = np.cumsum(seen[:, order], axis=1)
    alone = seen.sum(axis=1) == 1
    shares = []
    for place, k in enumerate(order):
        mine = seen[:, k]
        shares.append(
            ViewShare(
                view_id=views[k].view_id,
                shows=float(mine.mean()),
                only=float((mine & alone).mean()),
                first=float((mine & (before[:, place] == 1)).mean()),
            )
        )
    return tuple(shares)


def _directions(surface: Surface, views: Sequence[View]) -> Float:
    """(m, 3) from where each place is best seen at which cloth goes on unseen."""
    samples, links = surface.samples, surface.links
    sheet = ~links.rim
    a, b = links.a[sheet], links.b[sheet]
    n = len(samples.xyz)
    beyond = outward(samples.xyz, samples.normal, a, b)
    facing = np.zeros(n)
    for k, view in enumerate(views):
        toward = inverse(view.calibration.T_rig_hanger(view.angle_rad))[:3, 3] - samples.xyz
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        cosine = (toward * samples.normal).sum(1)
        facing = np.where(samples.views[:, k], np.maximum(facing, cosine), facing)
    hidden = surface.edge == 2
    away = (surface.edge == 1) & (facing < GRAZING)
    look = np.vstack(
        [
            samples.normal[hidden] - beyond[hidden],
            samples.normal[away] + beyond[away],
        ]
    )
    unit: Float = look / np.maximum(np.linalg.norm(look, axis=1, keepdims=True), 1e-9)
    return unit


def _apart(angle: Float, others: Float) -> Float:
    """(m,) angle from each to the nearest of the others, rad."""
    apart = np.abs((angle[:, None] - others + np.pi) % TURN - np.pi)
    nearest: Float = apart.min(axis=1)
    return nearest


def advice(garment: FlatGarment, seen: Coverage, low_coverage: float) -> Unseen | None:
    """What to do about what no view shows; None: nothing that matters is missing.

    Parameters
    ----------
    garment : FlatGarment
    seen : Coverage
    low_coverage : float
        Share of the item seen below which much is missing.
    """
    missing = (
        seen.open_share >= LEAST_SHARE
        or garment.category == UNKNOWN
        or garment.coverage < low_coverage
        or any(size.inferred for size in garment.measurements[:2])
        or garment.outline.inferred.mean() > MOST_INFERRED
    )
    return Unseen(seen.turn_to_rad) if missing else None


def notice_of(unseen: Unseen, cut_off: bool = False) -> Notice:
    """The advice in words; views may have cut the item off."""
    if unseen.turn_to_rad is None and cut_off:
        text = "turning cannot show what no view shows: it lies beyond the image, or in folds"
    elif unseen.turn_to_rad is None:
        text = "turning cannot show what no view shows: it lies in folds; grasp the item elsewhere"
    else:
        degrees = np.degrees(unseen.turn_to_rad)
        text = f"turn to {degrees:.0f} degrees: cloth that no view shows would best be seen there"
    return Notice("unseen", text)


def enough(garment: FlatGarment, config: ViewsConfig) -> bool:
    """Whether further views would hardly change the answer.

    The result is trusted, its category is nearly certain, its width and length were seen and are
    certain to a few per cent, and no cloth is known to go on where another angle would show it.
    """
    sizes = [garment.measurement(name) for name in ("width", "length")]
    certain = all(
        size is not None
        and not size.inferred
        and size.sigma_m <= config.enough_sigma * size.value_m
        for size in sizes
    )
    return (
        garment.score_kind == "probability"
        and garment.category != UNKNOWN
        and garment.scores[garment.category] >= config.enough_probability
        and certain
        and (garment.unseen is None or garment.unseen.turn_to_rad is None)
        and garment.trusted
    )
