"""A slit up the middle of an item that looks as if it were of one piece: between legs that touch.

Where the legs of shorts hang against each other, some links lead across from one to the other, and
what is laid flat then looks like a skirt of the same size. But in a straight line up the middle,
from the hem, lie the folds at which each leg's front hangs together with its back, and places of
which the two sides do not hang together. A skirt has no more of these there than beside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.sheets import Links
from vflatten_ros.core.slits import torn
from vflatten_ros.core.values import Bool, Float, Int

EVIDENT, SCALE = (
    15.0,
    2.0,
)  # log odds of a slit against what lies beside, as likely as not: the best
# of many lines; and what of these is worth one
LEAST = 0.02  # probability that is told
SHORTEST_M = 0.05
LONGEST = 0.65  # of the item
OFF_MIDDLE = 0.07  # of the item's width
LEANS = np.radians([0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6, -6])  # from the axis of the item
STEP, ACROSS, REACH = 2.0, 0.5, 2  # along and across the line, in spacings; cells to either side
BESIDE = (6, 20)  # cells from the line, between which it is compared
ASIDE = BESIDE[1] + REACH
IN_SLIT, ELSEWHERE = 0.7, 0.03  # share of the steps along a slit with such a sign; least beside
BY_FACE = 0.5  # weight of what is torn on one face, which the folds tell in part
ROUNDS = 3  # of drawing the line through the signs beside it
BANK = 3.0  # how wide a bank is, in spacings
OPEN_M = 0.02  # between the banks, where the slit is open and no cloth is taken to fill it
FEW = 5  # nearest pairs across the slit in a step along it
FINE_M = 0.002  # between points along a slit

Signs = tuple[Float, Float]  # points that are one, and all samples at which one could be


@dataclass(frozen=True, eq=False)
class Slit:
    """Where a slit may lead into the middle of an item."""

    line: Float  # (2, 2) its mouth and its end, m
    probability: float


@dataclass(frozen=True, eq=False)
class Axis:
    """From an end of an item, up its middle."""

    start: Float  # (2,) m
    ahead: Float  # (2,) unit vector
    length_m: float
    width_m: float


@dataclass(frozen=True, eq=False)
class Banks:
    """Samples along both sides of a slit."""

    side: Int  # (n,) -1 or 1, 0: not along it
    along_m: Float  # (n,) from its mouth

    def of(self, row: Int) -> Banks:
        """The same for some samples."""
        return Banks(self.side[row], self.along_m[row])


def axes_of(outline: Float, pose: Float, across: bool = False) -> tuple[Axis, ...]:
    """The axis of symmetry of a category as it fits an item, from either end.

    Parameters
    ----------
    outline : ndarray of shape (k, 2)
        Of the category, m.
    pose : ndarray of shape (3,)
        Rotation, rad, and shift, m, of the category.
    across : bool
        Whether the line across its middle is one, too, as a rectangle's is.
    """
    angle, origin = float(pose[0]), pose[1:]
    right, ahead = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    along, beside = (outline - origin) @ ahead, (outline - origin) @ right
    low, high = float(along.min()), float(along.max())
    length_m, width_m = high - low, float(np.ptp(beside))
    from_low = Axis(origin + low * ahead, ahead, length_m, width_m)
    from_high = Axis(origin + high * ahead, -ahead, length_m, width_m)
    if not across:
        return from_low, from_high
    middle = origin + (low + high) / 2 * ahead
    from_left = Axis(middle + beside.min() * right, right, width_m, length_m)
    from_right = Axis(middle + beside.max() * right, -right, width_m, length_m)
    return from_low, from_high, from_left, from_right


def middle_slit(
    uv: Float,
    side: Float,
    edge: Int,
    links: Links,
    axes: Sequence[Axis],
    config: RotationConfig,
) -> Slit | None:
    """Where a slit may lead into the middle of an item; None: hardly any does.

    Parameters
    ----------
    uv, side, edge, links, config
        As for slits.
    axes : sequence of Axis
        Along which to look.

    Returns
    -------
    Slit or None
    """
    a, b = links.a[links.rim], links.b[links.rim]
    folded = side[a] * side[b] < 0
    folds = (uv[a] + uv[b])[folded] / 2, uv
    i, j = torn(uv, side, edge, links, config)
    tears = [((uv[i] + uv[j])[side[i] == up] / 2, uv[side == up]) for up in (-1.0, 1.0)]
    found = [_likeliest(folds, tears, axis, config.spacing_m) for axis in axes]
    odds, line = max(found, key=lambda one: one[0])
    probability = float(1.0 / (1.0 + np.exp((EVIDENT - odds) / SCALE)))
    if probability < LEAST:
        return None
    signs = np.vstack([folds[0], *(face[0] for face in tears)])
    return Slit(_through(signs, line, REACH * ACROSS * config.spacing_m), probability)


def banks_of(uv: Float, slit: Float, config: RotationConfig) -> Banks:
    """The samples along a slit.

    Parameters
    ----------
    uv : ndarray of shape (n, 2)
        Places of the samples, m.
    slit : ndarray of shape (2, 2)
        Its mouth and its end, m.
    config : RotationConfig
    """
    mouth, end = slit
    length_m = float(np.linalg.norm(end - mouth))
    ahead = (end - mouth) / length_m
    along, across = (uv - mouth) @ ahead, (uv - mouth) @ np.array([ahead[1], -ahead[0]])
    bank_m = BANK * config.spacing_m
    beside = (np.abs(across) < bank_m) & (along > -bank_m) & (along < length_m)
    return Banks(np.where(beside, np.where(across < 0, -1, 1), 0), along)


def between(uv: Float, banks: Banks, config: RotationConfig) -> Float:
    """Points in a row along a slit, midway between its banks wherever they lie now.

    Parameters
    ----------
    uv : ndarray of shape (n, 2)
        Places of the samples, m.
    banks : Banks
        Of these samples.
    config : RotationConfig

    Returns
    -------
    ndarray of shape (m, 2)
        From beyond its mouth inward, m; none where no two banks are near each other.
    """
    step = np.floor(banks.along_m / (STEP * config.spacing_m)).astype(np.int64)
    middle = []
    for k in np.unique(step[banks.side != 0]):
        left, right = (uv[(banks.side == one) & (step == k)] for one in (-1, 1))
        if len(left) and len(right):
            away, near = cKDTree(right).query(left)
            if away.min() < OPEN_M:
                some = np.argsort(away, kind="stable")[:FEW]
                middle.append(np.median((left[some] + right[near[some]]) / 2, axis=0))
    if len(middle) < 2:
        return np.zeros((0, 2))
    at = np.array(middle)
    at = np.vstack([2 * at[0] - at[1], at])  # out of the mouth
    size = np.linalg.norm(np.diff(at, axis=0), axis=1)
    share = [np.linspace(0, 1, max(2, int(np.ceil(s / FINE_M)) + 1))[:-1, None] for s in size]
    return np.vstack([*(p + t * (q - p) for p, q, t in zip(at, at[1:], share)), at[-1:]])


def _likeliest(
    folds: Signs, tears: Sequence[Signs], axis: Axis, spacing_m: float
) -> tuple[float, Float]:
    """Log odds of the likeliest slit along an axis, and its mouth and end."""
    step_m, cell_m = STEP * spacing_m, ACROSS * spacing_m
    steps = int(LONGEST * axis.length_m / step_m)
    first = max(1, int(SHORTEST_M / step_m) - 1)
    middle = int(OFF_MIDDLE * axis.width_m / cell_m)
    best = -np.inf, np.zeros((0, 2))
    if steps <= first:
        return best
    right = np.array([axis.ahead[1], -axis.ahead[0]])
    for lean in LEANS:
        ahead = np.cos(lean) * axis.ahead + np.sin(lean) * right
        across = np.array([ahead[1], -ahead[0]])
        to_cells = np.column_stack([ahead / step_m, across / cell_m])

        def told(signs: Signs, to_cells: Float = to_cells) -> Float:
            there, seen = (
                _counted((at - axis.start) @ to_cells, steps, middle + ASIDE) > 0 for at in signs
            )
            return _log_odds(there, seen)

        odds = told(folds) + BY_FACE * sum(np.maximum(told(face), 0.0) for face in tears)
        k, column = np.unravel_index(int(odds[first:].argmax()), odds[first:].shape)
        if odds[first + k, column] > best[0]:
            mouth = axis.start + (column - middle) * cell_m * across
            end = mouth + (first + k + 1) * step_m * ahead
            best = float(odds[first + k, column]), np.stack([mouth, end])
    return best


def _through(signs: Float, line: Float, reach_m: float) -> Float:
    """The straight line through signs (m, 2) that lie along one (2, 2), as long as it."""
    for _ in range(ROUNDS):
        mouth, end = line
        length_m = float(np.linalg.norm(end - mouth))
        ahead = (end - mouth) / length_m
        right = np.array([ahead[1], -ahead[0]])
        along, across = (signs - mouth) @ ahead, (signs - mouth) @ right
        on = (np.abs(across) <= reach_m) & (along >= 0) & (along <= length_m)
        slope, offset = np.polyfit(along[on], across[on], 1)
        line = line + np.outer([offset, offset + slope * length_m], right)
    return line


def _counted(at: Float, steps: int, aside: int) -> Int:
    """How many points lie in each step along a line, a few cells wide, by the cell of the line.

    Parameters
    ----------
    at : ndarray of shape (n, 2)
        Steps and cells from the mouth.
    aside : int
        Cells to either side.
    """
    row, column = np.floor(at + 0.5).astype(np.int64).T
    inside = (row >= 0) & (row < steps) & (np.abs(column) <= aside)
    cell = row[inside] * (2 * aside + 1) + column[inside] + aside
    count = np.bincount(cell, minlength=steps * (2 * aside + 1))
    return _beside(count.reshape(steps, -1), -REACH, REACH)


def _beside(count: Int, low: int, high: int) -> Int:
    """Sum over the cells from `low` to `high` from each."""
    total = np.cumsum(np.pad(count, ((0, 0), (1, 0))), axis=1)
    at, last = np.arange(count.shape[1]), count.shape[1]
    result: Int = total[:, np.clip(at + high + 1, 0, last)] - total[:, np.clip(at + low, 0, last)]
    return result


def _log_odds(there: Bool, seen: Bool) -> Float:
    """Of a slit from its mouth to each step, for each of the middle cells, against beside."""
    seen = seen | there

    def so_far(where: Bool) -> Int:
        count, (near, far) = where.astype(np.int64), BESIDE
        total: Int = np.cumsum(_beside(count, -far, -near) + _beside(count, near, far), axis=0)
        return total

    elsewhere = np.clip((so_far(there) + 1.0) / (so_far(seen) + 4.0), ELSEWHERE, IN_SLIT - 0.01)
    with_sign, looked = np.cumsum(there, axis=0), np.cumsum(seen, axis=0)
    told = with_sign * np.log(IN_SLIT / elsewhere)
    told += (looked - with_sign) * np.log((1.0 - IN_SLIT) / (1.0 - elsewhere))
    result: Float = told[:, ASIDE:-ASIDE]
    return result
