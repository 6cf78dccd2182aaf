"""Shortest distances along the cloth between farthest-point landmarks.

A shortest path over links zigzags, and so is a few per cent too long. Where a path stays on one
sheet, its links are laid end to end in one plane, each turned by the bend of the cloth before it
(parallel transport): the straight line between the ends of that chain is the true distance, for
cloth is developable. Only near landmarks are joined in this way; far ones are reached over others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra, shortest_path

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.sheets import Links
from vflatten_ros.core.values import Bool, Float, Int, Progress, no_progress

Float32 = NDArray[np.float32]

PLACED_BY = 10  # landmarks that place a sample
LEAST_INSIDE = 0.4  # of the samples in the largest piece
FIRM_LINKS = 6  # links on the sheet that a landmark needs
LEAST_FIRM = 4  # such samples, to lay anything flat by
GROUP = 16  # landmarks whose paths are laid out together: bounds the memory
MEET_AT = 2  # every such sample is one where paths may meet: laid out, they are straight anyhow
BLOCK = 512  # samples whose nearest landmarks are found together, so that they stay in the cache
STRAIGHT_LEAST = 0.4  # a chain whose ends are nearer than this share of it tells too little


@dataclass(frozen=True, eq=False)
class Distances:
    """Bounds between landmark samples, and from them to the samples around."""

    chosen: Int  # (k,) rows of the landmark samples
    bound_m: Float  # (k, k) along the surface, symmetric
    same_sheet: Bool  # (k, k) near, and joined by a straight path on one sheet
    around: Int  # (n, p) the landmarks nearest to each sample
    around_m: Float  # (n, p) distance from them; inf where there is no path
    around_sheet: Bool  # (n, p) whether by a straight path on one sheet
    inside: Bool  # (n,) samples on the piece that the landmarks cover


@dataclass(frozen=True, eq=False)
class Steps:
    """Directed links, sorted, with the step that each makes in its start's tangent plane."""

    key: Int  # (2m,) start * n + end
    step: NDArray[np.complex128]  # (2m,) length and direction in the frame of the start
    turn: NDArray[np.complex128]  # (2m,) unit: from the frame of the end to that of the start
    rim: Bool  # (2m,)

    def among(self, some: Bool) -> Steps:
        """Steps between some of the (n,) samples, numbered as these alone are."""
        start, end = np.divmod(self.key, len(some))
        kept = np.flatnonzero(some[start] & some[end])
        number = np.cumsum(some) - 1
        key = number[start[kept]] * int(some.sum()) + number[end[kept]]
        return Steps(key, self.step[kept], self.turn[kept], self.rim[kept])


@dataclass(frozen=True, eq=False)
class _Walk:
    """Shortest paths from landmarks, laid out to straighten them."""

    paths: csr_matrix  # (k, n) their lengths, for the samples that are near
    before: NDArray[np.int32]  # sample before each of those on its path, negative at the start
    chosen: Int  # (k,) where the paths start
    steps: Steps
    rim_detour_m: float

    def ends(self, landmark: Int, sample: Int) -> _Ends:
        """Where landmarks lie, seen from samples near them, along the paths between."""
        back, path = np.empty(len(sample), dtype=complex), np.empty(len(sample))
        rims = np.empty(len(sample), dtype=np.int64)
        order = np.argsort(landmark.astype(np.int16), kind="stable")
        firsts = range(0, len(self.chosen), GROUP)
        ends = np.searchsorted(landmark[order], [*firsts, len(self.chosen)])
        for first, low, high in zip(firsts, ends[:-1], ends[1:], strict=True):
            some = order[low:high]
            back[some], path[some], rims[some] = self._laid_out_from(
                first, landmark[some], sample[some]
            )
        return _Ends(back, path, rims)

    def lengths(self, ends: _Ends) -> tuple[Float, Bool]:
        """Lengths of paths, and whether they go along one sheet and straight."""
        straight, path = np.abs(ends.back), ends.path - self.rim_detour_m * ends.rims
        usable = (ends.rims == 0) & (straight > STRAIGHT_LEAST * path)
        moved = usable & (path > 0)
        stretch = float(np.median(path[moved] / straight[moved])) if moved.any() else 1.0
        return np.where(usable, straight, path / stretch), usable

    def _laid_out_from(
        self, first: int, landmark: Int, sample: Int
    ) -> tuple[NDArray[np.complex128], Float32, Int]:
        """The same from GROUP landmarks, each path laid out from that of the sample before it."""
        count = self.paths.shape[1]
        ends = self.paths.indptr[first : first + GROUP + 1]
        known = slice(ends[0], ends[-1])
        row = np.repeat(np.arange(len(ends) - 1), np.diff(ends))
        known_at = row * count + self.paths.indices[known]
        path = np.empty((len(ends) - 1) * count, dtype=np.float32)
        before = np.empty(len(path), dtype=np.int32)
        path[known_at], before[known_at] = self.paths.data[known], self.before[known]
        home = np.arange(len(ends) - 1) * count + self.chosen[first : first + GROUP]
        wanted = (landmark - first) * count + sample
        needed = np.zeros(len(before), dtype=bool)
        needed[wanted] = needed[home] = True
        new = wanted[before[wanted] >= 0]
        while len(new):
            new = new - new % count + before[new]
            new = np.unique(new[~needed[new]])
            needed[new] = True
        needed[home] = False
        place = np.flatnonzero(needed)
        here, there = place % count, before[place].astype(np.int64)
        origin = place - here + there
        link = np.searchsorted(self.steps.key, here * count + there)
        step, turn, rim = self.steps.step[link], self.steps.turn[link], self.steps.rim[link]
        total = np.zeros(len(before), dtype=complex)
        rims = np.zeros(len(before), dtype=np.int64)
        waiting = np.arange(len(place))
        while len(waiting):
            ready = ~needed[origin[waiting]]
            now = waiting[ready]
            at, back = place[now], origin[now]
            total[at] = step[now] + turn[now] * total[back]
            rims[at] = rim[now] + rims[back]
            needed[at] = False
            waiting = waiting[~ready]
        return total[wanted], path[wanted], rims[wanted]


@dataclass(frozen=True, eq=False)
class _Ends:
    """Paths to some samples, laid out in their tangent planes."""

    back: NDArray[np.complex128]  # (m,) from the sample to where its path starts
    path: Float  # (m,) length along the links
    rims: Int  # (m,) rims on the way

    def part(self, which: slice) -> _Ends:
        return _Ends(self.back[which], self.path[which], self.rims[which])

    def across(self, other: _Ends) -> _Ends:
        """Paths from one start to another, by the sample where both meet."""
        return _Ends(self.back - other.back, self.path + other.path, self.rims + other.rims)


def surface_distances(
    xyz: Float,
    normal: Float,
    links: Links,
    passable: Bool,
    config: RotationConfig,
    progress: Progress = no_progress,
    steps: Steps | None = None,
) -> Distances:
    """Distances between landmarks of the largest connected piece.

    Parameters
    ----------
    xyz, normal : ndarray of shape (n, 3)
        Samples of the surface and their outward normals.
    links : Links
        Between samples.
    passable : ndarray of shape (n,)
        Samples that paths may go through; they may end at any.
    config : RotationConfig
    progress : Progress
    steps : Steps, optional
        Result of link_steps for these links, or for more.

    Raises
    ------
    DisconnectedSurface
        Fewer than LEAST_INSIDE of the passable samples hang together, or hardly any firmly.
    """
    progress("distances", 0.0)
    count = len(xyz)
    a, b, length_m, rim = links.a, links.b, links.length_m, links.rim
    piece = pieces(a, b, passable)
    inside = passable & (piece == np.bincount(piece[passable]).argmax())
    if inside.sum() < LEAST_INSIDE * passable.sum():
        raise DisconnectedSurface(
            f"the surface falls into pieces, the largest has {inside.sum()} of "
            f"{passable.sum()} samples; take more views or raise rotation.link_m"
        )
    start, end = np.r_[a, b], np.r_[b, a]
    leaving = passable[start]
    graph = csr_matrix(
        (np.r_[length_m, length_m][leaving], (start[leaving], end[leaving])), shape=(count, count)
    )
    # the farthest samples would be strays, which hang on the rest by a link round a rim
    both = passable[a] & passable[b] & ~rim
    degree = np.bincount(np.r_[a[both], b[both]], minlength=count)
    firm = inside & (degree >= FIRM_LINKS)
    if firm.sum() < LEAST_FIRM:
        raise DisconnectedSurface(
            f"{firm.sum()} of {inside.sum()} samples hang on others on all sides; take more views "
            "or raise rotation.link_m"
        )
    inside[end[inside[start]]] = True
    link_m = float(length_m.max())
    reach_m = (config.local_m + link_m) / 2  # two paths meet half way
    chosen, paths, before = _landmarks(graph, firm, config.landmarks, reach_m, progress)
    progress("distances", 0.5)
    meet = passable & (np.arange(count) % MEET_AT == 0)
    one, other, middle, _ = _meetings(paths, meet, config.local_m, link_m)
    around = _nearest(paths, min(PLACED_BY, len(chosen) - 1))
    reached = around >= 0
    progress("distances", 0.6)
    steps = steps or link_steps(xyz, normal, links)
    walk = _Walk(paths, before, chosen, steps, config.rim_detour_m)
    ends = walk.ends(
        np.r_[one, other, around[reached]], np.r_[middle, middle, np.nonzero(reached)[0]]
    )
    met = len(one)
    length, usable = walk.lengths(ends.part(slice(met)).across(ends.part(slice(met, 2 * met))))
    local = np.full((len(chosen), len(chosen)), np.inf)
    sheet = np.zeros(local.shape, dtype=bool)
    local[one, other] = local[other, one] = length
    sheet[one, other] = sheet[other, one] = usable
    around_m = np.full(around.shape, np.inf)
    around_sheet = np.zeros(around.shape, dtype=bool)
    around_m[reached], around_sheet[reached] = walk.lengths(ends.part(slice(2 * met, None)))
    # symmetric: "directed" is the same, and does not look at each pair twice
    bound = shortest_path(np.where(np.isfinite(local), local, 0.0), method="D", directed=True)
    if not np.isfinite(bound).all():
        raise DisconnectedSurface(
            "landmarks farther apart than rotation.local_m; raise it or rotation.landmarks"
        )
    progress("distances", 0.7)
    return Distances(
        chosen,
        (bound + bound.T) / 2,
        sheet & (local < 1.05 * bound + 0.003),
        np.maximum(around, 0),
        around_m,
        around_sheet,
        inside,
    )


def pieces(a: Int, b: Int, passable: Bool) -> Int:
    """Number (n,) of the piece that each passable sample hangs together with; others are alone."""
    both = passable[a] & passable[b]
    ones = np.ones(int(both.sum()), dtype=bool)
    graph = csr_matrix((ones, (a[both], b[both])), shape=(len(passable), len(passable)))
    label: Int = connected_components(graph, directed=False)[1]
    return label


def largest_pieces(links: Links, passable: Bool, least: int) -> list[Bool]:
    """Masks (n,) of the pieces with more samples than `least`, largest first."""
    piece = pieces(links.a, links.b, passable)
    size = np.bincount(piece[passable], minlength=1)
    order = np.argsort(-size, kind="stable")
    return [passable & (piece == k) for k in order if size[k] > least]


def _nearest(paths: csr_matrix, count: int) -> Int:
    """(n, count) landmarks nearest to each sample; -1 where fewer are near."""
    by_sample = paths.tocsc()
    nearest = np.empty((by_sample.shape[1], count), dtype=np.int64)
    for start in range(0, len(nearest), BLOCK):
        ends = by_sample.indptr[start : start + BLOCK + 1]
        known = slice(ends[0], ends[-1])
        path = np.full((len(ends) - 1, by_sample.shape[0]), np.inf, dtype=np.float32)
        row = np.repeat(np.arange(len(path)), np.diff(ends))
        path[row, by_sample.indices[known]] = by_sample.data[known]
        first = np.argpartition(path, count, axis=1)[:, :count]
        reached = np.isfinite(np.take_along_axis(path, first, axis=1))
        nearest[start : start + BLOCK] = np.where(reached, first, -1)
    return nearest


def _meetings(
    paths: csr_matrix, meet: Bool, most_m: float, link_m: float
) -> tuple[Int, Int, Int, Float32]:
    """Pairs of landmarks that a path joins, the sample half way where theirs meet, its length.

    Parameters
    ----------
    paths : csr_matrix of shape (k, n)
        Lengths from the landmarks to samples within half of what is asked, and a link more.
    meet : ndarray of shape (n,)
        Samples where paths may meet.
    most_m : float
        Longest path.
    link_m : float
        Longest link: of half way, a sample is off by half of it at most.
    """
    count, by_sample = paths.shape[0], paths.tocsc()
    least = np.full(count * count, most_m, dtype=np.float32)
    middle = np.full(count * count, -1)
    for start in range(0, len(meet), BLOCK):
        ends = by_sample.indptr[start : start + BLOCK + 1]
        known = slice(ends[0], ends[-1])
        sample = np.repeat(np.arange(start, start + len(ends) - 1), np.diff(ends))
        length, landmark = by_sample.data[known], by_sample.indices[known]
        through = meet[sample]
        sample, length, landmark = sample[through], length[through], landmark[through]
        key = sample * (2 * most_m) + length
        order = np.argsort(key, kind="stable")
        key, sample, length, landmark = (x[order] for x in (key, sample, length, landmark))
        after = np.searchsorted(key, key + link_m, side="right") - np.arange(len(key)) - 1
        one = np.repeat(np.arange(len(key)), after)
        other = one + 1 + np.arange(len(one)) - np.repeat(np.cumsum(after) - after, after)
        i, j = landmark[one].astype(np.int64), landmark[other].astype(np.int64)
        pair = np.minimum(i, j) * count + np.maximum(i, j)
        path = length[one] + length[other]
        np.minimum.at(least, pair, path)
        best = path == least[pair]
        middle[pair[best]] = sample[one[best]]
    pair = np.flatnonzero(middle >= 0)
    return pair // count, pair % count, middle[pair], least[pair]


def _landmarks(
    graph: csr_matrix, firm: Bool, most: int, reach_m: float, progress: Progress
) -> tuple[Int, csr_matrix, NDArray[np.int32]]:
    """Farthest-point landmarks, their distances to the samples near them, and the paths there."""
    most = min(most, int(firm.sum()))
    nearest = np.where(firm, np.inf, -1.0)
    chosen = np.empty(most, dtype=np.int64)
    length: list[Float32] = []
    before: list[NDArray[np.int32]] = []
    near: list[NDArray[np.int32]] = []
    for k in range(most):
        if k % GROUP == 0:
            progress("distances", 0.1 + 0.4 * k / most)
        chosen[k] = nearest.argmax()
        row, paths = dijkstra(graph, indices=chosen[k], limit=reach_m, return_predecessors=True)
        near.append(np.flatnonzero(np.isfinite(row)).astype(np.int32))
        length.append(row[near[k]].astype(np.float32))
        before.append(paths[near[k]])
        np.minimum(nearest, row, out=nearest)
    ends = np.cumsum([0, *map(len, near)])
    matrix = (np.concatenate(length), np.concatenate(near), ends)
    return chosen, csr_matrix(matrix, shape=(most, len(firm))), np.concatenate(before)


def link_steps(xyz: Float, normal: Float, links: Links) -> Steps:
    """The step that each link makes, either way, in the tangent plane of its start."""
    start, end = np.r_[links.a, links.b], np.r_[links.b, links.a]
    order = np.argsort(start * len(xyz) + end)
    start, end = start[order], end[order]
    least = np.abs(normal).argmin(1)
    e1 = np.cross(normal, np.eye(3)[least])
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    e2 = np.cross(normal, e1)
    chord = xyz[end] - xyz[start]
    leaving = (chord * e1[start]).sum(1) + 1j * (chord * e2[start]).sum(1)
    arriving = (chord * e1[end]).sum(1) + 1j * (chord * e2[end]).sum(1)
    leaving /= np.maximum(np.abs(leaving), 1e-12)
    arriving /= np.maximum(np.abs(arriving), 1e-12)
    return Steps(
        key=start * len(xyz) + end,
        step=np.r_[links.length_m, links.length_m][order] * leaving,
        turn=leaving * arriving.conj(),
        rim=np.r_[links.rim, links.rim][order],
    )
