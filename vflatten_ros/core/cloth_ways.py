"""How far it is along the cloth between any two places of an item that lies flat.

Front and back hang together along the seams and folds of its outline, and apart along its openings.
A straight way leads from place to place on one side, if it stays on the cloth, and over a seam to
the other side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.values import Bool, Float, Int

Complex = NDArray[np.complex128]

CELL_M = 0.02  # of the grid of places
SEAM_M = 0.06  # between points of a seam over which ways lead
BESIDE_M = 0.01  # how far beyond the outline a way may lead: it is known no better
ROUND_M = 0.04  # how far no way leads round the end of a leg that lies beside another
ALONG = (0.25, 0.5, 0.75)  # where on a straight way it is asked whether it is on the cloth
FLAT = 0.1  # twice the cosine of half the angle of a corner that is none
FAR = 1e3  # m, where no way is known


@dataclass(frozen=True, eq=False)
class ClothWays:
    """Ways on an item of one outline."""

    low: Float  # (2,) of the grid
    number: Int  # (rows, cols) of the cells on the item; others are -1
    cells: Complex  # (c,) their middles
    signed_m: Float  # (rows, cols) distance to the outline, inside negative
    pockets: Complex  # (p, 2) from inner corners outward: no cloth goes across
    seam: Complex  # (s,) points where front and back hang together
    over_m: Float  # (c, s) straight ways from the cells to these
    single_sheet: bool  # what lies on the other side is the same cloth

    def at(self, z: Complex) -> Int:
        """Cells of places; -1 beyond the item."""
        cell: Int = self.number[self._nearest(z)]  # at the grid's border there is no item
        return cell

    def to(self, z: Complex) -> Float:
        """Lengths of ways from every cell to some places.

        Parameters
        ----------
        z : ndarray of shape (l,)

        Returns
        -------
        ndarray of shape (2, c + 1, l)
            On the same side, and on the other; FAR where no way is known, and all of the last row,
            which is that of no cell. The shortest way along the cloth is no longer, but for a cell.
        """
        ways = np.full((2, len(self.cells) + 1, len(z)), FAR)
        ways[0, :-1] = self._straight(self.cells, z)
        if self.single_sheet:
            ways[1] = ways[0]
            return ways
        onward = self._straight(self.seam, z)
        for k in range(len(self.seam)):
            np.minimum(ways[1, :-1], self.over_m[:, k, None] + onward[k], out=ways[1, :-1])
        return ways

    def _straight(self, start: Complex, end: Complex) -> Float:
        """(n, m) lengths of straight ways, FAR where one leaves the cloth."""
        away: Float = np.abs(start[:, None] - end)
        for share in ALONG:
            between = self._nearest((1 - share) * start[:, None] + share * end)
            away[self.signed_m[between] > BESIDE_M] = FAR
        for inner, outer in self.pockets:
            away[_crossing(start[:, None], end, inner, outer)] = FAR
            away[_from_line_m(start, inner, outer) < BESIDE_M] = FAR  # of which leg it is
            away[:, _from_line_m(end, inner, outer) < BESIDE_M] = FAR  # is not certain
        return away

    def _nearest(self, z: Complex) -> tuple[Int, Int]:
        """Rows and columns of the grid nearest to places."""
        rows, cols = self.number.shape
        col = np.rint((z.real - self.low[0]) / CELL_M).astype(np.int64).clip(0, cols - 1)
        row = np.rint((z.imag - self.low[1]) / CELL_M).astype(np.int64).clip(0, rows - 1)
        return row, col


def cloth_ways(outline: Float, seam: Bool, single_sheet: bool) -> ClothWays:
    """Ways on an item that lies flat.

    Parameters
    ----------
    outline : ndarray of shape (k, 2)
        Corners, counter-clockwise, m.
    seam : ndarray of shape (k,)
        Whether front and back hang together along the edge from each corner to the next.
    single_sheet : bool
        Both sides are of one sheet, as a towel's.
    """
    low, high = outline.min(axis=0) - 2 * CELL_M, outline.max(axis=0) + 2 * CELL_M
    cols, rows = np.ceil((high - low) / CELL_M).astype(int) + 1
    body = np.zeros((rows, cols), np.uint8)
    corners = np.rint((outline - low) / CELL_M * 16).astype(np.int32)
    cv2.fillPoly(body, [corners], (1,), shift=4)
    number = np.full((rows, cols), -1, dtype=np.int64)
    number[body > 0] = np.arange(int(body.sum()))
    row, col = np.nonzero(body)
    z = outline @ np.array([1, 1j])
    ways = ClothWays(
        low,
        number,
        low @ np.array([1, 1j]) + CELL_M * (col + 1j * row),
        _depth_m(body == 0) - _depth_m(body > 0),
        _pockets(z),
        _spread(z, seam),
        np.zeros((0, 0)),
        single_sheet,
    )
    return replace(ways, over_m=ways._straight(ways.cells, ways.seam))


def _depth_m(image: Bool) -> Float:
    depth: Float = (
        cv2.distanceTransform(image.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5).astype(float)
        * CELL_M
    )
    return depth


def _spread(z: Complex, seam: Bool) -> Complex:
    """Points along the edges that are seams, a little inside: those of two legs may overlap."""
    found = []
    for start, end in zip(z[seam], np.roll(z, -1)[seam], strict=True):
        count = max(2, int(np.ceil(abs(end - start) / SEAM_M)) + 1)
        inward = 1j * (end - start) / abs(end - start) * BESIDE_M
        found.append(start + (end - start) * np.linspace(0.0, 1.0, count) + inward)
    return np.concatenate(found) if found else np.zeros(0, dtype=complex)


def _pockets(z: Complex) -> Complex:
    """(p, 2) from each inner corner of an outline outward, farther than its shorter side goes.

    The legs of trousers may lie side by side: no cloth joins them there.
    """
    before, after = np.roll(z, 1) - z, np.roll(z, -1) - z
    inner = (before * np.conj(after)).imag < 0
    outward = before / np.abs(before) + after / np.abs(after)
    bent = np.abs(outward) > FLAT
    outward = np.where(bent, outward, 1.0)
    reach_m = np.minimum(np.abs(before), np.abs(after)) + ROUND_M
    ends = z + outward / np.abs(outward) * reach_m
    pockets: Complex = np.column_stack([z, ends])[inner & bent]
    return pockets


def _from_line_m(z: Complex, start: complex, end: complex) -> Float:
    """(n,) distances from the line from start to end."""
    along = np.real(np.conj(end - start) * (z - start)) / abs(end - start) ** 2
    away: Float = np.abs(z - start - along.clip(0.0, 1.0) * (end - start))
    return away


def _crossing(one: Complex, other: Complex, start: complex, end: complex) -> Bool:
    """Which ways from one to the other cross that from start to end."""
    way, across = other - one, end - start

    def left(of: Complex | complex, z: Complex | complex) -> Float:
        turned: Float = np.imag(np.conj(of) * z)
        return turned

    apart = left(across, one - start) * left(across, other - start) < 0
    crossed: Bool = apart & (left(way, start - one) * left(way, end - one) < 0)
    return crossed
