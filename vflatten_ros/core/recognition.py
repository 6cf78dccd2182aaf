"""Outline to category: eq. 11's model images, and the fit of each category's family of outlines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from vflatten_ros.core.config import RecognitionConfig
from vflatten_ros.core.doubled import MISLAID, doubled_share
from vflatten_ros.core.errors import InvalidInput
from vflatten_ros.core.evidence import Evidence, evidence_from, look_up
from vflatten_ros.core.faces import ONE_CLOTH
from vflatten_ros.core.model_images import model_image_scores
from vflatten_ros.core.template_fit import (
    ALONG,
    Fit,
    information,
    linearise,
    outline_residuals,
    place,
    refine,
    samples_per_edge,
    starts,
)
from vflatten_ros.core.templates import Float, Template
from vflatten_ros.core.values import Bool, FlatPoints, Outline, Progress, no_progress

UNKNOWN = "unknown"
BEST = 5  # hypotheses of a category that are refined to the end
FREEDOM = 25.0  # of an ordinary category: what its pose and sizes cost in evidence
AS_CUT = 0.2  # of the swing of parts, where nothing turned them
UNEXPLAINED = 1.5  # what an observation that only others explain costs a category (log odds)
DOUBLED = 60.0  # what a doubled share above MISLAID costs a single sheet (log odds)
# What faces more evenly apart than ONE_CLOTH cost a garment (log odds): for each 1, and at most,
# since thin layers may cling to each other all over
OF_ONE_CLOTH, MOST_OF_ONE_CLOTH = 75.0, 7.0
WORTH_WEIGHING = 1e-4  # probability of a category before loose parts were turned
HOPELESS = 40.0  # a category with this much more energy than the best is not refined with care
COARSE = (((12.0, 9.0), 16), ((6.0, 6.0), BEST))  # cuts of the steps, in sigmas; hypotheses kept
FINE = (5.0, 4.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0)
LAST = (3.0, 3.0, 3.0, 3.0, 3.0)


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
    even: float = 0.0  # 0-1, see evenly_apart

    @property
    def one_cloth(self) -> bool:
        """Whether it is a single sheet that its two faces show to be one, too."""
        single = self.fit is not None and self.fit.template.single_sheet
        return self.category != UNKNOWN and single and self.even >= ONE_CLOTH


def recognise(
    outline: Outline,
    points: FlatPoints,
    templates: tuple[Template, ...],
    config: RecognitionConfig,
    progress: Progress = no_progress,
    begin: Mapping[str, tuple[Float, Float]] | None = None,
    even: float = 0.0,
) -> Recognition:
    """Compare a flattened item with every category.

    Parameters
    ----------
    outline : Outline
        Closed outline of the flattened item; inferred parts are not trusted.
    points : FlatPoints
        Flattened points, of which the seen ones must lie on the item. Where they lie on others that
        hang elsewhere, the item is no single sheet.
    templates : tuple of Template
        Categories to choose from.
    config : RecognitionConfig
    progress : Progress
    begin : mapping of str to (ndarray of shape (3,), ndarray of shape (m,)), optional
        By category, the pose and state that it is fitted from, in place of all rotations.
    even : float
        How much of it has its two faces as far apart as most, see evenly_apart.

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
    progress("recognition", 0.0)
    evidence = evidence_from(outline, points, config)
    scores = model_image_scores(evidence.outline, templates, config.decay, config.model_rotations)
    fits = fit_templates(templates, evidence, config, progress, begin)
    probabilities = _probabilities(fits, evidence, points, config, even)
    none = np.zeros((0, 2))
    of_none = Recognition("", scores, {}, None, none, np.zeros(0, dtype=bool), fits, even)
    return likeliest_of(of_none, probabilities)


def likeliest_of(found: Recognition, probabilities: Mapping[str, float]) -> Recognition:
    """The same fits with other probabilities: the category is the likeliest."""
    category = max(probabilities, key=lambda name: probabilities[name])
    known = {name: p for name, p in probabilities.items() if name != UNKNOWN}
    fit = found.fits[max(known, key=lambda name: known[name])]
    k = fit.template.vertices if category != UNKNOWN else 0
    return replace(
        found,
        category=category,
        probabilities=probabilities,
        fit=fit,
        template_uv=fit.points()[:k],
        template_seen=fit.vertex_seen()[:k],
    )


def recognise_again(
    found: Recognition,
    outline: Outline,
    points: FlatPoints,
    templates: tuple[Template, ...],
    config: RecognitionConfig,
) -> Recognition:
    """The category once the item's loose parts were turned to rest, fitted from where it was.

    Legs together look like a skirt, so only categories of the same build are still weighed against
    each other. Their sizes tell them apart, and splayed legs hide where the crotch is. What was
    taken for a category without parts is recognised anew: a slit may have come out.

    Raises
    ------
    InvalidInput
        As recognise.
    """
    before = found.fits[found.category]
    if not before.template.parts:
        anew = recognise(outline, points, templates, config, even=found.even)
        if anew.category != UNKNOWN:
            return anew
    evidence = evidence_from(outline, points, config)
    alike = [t for t in templates if t.same_build(before.template)]
    alike = [t for t in alike if found.probabilities.get(t.category, 0.0) > WORTH_WEIGHING]
    fits = {t.category: _fitted_from(before, t, evidence) for t in alike or [before.template]}
    weighed = _probabilities(fits, evidence, points, config, found.even)
    del weighed[UNKNOWN]
    together = sum(found.probabilities.get(name, 0.0) for name in fits) / sum(weighed.values())
    category = max(weighed, key=lambda name: weighed[name])
    fit = fits[category]
    k = fit.template.vertices
    return replace(
        found,
        category=category,
        probabilities={**found.probabilities, **{n: together * p for n, p in weighed.items()}},
        fit=fit,
        template_uv=fit.points()[:k],
        template_seen=fit.vertex_seen()[:k],
        fits={**found.fits, **fits},
    )


def _fitted_from(before: Fit, template: Template, evidence: Evidence) -> Fit:
    """A category fitted from where another of the same build, or itself, was."""
    state = before.state
    if template.category != before.template.category:
        state = template.state_of(before.template, state)
    pose = np.stack([before.pose, before.pose])
    states = np.stack([state, template.at_rest(state)])
    pose, states, energy = refine(template, evidence, pose, states, FINE)
    best = [int(energy.argmin())]
    return finish(template, evidence, pose[best], states[best])


def fit_templates(
    templates: tuple[Template, ...],
    evidence: Evidence,
    config: RecognitionConfig,
    progress: Progress = no_progress,
    begin: Mapping[str, tuple[Float, Float]] | None = None,
) -> dict[str, Fit]:
    """The best pose and cut of every category; those that turn out hopeless with less effort."""
    coarse, known = {}, begin or {}
    for done, template in enumerate(templates):
        progress("recognition", 0.2 + 0.4 * done / len(templates))
        if template.category in known:
            pose, state = known[template.category]
            start = pose[None], state[None]
            coarse[template.category] = refine(template, evidence.thinned(), *start, COARSE[-1][0])
        else:
            coarse[template.category] = _coarse(template, evidence.thinned(), config)
    least = min(float(energy[0]) for _, _, energy in coarse.values())
    fits = {}
    for done, template in enumerate(templates):
        progress("recognition", 0.6 + 0.4 * done / len(templates))
        pose, state, energy = coarse[template.category]
        few = 1 if energy[0] > least + HOPELESS else BEST
        pose, state, energy = refine(template, evidence, pose[:few], state[:few], FINE)
        best = [int(energy.argmin())]
        fits[template.category] = finish(template, evidence, pose[best], state[best])
    return fits


def _coarse(
    template: Template, evidence: Evidence, config: RecognitionConfig
) -> tuple[Float, Float, Float]:
    """Poses and cuts from all rotations, best first; the worse half is dropped on the way."""
    pose, state = starts(template, evidence, config.fit_rotations)
    for cuts, keep in COARSE:
        pose, state, energy = refine(template, evidence, pose, state, cuts)
        first = np.argsort(energy, kind="stable")[:keep]
        pose, state, energy = pose[first], state[first], energy[first]
    return pose, state, energy


def finish(template: Template, evidence: Evidence, pose: Float, state: Float) -> Fit:
    """The fit under the errors that were found, and how well it explains what was seen."""
    scale = _spread(evidence, template, pose[0], state[0])
    pose, state, _ = refine(template, evidence, pose, state, LAST, scale)
    system = linearise(template, evidence, pose, state, scale * LAST[-1])
    energy = float(system.energy[0]) / scale**2 + 2.0 * evidence.total * np.log(scale)
    freedom = _freedom(template, state[0], system.hessian[0] / scale**2)
    outline = place(template, pose[0], state[0])[0][: template.vertices]
    distance, seen = _edge_distances(evidence, outline)
    on = np.abs(distance) < 3.0 * float(np.median(evidence.sigma))
    trusted = evidence.weight > 0
    residual = np.abs(outline_residuals(evidence, outline))[trusted]
    return Fit(
        template=template,
        pose=pose[0],
        state=state[0],
        covariance=_covariance(template, evidence, pose[0], state[0], scale),
        evidence=-energy - freedom,
        misfit=energy / max(2.0 * evidence.total, 1e-9),
        residual_m=scale * float(np.median(evidence.sigma)),
        explained=float((residual < 3.0).mean()) if trusted.any() else 0.0,
        edge_seen=(on & (seen > 0)).astype(float),
    )


def _covariance(
    template: Template, evidence: Evidence, pose: Float, state: Float, scale: float
) -> Float:
    """Of pose and state; where no seen edge tells of a size, it is as uncertain as before."""
    prior = np.diag(np.r_[1e-6, 1e-6, 1e-6, np.ones(template.dimensions)])
    told = information(template, evidence, pose, state, scale * LAST[-1])
    result: Float = np.linalg.inv(told / scale**2 + prior)
    return result


def _freedom(template: Template, state: Float, hessian: Float) -> float:
    """What the pose and cut cost in evidence (Laplace's approximation).

    Parts lie mostly as they were cut, and sometimes anyhow: half of the prior is narrow.
    """
    swings = np.zeros(template.dimensions, dtype=bool)
    swings[len(template.sizes) + len(template.parts) :] = True
    logs = []
    for narrow in (1.0, AS_CUT) if swings.any() else (1.0,):
        unit = np.where(swings, narrow, 1.0)
        of_pose = np.r_[1.0, 1.0, 1.0, unit]
        prior = np.diag(np.r_[1e-6, 1e-6, 1e-6, np.ones(template.dimensions)])
        narrowed = hessian * of_pose * of_pose[:, None] + prior
        volume = 0.5 * float(np.linalg.slogdet(narrowed)[1])
        logs.append(-0.5 * float(((state / unit) ** 2).sum()) - volume)
    return -float(np.logaddexp.reduce(logs)) + float(np.log(len(logs)))


def _spread(evidence: Evidence, template: Template, pose: Float, state: Float) -> float:
    """How large the errors of the seen outline are, in sigmas: robust, within 0.4 to 2.5."""
    outline = place(template, pose, state)[0][: template.vertices]
    residual = np.abs(outline_residuals(evidence, outline))[evidence.weight > 0]
    if not len(residual):
        return 1.0
    return float(np.clip(1.4826 * np.median(residual), 0.4, 2.5))


def _edge_distances(evidence: Evidence, outline: Float) -> tuple[Float, Float]:
    """Distance of samples of a template's edges from the seen outline; 1: it was seen, along them.

    An outline across an edge, as that of a strip of cloth that reaches beyond it, does not show it.
    """
    samples = samples_per_edge(len(outline))
    share: Float = ((np.arange(samples) + 0.5) / samples)[:, None]
    at = outline[:, None] * (1 - share) + np.roll(outline, -1, axis=0)[:, None] * share
    distance, slope, seen = look_up(evidence, at)
    step = np.roll(outline, -1, axis=0) - outline
    outward = np.column_stack([step[:, 1], -step[:, 0]])
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    faces = (slope * outward[:, None]).sum(axis=-1) > ALONG
    return distance, seen * faces


def of_one_cloth(template: Template, even: float) -> float:
    """What it costs a garment with a front and a back that the item seems one cloth (log odds)."""
    cost = OF_ONE_CLOTH * max(0.0, even - ONE_CLOTH)
    return 0.0 if template.single_sheet else min(cost, MOST_OF_ONE_CLOTH)


def _probabilities(
    fits: Mapping[str, Fit],
    evidence: Evidence,
    points: FlatPoints,
    config: RecognitionConfig,
    even: float,
) -> dict[str, float]:
    names = [*fits, UNKNOWN]
    doubled = 0.0
    if any(fit.template.single_sheet for fit in fits.values()):
        doubled = DOUBLED * max(0.0, doubled_share(points) - MISLAID)
    observations = 2.0 * evidence.total
    # fits are lenient with what they leave unexplained; where another category explains it, it is
    # no error of the flattening
    most = max(fit.explained for fit in fits.values())
    logs = [
        fit.evidence
        - UNEXPLAINED * observations * (most - fit.explained)
        - doubled * fit.template.single_sheet
        - of_one_cloth(fit.template, even)
        for fit in fits.values()
    ]
    logs.append(-FREEDOM - config.unknown_misfit * observations)
    value = np.exp(np.array(logs) - max(logs))
    return dict(zip(names, (value / value.sum()).tolist()))
