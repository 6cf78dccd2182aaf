"""Fits a family of outlines to a flattened item: pose, sizes and turned parts at once.

Robust Gauss-Newton on signed distances, from many rotations together. Three kinds of evidence:
points of the seen outline lie on the template's; points of the template's outline lie on the seen
one, unless that part was not seen; and flattened points lie inside the template.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.evidence import Evidence, look_up
from vflatten_ros.core.templates import Float, Template
from vflatten_ros.core.values import Bool

Int = NDArray[np.int64]

MISSING = 0.8  # where residuals level off, in cuts: cloth that is missing is easily believed,
OUTSIDE = 1.5  # cloth that is too much is not
WIDE = np.radians(20.0)  # parts that swing farther start spread, too
SPREADS = np.radians([35.0, 75.0])
ALONG = 0.5  # cosine between directions outward of an edge and of the outline that shows it
FACING_M = 0.03  # how much farther an edge counts that faces across


@dataclass(frozen=True, eq=False)
class Fit:
    """The best pose and cut of one template."""

    template: Template
    pose: Float  # (3,) rotation rad, u, v of the template in the flat frame
    state: Float  # (m,) of the template
    covariance: Float  # (3 + m, 3 + m) of pose and state
    evidence: float  # logarithm of the probability of what was seen, up to a constant
    misfit: float  # what an independent observation costs, on average
    residual_m: float  # robust rms distance of the seen outline
    explained: float  # 0-1, share of the seen outline that lies on the template's
    edge_seen: Float  # (e, s) 0-1: how well each sample of each template edge is seen

    def points(self) -> Float:
        """(p, 2) all points of the template in the flat frame."""
        return place(self.template, self.pose, self.state)[0]

    def vertex_seen(self) -> Bool:
        """(k,) whether a view shows the outline near each of its vertices."""
        near = np.maximum(self.edge_seen[:, 0], np.roll(self.edge_seen[:, -1], 1))
        seen: Bool = near > 0.5
        return seen


def place(template: Template, pose: Float, state: Float) -> tuple[Float, Float]:
    """Template points in the flat frame, (..., p, 2), and their slope, (..., p, 2, 3 + m)."""
    local, by_state = template.place(state)
    cos, sin = np.cos(pose[..., 0]), np.sin(pose[..., 0])
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)[..., None, :, :]
    arm = (turn @ local[..., None])[..., 0]
    slope = np.empty((*local.shape, 3 + template.dimensions))
    slope[..., 0, 0], slope[..., 1, 0] = -arm[..., 1], arm[..., 0]
    slope[..., 1:3] = np.eye(2)
    slope[..., 3:] = turn @ by_state
    return arm + pose[..., None, 1:], slope


def starts(template: Template, evidence: Evidence, rotations: int) -> tuple[Float, Float]:
    """Typical cuts of the seen area in every direction: poses (r, 3) and states (r, m)."""
    typical = template.outline(np.zeros(template.dimensions))
    area, centre = _moments(typical)
    seen_area, seen_centre = _moments(evidence.outline)
    extent = np.linalg.norm(evidence.outline - seen_centre, axis=1).max()
    reach = np.linalg.norm(typical - centre, axis=1).max()
    scale = 0.5 * np.log(extent / reach) + 0.25 * np.log(seen_area / area)
    roots = np.abs(template.log_spread).astype(bool).sum(axis=1) == 1
    state = np.zeros(template.dimensions)
    state[: len(template.sizes)][roots] = scale / np.diagonal(template.log_spread)[roots]
    centre = _moments(template.outline(state))[1]
    angle = np.arange(rotations) * (2.0 * np.pi / rotations)
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.stack([cos * centre[0] - sin * centre[1], sin * centre[0] + cos * centre[1]], -1)
    poses = np.column_stack([angle, seen_centre - turned])
    states = [state]
    wide = np.flatnonzero(template.swing > WIDE)
    for turn in SPREADS if len(wide) else ():
        spread = state.copy()
        first = len(template.sizes) + len(template.parts)
        for side in (0, len(template.parts)):
            spread[first + side + wide] = turn / template.swing[wide]
        states.append(spread)
    return np.tile(poses, (len(states), 1)), np.repeat(states, rotations, axis=0)


def _moments(outline: Float) -> tuple[float, Float]:
    after = np.roll(outline, -1, axis=0)
    cross = outline[:, 0] * after[:, 1] - outline[:, 1] * after[:, 0]
    area = 0.5 * float(cross.sum())
    return abs(area), (cross[:, None] * (outline + after)).sum(axis=0) / (6.0 * area)


@dataclass(frozen=True, eq=False)
class _System:
    """Weighted normal equations of a batch of hypotheses, without the prior."""

    hessian: Float  # (b, 3 + m, 3 + m)
    gradient: Float  # (b, 3 + m)
    energy: Float  # (b,)


def linearise(
    template: Template, evidence: Evidence, pose: Float, state: Float, cut: float
) -> _System:
    """Robust normal equations at (b, 3) poses and (b, m) states."""
    points, slope = place(template, pose, state)
    k = template.vertices
    outline, moves = points[:, :k], slope[:, :k]
    terms = [
        _seen_on_template(evidence, outline, moves, cut),
        _template_on_seen(evidence, outline, moves, cut),
    ]
    if len(evidence.inner):
        terms.append(_inner_in_template(evidence, outline, moves, OUTSIDE * cut))
    rows = np.concatenate([t[0] for t in terms], axis=1)  # (b, r, 3 + m)
    residual = np.concatenate([t[1] for t in terms], axis=1)
    weight = np.concatenate([t[2] for t in terms], axis=1)
    energy = np.concatenate([t[3] for t in terms], axis=1).sum(axis=1)
    weighted = rows * weight[..., None]
    return _System(
        np.swapaxes(weighted, 1, 2) @ rows, (weighted * residual[..., None]).sum(axis=1), energy
    )


def information(
    template: Template, evidence: Evidence, pose: Float, state: Float, cut: float
) -> Float:
    """What the seen outline tells of one pose (3,) and state (m,), without the prior.

    Unlike the normal equations of a fit, it is only what lies on the template, along its edges:
    where the seen outline leaves the template, as where cloth folds away, it draws a fit but tells
    nothing of where the edge is.

    Returns
    -------
    ndarray of shape (3 + m, 3 + m)
    """
    points, slope = place(template, pose[None], state[None])
    k = template.vertices
    outline, moves = points[:, :k], slope[:, :k]
    step = np.roll(outline[0], -1, axis=0) - outline[0]
    outward = np.column_stack([step[:, 1], -step[:, 0]])
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    edge, along, distance, _ = _nearest_edge(evidence.outline, evidence.normal, outline)
    facing = (evidence.normal * outward[edge[0]]).sum(axis=1)
    rows = [_rows(edge, along, outward[edge], moves)[0] / evidence.sigma[:, None]]
    weight = [_information(distance[0] / evidence.sigma, facing, evidence.weight, cut)]
    samples = samples_per_edge(k)
    edge, along = np.divmod(np.arange(k * samples), samples)[0][None], np.zeros((1, k * samples))
    along[0] = np.tile((np.arange(samples) + 0.5) / samples, k)
    at = outline[0][edge[0]] + along[0][:, None] * step[edge[0]]
    away, slope, seen = look_up(evidence, at)
    facing = (slope * outward[edge[0]]).sum(axis=1)
    sigma = float(np.median(evidence.sigma))
    each = np.linalg.norm(step, axis=1)[edge[0]] / samples * evidence.density
    rows.append(_rows(edge, along, outward[edge], moves)[0] / sigma)
    weight.append(_information(away / sigma, facing, each * seen, cut))
    slopes = np.vstack(rows)
    result: Float = (slopes * np.concatenate(weight)[:, None]).T @ slopes
    return result


def _information(residual: Float, facing: Float, weight: Float, cut: float) -> Float:
    on = (np.abs(residual) < cut) & (facing > ALONG)
    return np.where(on, _geman_mcclure(residual, weight, cut)[0], 0.0)


def _geman_mcclure(residual: Float, weight: Float, cut: Float | float) -> tuple[Float, Float]:
    """Weights of least squares and energies: quadratic for small residuals, level beyond `cut`."""
    soft = 1.0 + (residual / cut) ** 2
    return weight / soft**2, 0.5 * weight * residual**2 / soft


def _nearest_edge(
    query: Float, normal: Float | None, outline: Float
) -> tuple[Int, Float, Float, Float]:
    """Edge, place along it, signed distance and direction from the nearest of (b, k) edges.

    Edges that face another way than the point's normal count as farther: the two sides of a narrow
    gap must not be mistaken for one another.
    """
    step = np.roll(outline, -1, axis=1) - outline  # (b, k, 2)
    length = np.maximum(np.hypot(step[..., 0], step[..., 1]), 1e-9)
    forward = step / length[..., None]
    outward = np.stack([forward[..., 1], -forward[..., 0]], -1)
    across = _project(query, outline, outward)  # (b, n, k)
    ahead = _project(query, outline, forward)
    along = np.clip(ahead, 0.0, length[:, None])
    beyond = ahead - along
    cost = beyond**2 + (1.0 - 1e-3) * across**2  # at a corner: the edge that faces the point
    if normal is not None:
        cost += FACING_M**2 * (1.0 - normal @ np.swapaxes(outward, 1, 2))
    edge = cost.argmin(-1)
    pick = edge[..., None]
    along, beyond, across = (
        np.take_along_axis(values, pick, -1)[..., 0] for values in (along, beyond, across)
    )
    batch = np.arange(len(outline))[:, None]
    distance = np.hypot(beyond, across)
    side = np.where(across < 0.0, -1.0, 1.0)
    share = np.maximum(distance, 1e-9)
    direction = (
        outward[batch, edge] * np.where(distance > 1e-9, np.abs(across) / share, 1.0)[..., None]
    )
    direction += forward[batch, edge] * (side * beyond / share)[..., None]
    return edge, along / length[batch, edge], side * distance, direction


def _project(query: Float, origin: Float, axis: Float) -> Float:
    """(b, n, k) coordinates of (n, 2) points along (b, k) unit axes from their origins."""
    offset = (origin * axis).sum(-1)
    projected: Float = query @ np.swapaxes(axis, 1, 2) - offset[:, None]
    return projected


def _rows(edge: Int, along: Float, direction: Float, moves: Float) -> Float:
    """Derivative (b, n, 3 + m) of the distances from points to the template's edges."""
    batch = np.arange(len(moves))[:, None]
    start, end = moves[batch, edge], moves[batch, (edge + 1) % moves.shape[1]]
    start_part = direction * (along - 1.0)[..., None]
    end_part = direction * -along[..., None]
    result: Float = np.einsum("bni,bnim->bnm", start_part, start) + np.einsum(
        "bni,bnim->bnm", end_part, end
    )
    return result


def _seen_on_template(
    evidence: Evidence, outline: Float, moves: Float, cut: float
) -> tuple[Float, Float, Float, Float]:
    edge, along, distance, direction = _nearest_edge(evidence.outline, evidence.normal, outline)
    residual = distance / evidence.sigma
    own_cut = cut * np.where(residual > 0.0, OUTSIDE, MISSING)
    weight, energy = _geman_mcclure(residual, evidence.weight, own_cut)
    return _rows(edge, along, direction, moves) / evidence.sigma[:, None], residual, weight, energy


def outline_residuals(evidence: Evidence, outline: Float) -> Float:
    """(n,) signed distances of the seen outline from a (k, 2) template's, in sigmas."""
    distance = _nearest_edge(evidence.outline, evidence.normal, outline[None])[2][0]
    residual: Float = distance / evidence.sigma
    return residual


def _inner_in_template(
    evidence: Evidence, outline: Float, moves: Float, outside_cut: float
) -> tuple[Float, Float, Float, Float]:
    edge, along, distance, direction = _nearest_edge(evidence.inner, None, outline)
    residual = np.maximum(distance, 0.0) / evidence.inner_sigma
    weight, energy = _geman_mcclure(residual, evidence.inner_weight, outside_cut)
    rows = _rows(edge, along, direction, moves) / evidence.inner_sigma[:, None]
    return rows * (distance > 0.0)[..., None], residual, weight, energy


def _template_on_seen(
    evidence: Evidence, outline: Float, moves: Float, cut: float
) -> tuple[Float, Float, Float, Float]:
    b, k = outline.shape[:2]
    samples = samples_per_edge(k)
    share: Float = (np.arange(samples) + 0.5) / samples
    after, after_moves = np.roll(outline, -1, axis=1), np.roll(moves, -1, axis=1)
    start: Float = outline[:, :, None]
    place_ = start + share[:, None] * (after[:, :, None] - start)
    length = np.linalg.norm(after - outline, axis=-1)
    distance, slope, seen = look_up(evidence, place_.reshape(b, k * samples, 2))
    slope = slope.reshape(b, k, samples, 2)
    rows = np.einsum("bksi,bkim,s->bksm", slope, moves, 1 - share)
    rows += np.einsum("bksi,bkim,s->bksm", slope, after_moves, share)
    sigma = float(np.median(evidence.sigma))
    each = np.repeat(length / samples, samples, axis=1) * evidence.density
    residual = distance / sigma
    weight, energy = _geman_mcclure(residual, each * seen, MISSING * cut)
    return rows.reshape(b, k * samples, -1) / sigma, residual, weight, energy


def samples_per_edge(edges: int) -> int:
    """Samples of every edge: about 80 in all."""
    return max(4, round(80 / edges))


def refine(
    template: Template,
    evidence: Evidence,
    pose: Float,
    state: Float,
    cuts: tuple[float, ...],
    scale: float = 1.0,
) -> tuple[Float, Float, Float]:
    """Robust Gauss-Newton from (b, 3) poses and (b, m) states; one step for every cut.

    `scale` is how large the errors are, in sigmas of the evidence.

    Returns
    -------
    pose, state : ndarray
        The best of the steps made with the last cut.
    energy : ndarray of shape (b,)
        Theirs.
    """
    limit = np.r_[0.3, 0.08, 0.08, np.full(template.dimensions, 1.0)]
    prior = scale**2 * np.r_[0.0, 0.0, 0.0, np.ones(template.dimensions)]
    damping = np.diag(prior + np.r_[1.0, 1.0, 1.0, np.zeros(template.dimensions)])
    x = np.concatenate([pose, state], axis=1)
    best_x, best = x, np.full(len(x), np.inf)
    for cut in cuts:
        system = linearise(template, evidence, x[:, :3], x[:, 3:], scale * cut)
        energy = system.energy + 0.5 * (prior * x**2).sum(axis=1)
        if cut == cuts[-1]:
            better = energy < best
            best_x, best = np.where(better[:, None], x, best_x), np.where(better, energy, best)
        step = np.linalg.solve(system.hessian + damping, -(system.gradient + prior * x)[..., None])[
            ..., 0
        ]
        over = np.abs(step / limit).max(axis=1, keepdims=True)
        x = x + step / np.maximum(over, 1.0)
    return best_x[:, :3], best_x[:, 3:], best
