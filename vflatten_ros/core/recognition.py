"""Outline to category: eq. 11's model images, and the fit of every category's family of outlines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from vflatten_ros.core.config import RecognitionConfig
from vflatten_ros.core.errors import InvalidInput
from vflatten_ros.core.model_images import centroid, model_image_scores
from vflatten_ros.core.template_fit import (
    CELL_M,
    Evidence,
    Fit,
    linearise,
    look_up,
    place,
    refine,
    samples_per_edge,
    starts,
)
from vflatten_ros.core.templates import Float, Template
from vflatten_ros.core.values import Bool, FlatPoints, Outline

UNKNOWN = "unknown"
MOST_POINTS = 128  # of the outline and of the flattened points, in a fit
BEST = 5  # hypotheses of a category that are refined to the end


@dataclass(frozen=True, eq=False)
class Recognition:
    """What the item is, and the best category's outline fitted to it."""

    category: str  # best category or "unknown", by probability
    scores: Mapping[str, float]  # category -> R of eq. 11
    probabilities: Mapping[str, float]  # category -> probability, "unknown" included
    fit: Fit | None  # of the best category, even if "unknown" is likelier; None: no outline
    template_uv: Float  # (k, 2) the category's outline, flat frame; (0, 2) if unknown
    template_seen: Bool  # (k,) whether a view shows the outline near the vertex
    fits: Mapping[str, Fit]  # category -> its best fit


def recognise(
    outline: Outline,
    points: FlatPoints,
    templates: tuple[Template, ...],
    config: RecognitionConfig,
) -> Recognition:
    """Compare a flattened item with every category.

    Parameters
    ----------
    outline : Outline
        Closed outline of the flattened item; inferred parts are not trusted.
    points : FlatPoints
        Flattened points, of which the seen ones must lie on the item.
    templates : tuple of Template
        Categories to choose from.
    config : RecognitionConfig

    Returns
    -------
    Recognition

    Raises
    ------
    InvalidInput
        No templates, or an outline of fewer than three points or without area.
    """
    if not templates:
        raise InvalidInput("recognise: no categories to choose from; see config/categories")
    evidence = evidence_from(outline, points, config)
    scores = model_image_scores(evidence.outline, templates, config.decay, config.model_rotations)
    fits = {t.category: fit_template(t, evidence, config) for t in templates}
    probabilities = _probabilities(fits, evidence, config)
    category = max(probabilities, key=lambda name: probabilities[name])
    known = {name: p for name, p in probabilities.items() if name != UNKNOWN}
    fit = fits[max(known, key=lambda name: known[name])]
    k = fit.template.vertices if category != UNKNOWN else 0
    near = np.maximum(fit.edge_seen[:, 0], np.roll(fit.edge_seen[:, -1], 1))
    return Recognition(
        category=category,
        scores=scores,
        probabilities=probabilities,
        fit=fit,
        template_uv=fit.points()[:k],
        template_seen=near[:k] > 0.5,
        fits=fits,
    )


def evidence_from(outline: Outline, points: FlatPoints, config: RecognitionConfig) -> Evidence:
    """Evenly spaced seen outline, its distance image and the outermost flattened points."""
    if len(outline.uv) < 3 or not np.isfinite(outline.uv).all():
        raise InvalidInput(f"outline: expected three finite points or more, got {outline.uv.shape}")
    uv, sigma, inferred = _evenly(outline)
    twice_area = np.cross(uv, np.roll(uv, -1, axis=0)).sum()
    if abs(twice_area) < 2e-4:
        raise InvalidInput("outline: encloses less than 1 cm2")
    if twice_area < 0:
        uv, sigma, inferred = uv[::-1], sigma[::-1], inferred[::-1]
    spacing = float(np.linalg.norm(uv[1] - uv[0]))
    weight = np.full(len(uv), 0.5 * spacing / config.correlation_m)
    origin, distance, slope, seen = _distance_image(uv, ~inferred)
    total = np.hypot(sigma, config.misfit_m)
    evidence = Evidence(
        outline=uv,
        normal=_normals(uv),
        sigma=total,
        weight=np.where(inferred, 0.0, weight),
        inner=np.zeros((0, 2)),
        inner_sigma=np.zeros(0),
        inner_weight=np.zeros(0),
        origin=origin,
        distance=distance,
        slope=slope,
        seen=seen,
        centre=centroid(uv),
        area=0.5 * abs(float(twice_area)),
    )
    return _with_inner(evidence, points, config)


def _evenly(outline: Outline) -> tuple[Float, Float, Bool]:
    closed = np.vstack([outline.uv, outline.uv[:1]])
    at = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))]
    wanted = np.arange(MOST_POINTS) * (at[-1] / MOST_POINTS)
    uv = np.column_stack([np.interp(wanted, at, column) for column in closed.T])
    sigma = np.interp(wanted, at, np.r_[outline.sigma_m, outline.sigma_m[0]])
    inferred = np.interp(wanted, at, np.r_[outline.inferred, outline.inferred[0]].astype(float))
    return uv, sigma, inferred > 0.5


def _normals(uv: Float) -> Float:
    """Outward normals of a closed outline, over five points."""
    along = np.roll(uv, -2, axis=0) - np.roll(uv, 2, axis=0)
    outward = np.column_stack([along[:, 1], -along[:, 0]])
    normals: Float = outward / np.maximum(np.linalg.norm(outward, axis=1), 1e-9)[:, None]
    return normals


def _distance_image(uv: Float, trusted: Bool) -> tuple[Float, Float, Float, Float]:
    margin = 0.15
    origin = uv.min(axis=0) - margin
    cols, rows = np.ceil((uv.max(axis=0) + margin - origin) / CELL_M).astype(int) + 1
    fine = np.rint((uv - origin) / CELL_M * 16).astype(np.int32)
    body = np.zeros((rows, cols), dtype=np.uint8)
    cv2.fillPoly(body, [fine], 1, shift=4)
    edge = np.ones((rows, cols), dtype=np.uint8)
    cv2.polylines(edge, [fine], isClosed=True, color=0, thickness=1, shift=4)
    away, label = cv2.distanceTransformWithLabels(
        edge, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    distance = np.where(body > 0, -away, away).astype(np.float64) * CELL_M
    down, right = np.gradient(distance, CELL_M)
    of_label = np.zeros(label.max() + 1)
    row, col = np.nonzero(edge == 0)
    cell = origin + CELL_M * np.column_stack([col, row])
    nearest = ((cell[:, None] - uv[None]) ** 2).sum(-1).argmin(axis=1)
    of_label[label[row, col]] = trusted[nearest]
    return origin, distance, np.stack([right, down], axis=-1), of_label[label]


def _with_inner(evidence: Evidence, points: FlatPoints, config: RecognitionConfig) -> Evidence:
    """Add the outermost seen points, thinned."""
    usable = ~points.inferred & np.isfinite(points.uv).all(axis=1)
    uv, sigma = points.uv[usable], points.sigma_m[usable]
    depth = look_up(evidence, uv)[0]
    outermost = np.nonzero(depth > -0.03)[0]
    keep = outermost[np.linspace(0, len(outermost) - 1, min(len(outermost), MOST_POINTS)).astype(int)]
    share = 0.5 * evidence.weight.sum() / max(len(keep), 1)
    from dataclasses import replace

    return replace(
        evidence,
        inner=uv[keep],
        inner_sigma=np.hypot(sigma[keep], config.misfit_m),
        inner_weight=np.full(len(keep), share),
    )


def fit_template(template: Template, evidence: Evidence, config: RecognitionConfig) -> Fit:
    """The best pose and cut of one category."""
    pose, state = starts(template, evidence, config.fit_rotations)
    pose, state, energy = refine(template, evidence, pose, state, (12.0, 9.0, 6.0, 6.0), 2.0)
    first = np.argsort(energy, kind="stable")[:BEST]
    cuts = (5.0, 4.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0)
    pose, state, energy = refine(template, evidence, pose[first], state[first], cuts, 2.0)
    best = energy.argmin()
    return _finish(template, evidence, pose[best], state[best])


def _finish(template: Template, evidence: Evidence, pose: Float, state: Float) -> Fit:
    system = linearise(template, evidence, pose[None], state[None], 3.0, 6.0)
    prior = np.diag(np.r_[1e-6, 1e-6, 1e-6, np.ones(template.dimensions)])
    points = place(template, pose, state)[0][: template.vertices]
    distance, seen = _edge_distances(evidence, points)
    on = np.abs(distance) < 3.0 * float(np.median(evidence.sigma))
    edge_seen = (on & (seen > 0)).astype(float)
    residual = look_up_outline(evidence, points)
    trusted = evidence.weight > 0
    inlier = np.abs(residual[trusted]) < 3.0
    spread = 1.4826 * float(np.median(np.abs(residual[trusted]))) if trusted.any() else 1.0
    hessian = system.hessian[0] / max(1.0, spread) ** 2 + prior
    energy = float(system.energy[0])
    return Fit(
        template=template,
        pose=pose,
        state=state,
        covariance=np.linalg.inv(hessian),
        energy=energy + 0.5 * float(state @ state),
        evidence=-energy
        - 0.5 * float(state @ state)
        - 0.5 * float(np.linalg.slogdet(system.hessian[0] + prior)[1]),
        residual_m=spread * float(np.median(evidence.sigma)),
        explained=float(inlier.mean()) if trusted.any() else 0.0,
        edge_seen=edge_seen,
    )


def _edge_distances(evidence: Evidence, outline: Float) -> tuple[Float, Float]:
    samples = samples_per_edge(len(outline))
    share = ((np.arange(samples) + 0.5) / samples)[:, None]
    at = outline[:, None] * (1 - share) + np.roll(outline, -1, axis=0)[:, None] * share
    distance, _, seen = look_up(evidence, at)
    return distance, seen


def look_up_outline(evidence: Evidence, outline: Float) -> Float:
    """(n,) signed distances of the seen outline from a template's, in sigmas."""
    from vflatten_ros.core.template_fit import _nearest_edge

    distance = _nearest_edge(evidence.outline, evidence.normal, outline[None])[2][0]
    return distance / evidence.sigma


def _probabilities(
    fits: Mapping[str, Fit], evidence: Evidence, config: RecognitionConfig
) -> dict[str, float]:
    names = [*fits, UNKNOWN]
    logs = [fit.evidence for fit in fits.values()]
    freedom = 20.0  # cost of the freedom of an ordinary category: 0.5 log det
    logs.append(-freedom - config.unknown_misfit * 2.0 * float(evidence.weight.sum()))
    value = np.exp(np.array(logs) - max(logs))
    return dict(zip(names, (value / value.sum()).tolist()))
