"""The flattened item as a picture, drawn with OpenCV alone: quick enough to publish."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.values import Byte, FlatGarment, Float, Measurement

PIXELS_PER_M = 800.0
MARGIN_PX = 60
MAX_SIDE_PX = 2000
HEADER_PX = 90
LABEL_PX = 120  # names to the right of the outermost points

# red, green, blue; colour-blind-safe (Okabe and Ito 2008)
BLUE, ORANGE, VERMILION = (0, 114, 178), (230, 159, 0), (213, 94, 0)
GREEN, GREY, BLACK = (0, 158, 115), (190, 190, 190), (0, 0, 0)
FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw_flat(garment: FlatGarment) -> Byte:
    """Flattened points, outline (orange: inferred), W and L, landmarks, category.

    Returns
    -------
    ndarray of shape (height, width, 3), uint8
        Red, green, blue. u to the right, v up.
    """
    canvas = _Canvas(np.concatenate([garment.points.uv, garment.outline.uv, garment.template_uv]))
    seen = ~garment.points.inferred
    canvas.dots(garment.points.uv[seen], GREY)
    canvas.closed(garment.template_uv, np.zeros(len(garment.template_uv), bool), GREEN, GREEN)
    canvas.closed(garment.outline.uv, garment.outline.inferred, BLUE, ORANGE)
    for name in ("width", "length"):
        size = garment.measurement(name)
        if size is not None:
            canvas.size(size)
    for mark in garment.landmarks:
        colour = BLACK if mark.seen else ORANGE
        canvas.mark(np.array(mark.uv), mark.name, colour)
    canvas.title(_titles(garment))
    return canvas.image


def _titles(garment: FlatGarment) -> list[str]:
    score = garment.scores.get(garment.category)
    first = garment.category if score is None else f"{garment.category} ({score:.2f})"
    second = f"{garment.method}, {len(garment.view_ids)} views, {garment.coverage:.0%} seen"
    return [first, second, ", ".join(notice.code for notice in garment.notices)]


class _Canvas:
    """A white image and the way from the flat plane to its pixels."""

    def __init__(self, extent: Float) -> None:
        extent = extent[np.isfinite(extent).all(axis=1)]
        if not len(extent):
            extent = np.zeros((1, 2))
        self._low, high = extent.min(axis=0), extent.max(axis=0)
        size = np.maximum(high - self._low, 0.05)
        self._scale = min(PIXELS_PER_M, (MAX_SIDE_PX - 2 * MARGIN_PX) / float(size.max()))
        width, height = np.ceil(size * self._scale).astype(int) + 2 * MARGIN_PX
        width += LABEL_PX
        self._height = int(height) + HEADER_PX
        self.image: Byte = np.full((self._height, max(int(width), 420), 3), 255, np.uint8)

    def _pixels(self, uv: Float) -> NDArray[np.int32]:
        scaled = (np.nan_to_num(uv) - self._low) * self._scale + MARGIN_PX
        scaled[:, 1] = self._height - scaled[:, 1]
        return np.clip(np.rint(scaled), -10000, 10000).astype(np.int32)

    def dots(self, uv: Float, colour: tuple[int, int, int]) -> None:
        x, y = self._pixels(uv).T
        rows, cols = self.image.shape[:2]
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            inside = (x + dx >= 0) & (x + dx < cols) & (y + dy >= 0) & (y + dy < rows)
            self.image[y[inside] + dy, x[inside] + dx] = colour

    def closed(
        self,
        uv: Float,
        inferred: NDArray[np.bool_],
        seen_colour: tuple[int, int, int],
        inferred_colour: tuple[int, int, int],
    ) -> None:
        pixels = self._pixels(uv)
        for a, b, guess in zip(pixels, np.roll(pixels, -1, axis=0), inferred, strict=True):
            cv2.line(
                self.image,
                _xy(a),
                _xy(b),
                inferred_colour if guess else seen_colour,
                2,
                cv2.LINE_AA,
            )

    def size(self, size: Measurement) -> None:
        letter = {"width": "W", "length": "L"}[size.name]
        text = f"{letter} {size.value_m * 100:.1f} +- {size.sigma_m * 100:.1f} cm"
        if size.inferred:
            text += " (inferred)"
        if size.ends_uv is None:
            return
        a, b = self._pixels(np.array(size.ends_uv, dtype=float))
        cv2.line(self.image, _xy(a), _xy(b), VERMILION, 2, cv2.LINE_AA)
        for end in (a, b):
            cv2.circle(self.image, _xy(end), 4, VERMILION, -1, cv2.LINE_AA)
        self._text(text, (a + b) // 2 + np.array([8, -8]), VERMILION, 0.55)

    def mark(self, uv: Float, name: str, colour: tuple[int, int, int]) -> None:
        place = self._pixels(uv[None])[0]
        cv2.circle(self.image, _xy(place), 4, colour, 1, cv2.LINE_AA)
        self._text(name, place + np.array([6, 4]), colour, 0.38)

    def title(self, lines: list[str]) -> None:
        for i, line in enumerate(lines):
            self._text(line, np.array([12, 28 + 26 * i]), BLACK, 0.7 if i == 0 else 0.45)

    def _text(
        self, text: str, place: NDArray[np.int32], colour: tuple[int, int, int], size: float
    ) -> None:
        cv2.putText(self.image, text, _xy(place), FONT, size, (255, 255, 255), 3, cv2.LINE_AA)
        cv2.putText(self.image, text, _xy(place), FONT, size, colour, 1, cv2.LINE_AA)


def _xy(pixel: NDArray[np.int32]) -> tuple[int, int]:
    return int(pixel[0]), int(pixel[1])
