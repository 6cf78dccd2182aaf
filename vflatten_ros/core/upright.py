"""A flattened item turned to stand as its category is drawn: u to the right, v to neck or waist."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vflatten_ros.core.values import FlatGarment, Float


def upright(garment: FlatGarment, pose: Float) -> FlatGarment:
    """The same item in the frame of its category, origin as in the category's file.

    Distances on the cloth leave the flat frame free. A named item has one of its own, so that
    results of one kind lie alike whatever view the flattening started from. It is never mirrored:
    the top side stays the one that it was.

    Parameters
    ----------
    garment : FlatGarment
    pose : ndarray of shape (3,)
        Of the category's outline as fitted to it: turn (rad), and place (m) in the flat frame.
    """
    turn = np.array([[np.cos(pose[0]), -np.sin(pose[0])], [np.sin(pose[0]), np.cos(pose[0])]])

    def stood(uv: Float) -> Float:
        out: Float = (np.asarray(uv, dtype=float) - pose[1:]) @ turn
        return out

    def pair(uv: tuple[float, float]) -> tuple[float, float]:
        u, v = stood(np.array(uv)).tolist()
        return u, v

    return replace(
        garment,
        points=replace(garment.points, uv=stood(garment.points.uv)),
        start_uv=None if garment.start_uv is None else stood(garment.start_uv),
        outline=replace(garment.outline, uv=stood(garment.outline.uv)),
        template_uv=stood(garment.template_uv),
        measurements=tuple(
            m if m.ends_uv is None else replace(m, ends_uv=(pair(m.ends_uv[0]), pair(m.ends_uv[1])))
            for m in garment.measurements
        ),
        landmarks=tuple(replace(mark, uv=pair(mark.uv)) for mark in garment.landmarks),
    )
