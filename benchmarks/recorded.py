"""Lines on views of the carried recordings, whose flat places the simulation knows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import peers
from numpy.typing import NDArray
from report import cell, row, table_head
from scipy.spatial import cKDTree

from vflatten_ros.bag import gather_views, open_recording
from vflatten_ros.core.config import Config
from vflatten_ros.core.geodesics import OK, geodesic_lines
from vflatten_ros.core.smoothing import quadratic_image
from vflatten_ros.core.surface import fit_surface
from vflatten_ros.core.values import View, no_progress
from vflatten_ros.files import load_calibration

Float = NDArray[np.float64]
Int = NDArray[np.int64]
SHORTEST_M, LONGEST_M = 0.05, 0.4
SEEN_M = 0.004  # a straight flat line is seen if every part of it is nearer to seen cloth
JUMP_M = 0.015  # neighbours farther apart in depth are not joined by the peers' mesh
PIXEL_M = 0.0025  # at the item, for the peers' smoothing
ABOUT = f"""
Every fourth view; pairs of {100 * SHORTEST_M:.0f} to {100 * LONGEST_M:.0f} cm on the outside of
one panel whose straight line on the flat item lies within {1e3 * SEEN_M:.0f} mm of seen points. The
simulation's truth chooses and judges the pairs, no more. What is wrong and not flagged either goes
on to a fold that touches the first, less than 3 mm in front of the other, or ends where the cloth
is seen at a grazing angle.
"""


def recorded(bags: Path, quick: bool) -> list[str]:
    """Table of ours and edge flip on recorded views; the truth only picks and judges the pairs."""
    lines = table_head(
        "Views of the carried recordings (median / 95th percentile / bias, %)",
        ["recording", "lines", "ours, not flagged", "flagged", "> 5 % wrong and not flagged",
         "smooth + edge flip, same lines", "> 5 % wrong"],
    )  # fmt: skip
    for folder in sorted(path.parent for path in bags.glob("*/truth.npz"))[: 1 if quick else None]:
        found = [
            _one_view(view, folder, 40 if quick else 150)
            for view in _views(folder)[:: 12 if quick else 4]
        ]
        exact, ours, said, flip = (np.concatenate(values) for values in zip(*found, strict=True))
        kept = ~said & np.isfinite(flip)
        errors = [100 * (length / exact - 1) for length in (ours, flip)]
        lines.append(
            row(
                [
                    folder.name,
                    len(exact),
                    cell(errors[0][kept]),
                    f"{100 * said.mean():.0f} %",
                    int((np.abs(errors[0][~said]) > 5).sum()),
                    cell(errors[1][kept]),
                    int((np.abs(errors[1][np.isfinite(flip)]) > 5).sum()),
                ]
            )
        )
    return [*lines, ABOUT]


def _views(folder: Path) -> tuple[View, ...]:
    calibration = load_calibration(folder / "calibration.yaml")
    return gather_views(open_recording(folder), calibration, Config(), no_progress).views()


def _one_view(
    view: View, folder: Path, count: int
) -> tuple[Float, Float, NDArray[np.bool_], Float]:
    """Exact lengths, ours, whether ours is flagged, and edge flip's (nan: cannot)."""
    a, b, exact = _pairs(view, folder, count)
    points, config = view.points_rig, Config()
    toward = -points / np.linalg.norm(points, axis=1, keepdims=True)
    surface = fit_surface(points, config.surface, toward, view.pixel, view.shape)
    found = geodesic_lines(surface, points[a], points[b], config.geodesics)
    mesh = _mesh(view)
    known = (mesh.of_point[a] >= 0) & (mesh.of_point[b] >= 0)
    flip = np.full(len(a), np.nan)
    flip[known] = peers.edge_flip(mesh, a[known], b[known])
    return exact, found.length_m, found.reason != OK, flip


def _pairs(view: View, folder: Path, count: int) -> tuple[Int, Int, Float]:
    """Pairs on the outside of one panel whose straight flat line the view sees."""
    with np.load(folder / "truth.npz") as truth:
        here = (truth["view"] == view.view_id) & ~truth["flying"] & truth["outer"]
        data: dict[str, Any] = {key: truth[key][here] for key in ("row", "col", "u", "v", "panel")}
    index = np.full(view.shape, -1)
    index[view.pixel[:, 0], view.pixel[:, 1]] = np.arange(len(view.pixel))
    point = index[data["row"], data["col"]]
    flat = np.c_[data["u"], data["v"]].astype(float)
    random = np.random.default_rng(view.view_id)
    chosen: list[tuple[Int, Int, Float]] = []
    for panel in np.unique(data["panel"]):
        mine = np.flatnonzero((data["panel"] == panel) & (point >= 0))
        if len(mine) < 100:
            continue
        i, j = random.choice(mine, (2, 40 * count))
        length = np.linalg.norm(flat[i] - flat[j], axis=1)
        ok = (length > SHORTEST_M) & (length < LONGEST_M)
        i, j, length = i[ok], j[ok], length[ok]
        at = np.linspace(0, 1, 100)[:, None, None]
        away = cKDTree(flat[mine]).query(flat[i] + at * (flat[j] - flat[i]))[0].max(axis=0)
        ok = away < SEEN_M
        chosen.append((point[i[ok]][:count], point[j[ok]][:count], length[ok][:count]))
    a, b, exact = (np.concatenate(values) for values in zip(*chosen, strict=True))
    return a, b, exact


def _mesh(view: View) -> peers.Mesh:
    """The peers' mesh of a view: depth smoothed by a quadratic, two triangles for four pixels."""
    low = view.pixel.min(axis=0)
    row_, col = (view.pixel - low).T
    xyz = np.zeros((*(np.ptp(view.pixel, axis=0) + 1), 3))
    seen = np.zeros(xyz.shape[:2], dtype=bool)
    xyz[row_, col], seen[row_, col] = view.points_rig, True
    depth = quadratic_image(xyz[..., 2], seen, seen, peers.SMOOTHING_M / PIXEL_M)[0][..., 0]
    xyz[seen] *= (depth[seen] / xyz[seen][:, 2])[:, None]  # along the rays
    return peers.mesh_of(xyz, seen, JUMP_M, seconds=0.0)
