#!/usr/bin/env python3
"""Ours beside what one would pick instead, on surfaces whose exact answer is known.

Writes its part of docs/benchmarks.md and build/bench-peers.json. Run by `make bench-peers`;
`--quick` takes fewer surfaces and pairs and leaves docs/benchmarks.md alone. One thread; times are
CPU seconds.
"""

# ruff: noqa: E402  (threads must be limited before numpy is imported)
from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "test"), str(ROOT), str(ROOT / "benchmarks")]

from vflatten_ros import threads

threads.use_one()

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import peers
import synthetic
from numpy.typing import NDArray
from recorded import recorded
from report import INTRO, NEEDED, TITLE, cell, machine, row, say, summary, table_head, write_part
from synthetic import Patch

from vflatten_ros.core.config import GeodesicConfig, SurfaceConfig
from vflatten_ros.core.geodesics import OK, Geodesics, geodesic_lines
from vflatten_ros.core.patch_flattening import flatten_patch
from vflatten_ros.core.surface import Surface, fit_surface

Float = NDArray[np.float64]
Int = NDArray[np.int64]
PAPER = (SurfaceConfig(fit="linear", radius_m=0.01), GeodesicConfig(solver="springs", nodes=30))
OURS = (SurfaceConfig(), GeodesicConfig())
MOST_ERROR = 0.05  # an unflagged error beyond this is a silent one


# ------------------------------------------------------------------ surfaces
def surfaces(quick: bool) -> list[Patch]:
    """Plane, cylinder, cone and curtains, turned in the image."""
    curtains = [synthetic.curtain(0.020), synthetic.curtain(0.040, turn_deg=60.0)]
    if quick:
        return curtains
    rest = [
        synthetic.plane(),
        synthetic.half_cylinder(),
        synthetic.cone(),
        synthetic.curtain(0.005),
    ]
    return rest + curtains


def fit(patch: Patch, points: Float, config: SurfaceConfig = OURS[0]) -> Surface:
    return fit_surface(points, config, synthetic.TOWARD, patch.pixel, patch.mask.shape)


# ------------------------------------------------------------------ methods: distances of pairs
Method = Callable[[Patch, Float, Int, Int], Float]


def ours(patch: Patch, points: Float, a: Int, b: Int) -> Float:
    return geodesic_lines(fit(patch, points), points[a], points[b], OURS[1]).length_m


def paper(patch: Patch, points: Float, a: Int, b: Int) -> Float:
    surface = fit(patch, points, PAPER[0])
    return geodesic_lines(surface, points[a], points[b], PAPER[1]).length_m


def on_mesh(distance: Callable[[peers.Mesh, Int, Int], Float], smooth: bool = True) -> Method:
    def method(patch: Patch, points: Float, a: Int, b: Int) -> Float:
        mesh = peers.grid_mesh(patch, points, smooth)
        known = (mesh.of_point[a] >= 0) & (mesh.of_point[b] >= 0)
        out = np.full(len(a), np.nan)
        out[known] = distance(mesh, a[known], b[known])
        return out

    return method


MAIN: dict[str, Method] = {
    "ours": ours,
    "paper (springs, linear fit)": paper,
    "smooth + edge flip (potpourri3d)": on_mesh(peers.edge_flip),
    "smooth + ARAP (libigl), straight": on_mesh(peers.arap_distance),
}
FURTHER: dict[str, Method] = {
    "edge flip, not smoothed": on_mesh(peers.edge_flip, smooth=False),
    "smooth + exact (pygeodesic)": on_mesh(peers.exact),
    "smooth + heat (potpourri3d)": on_mesh(peers.heat),
    "smooth + Poisson + heat (pymeshlab)": on_mesh(peers.poisson_heat),
    "smooth + Isomap (scikit-learn)": on_mesh(peers.isomap_distance),
}


def few_sources(patch: Patch, count: int, sources: int, seed: int) -> tuple[Int, Int, Float]:
    """Pairs from few starts, as solvers that work by source like them."""
    a, b, exact = [], [], []
    for k in range(sources):
        first = patch.pairs(1, seed=seed + k)[0][0]
        among = np.zeros(len(patch.flat), bool)
        among[first] = True
        i, j, d = patch.pairs(count // sources, among=among, seed=seed + k)
        a.append(i), b.append(j), exact.append(d)
    return np.concatenate(a), np.concatenate(b), np.concatenate(exact)


def error_percent(length: Float, exact: Float) -> Float:
    error = 100 * (length / exact - 1)
    return error[np.isfinite(error)]


# ------------------------------------------------------------------ parts
NOISES = [(0.0, 0.0), (0.001, 0.0), (0.002, 0.0), (0.001, 1.3)]  # sigma, m; correlation, pixels


def geodesics(quick: bool, seeds: int) -> tuple[dict[str, Any], list[str]]:
    """Errors of lines with independent and correlated noise."""
    noises = NOISES[1:2] if quick else NOISES
    p95: dict[str, dict[tuple[str, float], float]] = {name: {} for name in MAIN}
    bias: dict[str, float] = {}
    lines = []
    for patch in surfaces(quick):
        titles = [f"{s * 1e3:g} mm{', correlated' if c else ''}" for s, c in noises]
        lines += table_head(patch.name, ["method", *titles])
        pairs = few_sources(patch, 50 if quick else 200, 10, 7)
        for name, method in (MAIN if quick else MAIN | FURTHER).items():
            cells = []
            for noise in noises:
                if name in FURTHER and noise != (0.001, 0.0):
                    cells.append("-")
                    continue
                # the slow ones get two sources of pairs, and one sample of the noise
                some = slice(None, 40 if name in FURTHER else None)
                few = method is paper or name in FURTHER
                chosen = (pairs[0][some], pairs[1][some], pairs[2][some])
                error = errors(method, patch, noise, chosen, 1 if few else seeds)
                cells.append(cell(error))
                if name in MAIN and noise in NOISES[1:3] and len(error):
                    p95[name][patch.name, noise[0]] = float(np.percentile(np.abs(error), 95))
                    if method is ours:
                        middle = abs(float(np.median(error)))
                        bias[patch.name] = max(bias.get(patch.name, 0.0), middle)
            lines.append(row([name, *cells]))
        say(f"geodesics on {patch.name} done")
    own, theirs, flip, arap = (p95[name] for name in MAIN)
    folds = [key for key in own if key[0] in ("curtain 20 mm", "curtain 40 mm")]
    keys = {
        "geodesic_p95_vs_paper": ratio([own[k] for k in folds], [theirs[k] for k in folds]),
        "geodesic_p95_vs_best": ratio(list(own.values()), [min(flip[k], arap[k]) for k in own]),
        "geodesic_bias_pct": max(bias.values()),
    }
    return keys, lines


def errors(
    method: Method,
    patch: Patch,
    noise: tuple[float, float],
    pairs: tuple[Int, Int, Float],
    seeds: int,
) -> Float:
    """Errors over some samples of the noise, per cent."""
    found = []
    for seed in range(1, 1 + seeds):
        length = attempt(method, patch, patch.points(*noise, seed), *pairs[:2])
        found.append(error_percent(length, pairs[2]))
    return np.concatenate(found)


def attempt(method: Method, *arguments: Any) -> Float:
    """The method's distances; all nan where the library gives up."""
    try:
        return method(*arguments)
    except (RuntimeError, ValueError, ImportError, IndexError) as error:
        say(f"  {type(error).__name__}: {str(error)[:80]}")
        return np.full(len(arguments[2]), np.nan)


def ratio(own: list[float], theirs: list[float]) -> float:
    """Ratio of the means: small errors on easy surfaces do not count more than they are."""
    return float(np.mean(own) / np.mean(theirs))


def speed(quick: bool) -> tuple[dict[str, Any], list[str]]:
    """CPU time of a batch of lines on one view, fit and mesh included."""
    patch = synthetic.curtain(0.020)
    points = patch.points(0.001)
    lines = table_head(
        "Time of a batch, all included (curtain 20 mm, CPU seconds)",
        ["pairs", "ours", "edge flip", "ratio", "ours, ms a pair"],
    )
    found = 0.0
    for count in (400,) if quick else (200, 400, 1000):
        a, b, _ = patch.pairs(count)
        seconds = []
        for method in (ours, on_mesh(peers.edge_flip)):
            start = time.process_time()
            method(patch, points, a, b)
            seconds.append(time.process_time() - start)
        if count == 400:
            found = seconds[0] / seconds[1]
        lines.append(
            row(
                [
                    count,
                    f"{seconds[0]:.2f}",
                    f"{seconds[1]:.2f}",
                    f"{seconds[0] / seconds[1]:.2f}",
                    f"{1e3 * seconds[0] / count:.2f}",
                ]
            )
        )
    return {"geodesic_time_vs_edge_flip": found}, lines


def steep(quick: bool, seeds: int) -> tuple[dict[str, Any], list[str]]:
    """One end on the steep border of a half cylinder."""
    patch = synthetic.half_cylinder()
    side = np.abs(np.sin(patch.flat[:, 0] / 0.1))
    lines = table_head(
        "Steep border: one end at that share of a cylinder's radius",
        ["share", "ours", "smooth + edge flip"],
    )
    own, theirs = [], []
    for low, high in ((0.9, 0.98),) if quick else ((0.5, 0.8), (0.8, 0.9), (0.9, 0.98)):
        a, b, exact = patch.pairs(
            60 if quick else 200, among=(side > low) & (side <= high), to=side < 0.8
        )
        cells = []
        for keep, method in ((own, ours), (theirs, on_mesh(peers.edge_flip))):
            found = [errors(method, patch, noise, (a, b, exact), seeds) for noise in NOISES[1:3]]
            if high == 0.98:
                keep += [float(np.percentile(np.abs(e), 95)) for e in found]
            cells.append(cell(np.concatenate(found)))
        lines.append(row([f"{low:g} to {high:g}", *cells]))
    return {"steep_p95_vs_edge_flip": ratio(own, theirs)}, lines


def honesty(quick: bool, seeds: int) -> tuple[dict[str, Any], list[str]]:
    """Lines across flaps, jumps and gaps: how many are more than 5 % wrong and do not say so."""
    lines = table_head(
        "Jumps, flaps and gaps, 1 and 2 mm of noise",
        ["pairs", "lines", "wrong by > 5 %", "flagged", "wrong and not flagged", "within 2 sigma"],
    )
    silent = 0
    for name, patch, pairs in _traps((0.01, 0.03) if quick else (0.005, 0.01, 0.03)):
        wrong, flagged, missed, within, total = 0, 0, 0, 0, 0
        for sigma in (0.001, 0.002):
            for seed in range(1, 1 + seeds):
                points = patch.points(sigma, 0.0, seed)
                found: Geodesics = geodesic_lines(
                    fit(patch, points), points[pairs[0]], points[pairs[1]], OURS[1]
                )
                bad = np.abs(found.length_m / pairs[2] - 1) > MOST_ERROR
                said = found.reason != OK
                wrong, flagged, total = wrong + bad.sum(), flagged + said.sum(), total + len(bad)
                missed += int((bad & ~said).sum())
                within += int((np.abs(found.length_m - pairs[2]) < 2 * found.sigma_m).sum())
        silent += missed
        lines.append(row([name, total, wrong, flagged, missed, f"{100 * within / total:.0f} %"]))
    return {"unflagged_errors": silent}, lines


def _traps(heights: tuple[float, ...]) -> list[tuple[str, Patch, tuple[Int, Int, Float]]]:
    out = []
    for height in heights:
        patch, on_flap = synthetic.flap(height)
        x = patch.flat[:, 0]
        label = f"flap {height * 1e3:.0f} mm high"
        out.append((f"across a {label}", patch, patch.pairs(100, among=x < -0.06, to=x > 0.06)))
        out.append(
            (f"from cloth to a {label}", patch, patch.pairs(100, among=x < -0.06, to=on_flap))
        )
        edge = (x < -0.042) & (x > -0.046)
        out.append((f"beside a {label}", patch, patch.pairs(100, among=edge, to=x < -0.08)))
    patch = synthetic.curtain(0.020, hidden=synthetic.stripe)
    u, v = patch.flat.T
    inside = np.abs(u) < 0.09
    over = patch.pairs(
        100,
        among=inside & (v > 0.05) & (v < 0.1),
        to=inside & (v < 0.01) & (v > -0.05),
        straight=False,
    )
    out.append(("across a missing stripe", patch, over))
    patch = synthetic.curtain(0.020, hidden=synthetic.slit)
    u, v = patch.flat.T
    over = patch.pairs(100, among=(u > 0) & (v > -0.01), to=(u > 0) & (v < -0.03), straight=False)
    out.append(("across a slit", patch, over))
    return out


# ------------------------------------------------------------------ flattening
def flattening(quick: bool, seeds: int) -> tuple[dict[str, Any], list[str]]:
    """Whole patches laid flat, against smooth + ARAP."""
    curtain = synthetic.curtain(0.020)
    cut = [
        synthetic.curtain(0.020, hidden=synthetic.stripe, name="curtain 20 mm, stripe missing"),
        synthetic.curtain(0.020, hidden=synthetic.slit, name="curtain 20 mm, slit"),
    ]
    others = (
        []
        if quick
        else [synthetic.half_cylinder(part=0.97), synthetic.cone(), synthetic.curtain(0.040)]
    )
    lines = table_head(
        "Flattening: RMS % of the diameter / worst boundary length % / s",
        ["patch", "noise", "ours", "smooth + ARAP"],
    )
    rms: dict[tuple[str, str], list[float]] = {}
    worst: dict[str, list[float]] = {"ours": [], "arap": []}
    spent = {"ours": 0.0, "arap": 0.0}
    for patch in [curtain, *cut, *others]:
        for sigma in (0.001,) if quick else (0.001, 0.002):
            cells = []
            for name, flatten in (("ours", flat_ours), ("arap", flat_arap)):
                found = []
                for seed in range(1, 1 + seeds):
                    points = patch.points(sigma, 0.0, seed)
                    start = time.process_time()
                    uv = flatten(patch, points)
                    seconds = time.process_time() - start
                    found.append((*flat_error(uv, patch), seconds))
                mean = np.mean(found, axis=0)
                rms.setdefault((patch.name, name), []).append(mean[0])
                worst[name].append(mean[1])
                spent[name] += mean[2]
                cells.append(f"{mean[0]:.3f} / {mean[1]:.2f} / {mean[2]:.2f}")
            lines.append(row([patch.name, f"{sigma * 1e3:g} mm", *cells]))
    own, theirs = (
        [x for (_, n), v in rms.items() if n == name for x in v] for name in ("ours", "arap")
    )
    uncut = np.mean(rms[curtain.name, "ours"])
    keys = {
        "flatten_rms_vs_arap": ratio(own, theirs),
        "flatten_worst_vs_arap": ratio(worst["ours"], worst["arap"]),
        "flatten_time_vs_arap": spent["ours"] / spent["arap"],
        "slit_or_stripe_vs_uncut": float(max(np.mean(rms[p.name, "ours"]) for p in cut) / uncut),
    }
    return keys, lines


def flat_ours(patch: Patch, points: Float) -> Float:
    surface = fit(patch, points)
    place = np.round(surface.rays.to_grid(points)[0]).astype(int)
    flat = flatten_patch(surface)
    uv = flat.uv[place[:, 0], place[:, 1]]
    # the largest piece, as of the meshes: others have a position of their own
    return np.where(flat.piece[place[:, 0], place[:, 1]][:, None] == 0, uv, np.nan)


def flat_arap(patch: Patch, points: Float) -> Float:
    mesh = peers.grid_mesh(patch, points)
    uv = np.full((len(points), 2), np.nan)
    known = mesh.of_point >= 0
    uv[known] = peers.arap_flat(mesh)[mesh.of_point[known]]
    return uv


def flat_error(uv: Float, patch: Patch) -> tuple[float, float]:
    """RMS after rigid alignment, % of the diameter, and worst length between border points, %."""
    border = border_points(patch)
    known = np.isfinite(uv).all(axis=1)
    a, b = uv[known] - uv[known].mean(axis=0), patch.flat[known] - patch.flat[known].mean(axis=0)
    left, _, right = np.linalg.svd(a.T @ b)
    rms = np.sqrt(((a @ left @ right - b) ** 2).sum(axis=1).mean())
    border = border[known[border]]
    found, exact = (
        np.linalg.norm(x[border][:, None] - x[border][None], axis=2) for x in (uv, patch.flat)
    )
    far = exact > 0.05
    return float(100 * rms / exact.max()), float(100 * np.abs(found[far] / exact[far] - 1).max())


def border_points(patch: Patch, count: int = 60) -> Int:
    """Indices of points evenly spread along the outermost border of the patch."""
    import cv2

    mask = patch.mask.astype(np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = max(outlines, key=len)[:, 0, ::-1]
    number = np.full(mask.shape, -1)
    number[patch.mask] = np.arange(int(patch.mask.sum()))
    pick = outline[np.linspace(0, len(outline), count, endpoint=False).astype(int)]
    return number[pick[:, 0], pick[:, 1]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="fewer surfaces and pairs, under a minute"
    )
    parser.add_argument("--seeds", type=int, default=2, help="noise samples of each surface")
    options = parser.parse_args()
    seeds = 1 if options.quick else options.seeds
    start = time.time()
    keys: dict[str, Any] = {}
    body: list[str] = []
    for part in (geodesics, steep, honesty, flattening):
        found, lines = part(options.quick, seeds)
        keys |= found
        body += lines
        say(f"{part.__name__} done after {time.time() - start:.0f} s")
    found, lines = speed(options.quick)
    keys |= found
    body += lines
    body += recorded(ROOT / "bags", options.quick)
    ordered = {name: keys[name] for name in NEEDED}
    report = "\n".join([*summary(ordered), *body, ""])
    print(report)
    target = ROOT / "build" / "bench-peers.json"
    target.parent.mkdir(exist_ok=True)
    target.write_text(json.dumps(ordered, indent=1) + "\n")
    if not options.quick:
        page = ROOT / "docs" / "benchmarks.md"
        write_part(page, TITLE, f"{INTRO}\n{machine()}\n{report}")
    say(f"{target} written after {time.time() - start:.0f} s")


if __name__ == "__main__":
    main()
