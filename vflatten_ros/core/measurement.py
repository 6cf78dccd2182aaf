"""Category and fitted outline to named sizes, named places, and how far to trust them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.config import MeasurementConfig
from vflatten_ros.core.recognition import UNKNOWN, Recognition
from vflatten_ros.core.template_fit import Fit, place
from vflatten_ros.core.templates import Float
from vflatten_ros.core.values import FlatPoints, Int, Landmark, Measurement, Notice, Outline

CELL_M = 0.01  # of the area counted as seen
ALIKE_M = 0.01  # between an outline and itself after half a turn, that cannot be told apart
HELD_M = 0.03  # from the middle of such an item to where it is held, that tells its ends apart
FEW = 2  # views from which outlines err along whole edges


@dataclass(frozen=True)
class Measured:
    """Sizes and places of one item."""

    measurements: tuple[Measurement, ...]  # width and length first
    landmarks: tuple[Landmark, ...]
    coverage: float  # 0-1, share of the fitted outline's area that was seen
    quality: float  # 0-1
    notices: tuple[Notice, ...]


def measure(
    recognition: Recognition, outline: Outline, points: FlatPoints, config: MeasurementConfig
) -> Measured:
    """Sizes and landmarks of the recognised category on the flattened item.

    Parameters
    ----------
    recognition : Recognition
        Of the same outline and points.
    outline : Outline
    points : FlatPoints
    config : MeasurementConfig

    Returns
    -------
    Measured
        Without sizes and landmarks if the category is unknown.
    """
    fit = recognition.fit
    if fit is None or recognition.category == UNKNOWN:
        notice = Notice("untrusted", "no category fits the item; sizes are not given")
        return Measured((), (), 0.0, 0.0, (notice,))
    if len(np.unique(points.view_id[points.view_id >= 0])) <= FEW:
        fit = replace(fit, covariance=_loosened(fit.covariance, config.few_views_factor))
    measurements = sizes(fit, config)
    coverage = covered(fit, points)
    quality = _quality(recognition, fit, measurements, coverage)
    return Measured(
        measurements=measurements,
        landmarks=landmarks(fit, points, recognition.probabilities[recognition.category], config),
        coverage=coverage,
        quality=quality,
        notices=_notices(recognition, fit, points, measurements, coverage, quality, config),
    )


def _loosened(covariance: Float, factor: float) -> Float:
    """What was seen is less certain by a factor; what is usual of a category stays as it was."""
    usual = np.diag(np.r_[0.0, 0.0, 0.0, np.ones(len(covariance) - 3)])
    result: Float = np.linalg.inv(
        np.linalg.inv(covariance) / factor**2 + (1.0 - 1.0 / factor**2) * usual
    )
    return result


def sizes(fit: Fit, config: MeasurementConfig) -> tuple[Measurement, ...]:
    """Every size of the fitted category, width and length first."""
    template = fit.template
    found = template.measure(fit.state, fit.covariance[3:, 3:])
    first = ["width", "length"]
    placed = fit.points()
    result = []
    for name in [*first, *(n for n in found if n not in first)]:
        value, sigma = found[name]
        path = template.paths[name][0]
        ends = (_pair(placed[path[0]]), _pair(placed[path[-1]]))
        seen = _seen(fit, name)
        sigma = sigma if seen else float(np.hypot(sigma, config.unseen_share * value))
        result.append(Measurement(name, value, sigma, not seen, ends))
    return tuple(result)


def _pair(point: Float) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _seen(fit: Fit, name: str) -> bool:
    """Whether the edges that bound a size were seen, on one side of the item at least."""
    return any(_bounds_seen(fit, path) for path in fit.template.paths[name])


def _bounds_seen(fit: Fit, path: Int, enough: float = 0.25) -> bool:
    """A size is bounded, at either end, by an edge across its direction there."""
    points = fit.points()
    ends = (
        (path[0], points[path[0]] - points[path[1]]),
        (path[-1], points[path[-1]] - points[path[-2]]),
    )
    return all(_edge_seen(fit, points[i], way / np.linalg.norm(way), enough) for i, way in ends)


def _edge_seen(fit: Fit, at: Float, way: Float, enough: float) -> bool:
    outline = fit.points()[: fit.template.vertices]
    step = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(step, axis=1)
    along = np.clip(((at - outline) * step).sum(axis=1) / np.maximum(length, 1e-9) ** 2, 0.0, 1.0)
    away = np.linalg.norm(outline + along[:, None] * step - at, axis=1)
    normal = np.column_stack([step[:, 1], -step[:, 0]]) / np.maximum(length, 1e-9)[:, None]
    bounding = (away < away.min() + 0.01) & (normal @ way > 0.5)
    if not bounding.any():
        bounding = away < away.min() + 0.01
    return bool((fit.edge_seen[bounding].mean(axis=1) >= enough).any())


def covered(fit: Fit, points: FlatPoints) -> float:
    """Share of the fitted outline's area that lies near seen points."""
    outline = fit.points()[: fit.template.vertices]
    seen = points.uv[~points.inferred]
    if len(seen) < 2:
        return 0.0
    low = outline.min(axis=0)
    cols, rows = np.ceil((outline.max(axis=0) - low) / CELL_M).astype(int) + 1
    image = np.zeros((rows, cols), dtype=np.uint8)
    cv2.fillPoly(image, [np.rint((outline - low) / CELL_M * 16).astype(np.int32)], 1, shift=4)
    cells = low + CELL_M * np.argwhere(image)[:, ::-1]
    tree = cKDTree(seen)
    spacing = float(np.median(tree.query(seen, k=2)[0][:, 1]))
    near = tree.query(cells)[0] < max(1.5 * CELL_M, 2.0 * spacing)
    return float(near.mean())


def landmarks(
    fit: Fit, points: FlatPoints, probability: float, config: MeasurementConfig
) -> tuple[Landmark, ...]:
    """Every named point: its flat place from the fit, its hanging place from what was seen.

    One that no view shows hangs no farther from the nearest cloth that was seen than it lies from
    it laid flat: that cloth is its place, as uncertain as it is far.
    """
    placed, slope = place(fit.template, fit.pose, fit.state)
    variance = np.einsum("pim,mn,pin->pi", slope, fit.covariance, slope)
    sigma = np.sqrt(variance.mean(axis=1))
    seen = np.nonzero(~points.inferred)[0]
    tree = cKDTree(points.uv[seen]) if len(seen) else None
    middle = half_turn_about(fit)
    if middle is not None and named_by_hold(fit, points, middle):
        middle = None
    result = []
    for name, i in fit.template.landmarks.items():
        moved = middle is not None and np.linalg.norm(placed[i] - middle) > ALIKE_M
        sure = 0.5 * probability if moved else probability
        near = (
            seen[
                np.sort(
                    np.array(tree.query_ball_point(placed[i], config.landmark_radius_m), np.int64)
                )
            ]
            if tree is not None
            else seen
        )
        result.append(_landmark(name, placed[i], float(sigma[i]), points, near, sure, config))
    return tuple(result)


def half_turn_about(fit: Fit) -> Float | None:
    """(2,) point about which half a turn leaves the fitted outline as it is; None if none does."""
    outline = fit.points()[: fit.template.vertices]
    step = np.roll(outline, -1, axis=0) - outline
    weight = np.linalg.norm(step, axis=1)
    middle: Float = (weight[:, None] * (outline + step / 2)).sum(axis=0) / weight.sum()
    line = outline.astype(np.float32)
    turned = 2 * middle - outline
    off = [abs(cv2.pointPolygonTest(line, (float(u), float(v)), True)) for u, v in turned]
    return middle if max(off) < ALIKE_M else None


def held_above_m(fit: Fit, points: FlatPoints, middle: Float) -> float:
    """How far up from the middle of the flat item the gripper holds it, m; 0 if nothing was seen.

    Up is from the category's bottom to its top.
    """
    seen = np.flatnonzero(~points.inferred)
    if not len(seen):
        return 0.0
    held = points.uv[seen[np.linalg.norm(points.xyz_hanger[seen], axis=1).argmin()]]
    up = np.array([-np.sin(fit.pose[0]), np.cos(fit.pose[0])])
    return float((held - middle) @ up)


def named_by_hold(fit: Fit, points: FlatPoints, middle: Float) -> bool:
    """Whether its hold tells which of two ends that look alike is called bottom: see held_end."""
    return fit.template.single_sheet and held_above_m(fit, points, middle) < -HELD_M


def _landmark(
    name: str,
    at: Float,
    sigma: float,
    points: FlatPoints,
    near: Int,
    probability: float,
    config: MeasurementConfig,
) -> Landmark:
    if not len(near):
        certainty = 0.25 * probability * float(np.exp(-((sigma / 0.05) ** 2)))
        place_3d, xyz_sigma = _cloth_nearest(at, sigma, points)
        return Landmark(name, _pair(at), sigma, place_3d, xyz_sigma, (), certainty)
    distance = np.linalg.norm(points.uv[near] - at, axis=1)
    layer = _layer(points.xyz_hanger[near], distance, config.layer_gap_m)
    near, distance = near[layer], distance[layer]
    weight = np.exp(-0.5 * (distance / 0.006) ** 2) + 1e-6
    weight /= weight.sum()
    xyz = weight @ points.xyz_hanger[near]
    spread = np.sqrt(weight @ ((points.xyz_hanger[near] - xyz) ** 2).sum(axis=1))
    astray = 0.0 if points.astray_m is None else 0.5 * float(weight @ points.astray_m[near])
    xyz_sigma = float(np.sqrt(sigma**2 + spread**2 / 3.0 + distance.min() ** 2 + astray**2))
    ids = points.view_id[near]
    views = sorted({int(v) for v in ids if v >= 0}, key=lambda v: (distance[ids == v].min(), v))
    certainty = probability * float(np.exp(-((xyz_sigma / 0.05) ** 2)))
    return Landmark(name, _pair(at), sigma, _triple(xyz), xyz_sigma, tuple(views), certainty)


def _cloth_nearest(
    at: Float, sigma: float, points: FlatPoints
) -> tuple[tuple[float, float, float] | None, float]:
    """Where the cloth that was seen nearest to a flat place hangs, and how far off that may be."""
    seen = np.flatnonzero(~points.inferred)
    if not len(seen):
        return None, float("nan")
    distance = np.linalg.norm(points.uv[seen] - at, axis=1)
    nearest = int(distance.argmin())
    return _triple(points.xyz_hanger[seen[nearest]]), float(np.hypot(sigma, distance[nearest]))


def _triple(xyz: Float) -> tuple[float, float, float]:
    return float(xyz[0]), float(xyz[1]), float(xyz[2])


def _layer(xyz: Float, distance: Float, gap: float) -> Float:
    """Which points hang on the layer of the point that is nearest in the flat plane."""
    reached = np.zeros(len(xyz), dtype=bool)
    reached[distance.argmin()] = True
    pairs = cKDTree(xyz).query_pairs(gap, output_type="ndarray")
    while True:
        grown = reached.copy()
        grown[pairs[reached[pairs[:, 0]], 1]] = True
        grown[pairs[reached[pairs[:, 1]], 0]] = True
        if (grown == reached).all():
            return reached
        reached = grown


def _quality(
    recognition: Recognition, fit: Fit, measurements: tuple[Measurement, ...], coverage: float
) -> float:
    """Of the category and the sizes that may be used: those not seen have a notice of their own."""
    both = measurements[:2]
    used = [size for size in both if not size.inferred] or both
    relative = max(size.sigma_m / size.value_m for size in used)
    doubt = relative / 0.05 + (1.0 - coverage) + (1.0 - fit.explained)
    return float(recognition.probabilities[recognition.category] * np.exp(-0.5 * doubt))


def _notices(
    recognition: Recognition,
    fit: Fit,
    points: FlatPoints,
    measurements: tuple[Measurement, ...],
    coverage: float,
    quality: float,
    config: MeasurementConfig,
) -> tuple[Notice, ...]:
    notices = []
    for size in measurements[:2]:
        if size.inferred:
            text = (
                f"{size.name} {size.value_m:.3f} m rests on a part of the item that no view shows: "
                "do not rely on it"
            )
            notices.append(Notice(f"{size.name}_unseen", text))
    if coverage < config.low_coverage:
        text = f"{100 * coverage:.0f} % of the item was seen"
        notices.append(Notice("low_coverage", text))
    order = sorted(recognition.probabilities.items(), key=lambda item: -item[1])
    if len(order) > 1 and order[1][1] > 0.2:
        text = f"{order[0][0]} {order[0][1]:.2f}, {order[1][0]} {order[1][1]:.2f}"
        notices.append(Notice("category_uncertain", text))
    middle = half_turn_about(fit)
    if middle is not None:
        by_hold = named_by_hold(fit, points, middle)
        named = (
            "the one at the gripper is called bottom" if by_hold else "their names may be exchanged"
        )
        text = f"{recognition.category}: both ends look alike, {named}"
        notices.append(Notice("ends_alike", text))
    if quality < config.trusted_quality:
        notices.append(Notice("untrusted", f"quality {quality:.2f}: do not use the sizes"))
    return tuple(notices)
