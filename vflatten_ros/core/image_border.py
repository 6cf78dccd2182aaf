"""Whether the item goes on beyond what the camera sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vflatten_ros.core.values import Bool, Calibration, Int, Notice, View

SIDES = ("upper", "lower", "left", "right")
BORDER_PX = 3  # rows or columns at the border of an image, in which there is often no depth
FEWEST_PX = 5  # of these that show the item, for it to go on beyond them
LINE_PX = 10  # that show its lower end in the last row in which any view does: a straight cut
FEWEST_VIEWS = 3  # to tell a straight cut from a straight hem
LEAST_ACROSS = 0.5  # of the axis' direction, across the view, for the frame to be that of an image
OFTEN = 0.5  # share of the views; what so many cut off, the others hardly show
REMEDY = "what lies beyond was not seen; move the camera back, or aim it at the whole item"


def cut_off(views: Sequence[View]) -> tuple[Notice, ...]:
    """What to say where the item reaches the border of the image, or of what of it has depth.

    Parameters
    ----------
    views : sequence of View
        Unorganised clouds, which have no border, say nothing.

    Returns
    -------
    tuple of Notice
        None; that it was cut off in some views; or also that the result is not to be trusted.
    """
    images = [view for view in views if view.shape[0] > 1 and len(view.pixel)]
    if not images:
        return ()
    reaching = np.array([_at_border(view) for view in images])
    below = _below(images[0].calibration)
    if below is not None:
        reaching[:, below] |= _along_a_line(images, below)
    count = reaching.sum(axis=0)
    if not count.any():
        return ()
    named = " and ".join(f"the {SIDES[k]} one in {count[k]}" for k in np.flatnonzero(count))
    notices = [
        Notice(
            "truncated",
            f"the item reaches the border of the image, {named} of {len(images)} views: {REMEDY}",
        )
    ]
    most = int(count.argmax())
    if count[most] >= OFTEN * len(images):
        text = f"the item goes on beyond the {SIDES[most]} border of the image"
        notices.append(Notice("untrusted", text))
    return tuple(notices)


def cut_off_now(view: View) -> str:
    """The same of one view, as it arrives; empty: nothing to say."""
    if view.shape[0] < 2 or not len(view.pixel):
        return ""
    sides = " and ".join(SIDES[k] for k in np.flatnonzero(_at_border(view)))
    return f"the item reaches the {sides} border of the image: {REMEDY}" if sides else ""


def _to_sides(view: View) -> Int:
    """(n, 4) pixels from each to the sides of the image, 0 in the last row or column."""
    after = np.array(view.shape) - 1 - view.pixel
    away: Int = np.hstack([view.pixel, after])[:, [0, 2, 1, 3]]
    return away


def _at_border(view: View) -> Bool:
    """(4,) whether the item reaches each side."""
    reached: Bool = (_to_sides(view) < BORDER_PX).sum(axis=0) >= FEWEST_PX
    return reached


def _below(calibration: Calibration) -> int | None:
    """The side towards which the item hangs, in an optical frame; None: it is none."""
    x, y, _ = calibration.axis_direction  # up; images are x to the right and y down
    if max(abs(x), abs(y)) < LEAST_ACROSS:
        return None
    if abs(y) >= abs(x):
        return SIDES.index("lower" if y < 0 else "upper")
    return SIDES.index("right" if x < 0 else "left")


def _along_a_line(images: Sequence[View], side: int) -> Bool:
    """(v,) whether the item ends at the same row or column as in many other views, straight.

    There may be no depth for some way within the border.
    """
    if len(images) < FEWEST_VIEWS or len({view.shape for view in images}) > 1:
        return np.zeros(len(images), dtype=bool)
    away = [_to_sides(view)[:, side] for view in images]
    last = min(int(each.min()) for each in away)
    along = np.array([(each == last).sum() >= LINE_PX for each in away])
    straight: Bool = along & (along.mean() >= OFTEN)
    return straight
