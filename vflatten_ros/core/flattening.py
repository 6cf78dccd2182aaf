"""Distances along the cloth to places in the plane (paper, section 2.2, eqs. 8 to 10)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from vflatten_ros.core.arrays import as_points
from vflatten_ros.core.config import FlatteningConfig
from vflatten_ros.core.errors import DisconnectedSurface, InvalidInput
from vflatten_ros.core.values import DistanceNetwork, Float, Progress, no_progress

TINY_M = 1e-9  # two points nearer than this have no direction


def flatten(
    network: DistanceNetwork,
    start_uv: Float,
    config: FlatteningConfig,
    progress: Progress = no_progress,
) -> tuple[Float, Float]:
    """Places in the plane whose distances agree with those along the cloth.

    Parameters
    ----------
    network : DistanceNetwork
        Distances between the points; pairs that are left out are free (B = 0 in eq. 8).
    start_uv : ndarray of shape (n, 2)
        First guess, metres. The result is the nearest good one: it is not mirrored or turned.
    config : FlatteningConfig
        'springs': every distance counts alike, as the paper has it. 'majorization': distances count
        by their standard deviation and lose their say where they contradict the others.

    Returns
    -------
    uv : ndarray of shape (n, 2)
    stress : ndarray of shape (n,)
        Root mean square misfit of each point's distances, metres.

    Raises
    ------
    InvalidInput
        Fewer points in `start_uv` than the network names, or distances that are not finite or < 0.
    DisconnectedSurface
        The distances leave the points in several pieces.
    """
    start = as_points(start_uv, "start_uv", 2)
    _check(network, len(start))
    solve = _springs if config.solver == "springs" else _majorize
    uv = solve(network, _spread(start), config, progress)
    return uv, _stress(network, uv)


def _check(network: DistanceNetwork, count: int) -> None:
    if len(network.i) and max(network.i.max(), network.j.max()) >= count:
        raise InvalidInput(f"start_uv: {count} points, but the distances name more")
    if not np.isfinite(network.distance_m).all() or (network.distance_m < 0).any():
        raise InvalidInput("distances: expected finite metres, >= 0")
    graph = coo_matrix((np.ones(len(network.i)), (network.i, network.j)), shape=(count, count))
    pieces, label = connected_components(graph, directed=False)
    if pieces > 1:
        largest = np.bincount(label).max()
        raise DisconnectedSurface(
            f"the distances leave {pieces} pieces, the largest of {largest} of {count} points; "
            "give corresponding points that join them"
        )


def _spread(start: Float) -> Float:
    """Move coinciding points a little apart: they would never part by themselves."""
    turn = np.arange(len(start)) * 2.399963  # golden angle
    return start + 1e-6 * np.column_stack([np.cos(turn), np.sin(turn)])


def _lengths(network: DistanceNetwork, uv: Float) -> tuple[Float, Float]:
    """(m, 2) vectors from i to j and their (m,) lengths."""
    step = uv[network.j] - uv[network.i]
    return step, np.maximum(np.linalg.norm(step, axis=1), TINY_M)


def _wanted(network: DistanceNetwork, length: Float) -> Float:
    """Distance that each pair should have; pairs within an upper bound are content as they are."""
    return np.where(network.bound, np.minimum(network.distance_m, length), network.distance_m)


def _springs(
    network: DistanceNetwork, uv: Float, config: FlatteningConfig, progress: Progress
) -> Float:
    """Points move along the mean force of their springs until all forces balance."""
    count = len(uv)
    springs = np.bincount(network.i, minlength=count) + np.bincount(network.j, minlength=count)
    for step in range(config.spring_steps):
        vector, length = _lengths(network, uv)
        pull = vector * (1.0 - _wanted(network, length) / length)[:, None]
        force = np.column_stack(
            [
                np.bincount(network.i, pull[:, k], count)
                - np.bincount(network.j, pull[:, k], count)
                for k in (0, 1)
            ]
        )
        move = force / np.maximum(springs, 1)[:, None]
        uv = uv + move
        if step % 50 == 0:
            progress("flattening", step / config.spring_steps)
        if np.abs(move).max() < config.tolerance_m:
            break
    return uv


def _majorize(
    network: DistanceNetwork, uv: Float, config: FlatteningConfig, progress: Progress
) -> Float:
    """Stress majorisation (de Leeuw 1977) in rounds: weights are fixed, factored once a round."""
    count = len(uv)
    for done in range(config.rounds):
        progress("flattening", done / config.rounds)
        weight = _trust(network, uv, config, done)
        solver = _factored(network, weight, count)
        before = uv
        for _ in range(config.inner_steps):
            vector, length = _lengths(network, uv)
            ask = vector * (weight * _wanted(network, length) / length)[:, None]
            right = np.column_stack(
                [
                    np.bincount(network.j, ask[:, k], count)
                    - np.bincount(network.i, ask[:, k], count)
                    for k in (0, 1)
                ]
            )
            solved = solver.solve(right)
            last, uv = uv, solved + (uv - solved).mean(axis=0)
            if np.abs(uv - last).max() < config.tolerance_m:
                break
        if done > 2 and np.abs(uv - before).max() < 10 * config.tolerance_m:
            break
    return uv


def _trust(network: DistanceNetwork, uv: Float, config: FlatteningConfig, done: int) -> Float:
    """Weights by standard deviation and misfit (Geman-McClure); forgiving at first."""
    _, length = _lengths(network, uv)
    off = (length - _wanted(network, length)) / network.sigma_m
    cut = config.robust_sigmas * max(1.0, 8.0 / 2.0**done)
    weight = 1.0 / network.sigma_m**2
    result: Float = weight / weight.max() / (1.0 + (off / cut) ** 2) ** 2
    return result


def _factored(network: DistanceNetwork, weight: Float, count: int) -> SuperLU:
    i, j = network.i, network.j
    values = np.concatenate([-weight, -weight, weight, weight])
    rows, cols = np.concatenate([i, j, i, j]), np.concatenate([j, i, i, j])
    # a little on the diagonal takes the freedom to shift, and loose ends that lost all weight
    rows, cols = np.r_[rows, np.arange(count)], np.r_[cols, np.arange(count)]
    values = np.r_[values, np.full(count, 1e-9)]
    laplacian = coo_matrix((values, (rows, cols)), shape=(count, count)).tocsc()
    return splu(
        laplacian,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _stress(network: DistanceNetwork, uv: Float) -> Float:
    _, length = _lengths(network, uv)
    square = (length - _wanted(network, length)) ** 2
    count = len(uv)
    total = np.bincount(network.i, square, count) + np.bincount(network.j, square, count)
    pairs = np.bincount(network.i, minlength=count) + np.bincount(network.j, minlength=count)
    stress: Float = np.sqrt(total / np.maximum(pairs, 1))
    return stress
