"""The surface cut in two where it hangs together by the fewest links, for its size.

Two parts of a garment that hang against each other may be joined by links over some centimetres
only, where one's edge lies flush on the other. Nothing there may look doubtful. But parts of a
garment hang together over a hand's breadth or more, unless what joins them is hidden in a fold:
what hangs by less is cut off, and placed as a category has it.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix, diags, identity
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh, splu

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.grouping import Grouped, each_flat
from vflatten_ros.core.rotation import Surface
from vflatten_ros.core.sheets import Links
from vflatten_ros.core.values import Float, Int, Progress, no_progress

LEAST = 0.1  # share of the samples on either side
MODES = 3  # of the surface, along each of which it is cut where it is narrowest
SHIFT = 1e-3  # of the eigenvalues, for a matrix that can be factored
LINKS_ACROSS = 6.0  # a line through a sheet, in each spacing of the samples
WIDEST_M = 0.05  # that is cut


def cut_at_neck(
    surface: Surface, config: RotationConfig, progress: Progress = no_progress
) -> Grouped:
    """The two parts that hang together by least, larger first.

    Parameters
    ----------
    surface : Surface
    config : RotationConfig
    progress : Progress

    Raises
    ------
    DisconnectedSurface
        They hang together by too much, or not at all.
    """
    links, count = surface.links, len(surface.samples.xyz)
    part, across = narrowest(links, count)
    width_m = across / LINKS_ACROSS * config.spacing_m
    if not 0.0 < width_m < WIDEST_M:
        raise DisconnectedSurface(
            f"the surface is {100 * width_m:.0f} cm wide where it is narrowest: nothing to cut"
        )
    masks = tuple(part == k for k in np.argsort(-np.bincount(part, minlength=3)[1:]) + 1)
    kept = links.part(part[links.a] == part[links.b])
    places = np.full((count, 2), np.nan)
    flat = each_flat(surface, kept, masks, config, progress)
    for mask, uv in zip(masks, flat, strict=True):
        places[mask] = uv[mask]
    return Grouped(surface, kept, masks, places)


def narrowest(links: Links, count: int) -> tuple[Int, int]:
    """Where the largest part that hangs together does so by the fewest links, for its size.

    Normalized cuts (Shi and Malik 2000), along the slowest modes of its graph.

    Parameters
    ----------
    links : Links
        Between samples.
    count : int
        How many samples there are.

    Returns
    -------
    part : ndarray of shape (count,)
        1 or 2, and 0 for what does not hang together with these.
    across : int
        Links between the two; 0: it cannot be cut.
    """
    ends = np.r_[links.a, links.b], np.r_[links.b, links.a]
    graph = csr_matrix((np.ones(2 * len(links.a)), ends), shape=(count, count))
    piece = connected_components(graph, directed=False)[1]
    rows = np.flatnonzero(piece == np.bincount(piece).argmax())
    graph = graph[rows][:, rows].tocoo()
    part, best = np.zeros(count, dtype=np.int64), 0
    if len(rows) < 10 * MODES:
        return part, best
    try:
        modes = _modes(graph.tocsr())
    except ArpackError:  # its modes are not told apart
        return part, best
    for mode in modes:
        order = np.argsort(mode, kind="stable")
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        one, other = rank[graph.row], rank[graph.col]
        up = one < other
        opened = np.bincount(one[up], minlength=len(order))
        closed = np.bincount(other[up], minlength=len(order))
        across = np.cumsum(opened - closed)[:-1]  # links over the gap after each
        smaller = np.minimum(np.arange(1, len(order)), np.arange(len(order) - 1, 0, -1))
        cost = np.where(smaller > LEAST * count, across / smaller, np.inf)
        at = int(cost.argmin())
        if np.isfinite(cost[at]) and across[at] > 0 and (not best or across[at] < best):
            best = int(across[at])
            part[rows] = np.where(rank <= at, 1, 2)
    return part, best


def _modes(graph: csr_matrix) -> Float:
    """(MODES, n) slowest modes of a connected graph, without the constant one."""
    root = np.sqrt(np.asarray(graph.sum(axis=1)).ravel())
    scale = diags(1.0 / root)
    laplacian = (identity(len(root)) - scale @ graph @ scale).tocsc()
    shifted = (laplacian + SHIFT * identity(len(root))).tocsc()
    symmetric = {"SymmetricMode": True}  # half the time and memory
    factors = splu(shifted, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    inverse = LinearOperator(shifted.shape, factors.solve, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=len(root))  # the same each time
    values, vectors = eigsh(laplacian, MODES + 1, sigma=-SHIFT, v0=start, OPinv=inverse, tol=1e-6)
    slow = np.argsort(values)[1:]
    modes: Float = (vectors[:, slow] / root[:, None]).T
    return modes
