#!/usr/bin/env python3
"""Times of our stages over sizes: `--save FILE`, or `--compare OLD NEW` of two saved runs.

CPU seconds of one thread, the best of some runs; "growth" is the cost of each point, line or view
beside that at the smallest size. `--docs` writes the part of docs/benchmarks.md about it.
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
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import synthetic
from cost_page import write_page

from vflatten_ros.bag import gather_views, open_recording
from vflatten_ros.categories import load_templates
from vflatten_ros.core.config import Config, GeodesicConfig, SegmentationConfig, SurfaceConfig
from vflatten_ros.core.geodesics import geodesic_lines
from vflatten_ros.core.patch_flattening import flatten_patch
from vflatten_ros.core.pipeline import flatten_garment
from vflatten_ros.core.pointcloud import FLOAT32, PointField, decode_cloud
from vflatten_ros.core.segmentation import make_view
from vflatten_ros.core.surface import fit_surface
from vflatten_ros.core.values import View
from vflatten_ros.files import calibration_beside, load_calibration

NOISE_M = 0.0005  # of repeated views
Job = tuple[str, int, Callable[[], Any]]  # stage, size, what to run
FIELDS = [PointField(name, 4 * i, FLOAT32, 1) for i, name in enumerate("xyz")]


def segmentation_jobs(recording: Path) -> Iterator[Job]:
    """A cloud from the bytes of its message to the segmented view, over image sizes."""
    calibration = load_calibration(calibration_beside(recording))
    first = next(m for m in open_recording(recording).messages() if hasattr(m, "decode"))
    xyz = first.decode().xyz
    for width in (150, 360, 640, 960):
        rows = round(width * xyz.shape[0] / xyz.shape[1])
        data = cv2.resize(xyz, (width, rows), interpolation=cv2.INTER_LINEAR).tobytes()

        def run(data: bytes = data, rows: int = rows, width: int = width) -> None:
            cloud = decode_cloud(
                stamp_ns=0, frame_id="rig", height=rows, width=width, fields=FIELDS,
                is_bigendian=False, point_step=12, row_step=12 * width, data=data,
            )  # fmt: skip
            make_view(0, cloud, calibration, 0.0, SegmentationConfig())

        yield "message to segmented view, points", rows * width, run


def surface_jobs(quick: bool) -> Iterator[Job]:
    """The surface fit and the flattened patch, over points."""
    for step_m in (0.005, 0.0025, 0.00125, 0.0008) + (() if quick else (0.0004,)):
        patch = synthetic.curtain(0.020, step_m=step_m)
        points, pixel, shape = patch.points(0.001), patch.pixel, patch.mask.shape

        def fit(points: Any = points, pixel: Any = pixel, shape: Any = shape) -> Any:
            return fit_surface(points, SurfaceConfig(), synthetic.TOWARD, pixel, shape)

        def scattered(points: Any = points) -> Any:
            return fit_surface(points, SurfaceConfig(), synthetic.TOWARD)

        yield "surface fit, points of an organised cloud", len(points), fit
        if step_m > 0.0005:
            yield "surface fit, points of an unorganised cloud", len(points), scattered
        surface = fit()
        yield "flattened patch, points", len(points), lambda s=surface: flatten_patch(s)


def line_jobs() -> Iterator[Job]:
    """Geodesic lines on one view of 32,000 points, over lines."""
    patch = synthetic.curtain(0.020)
    points = patch.points(0.001)
    surface = fit_surface(points, SurfaceConfig(), synthetic.TOWARD, patch.pixel, patch.mask.shape)
    for count in (50, 200, 800):
        a, b, _ = patch.pairs(count)

        def run(a: Any = a, b: Any = b) -> None:
            geodesic_lines(surface, points[a], points[b], GeodesicConfig())

        yield "geodesic lines, lines", count, run

    def both() -> None:
        a, b, _ = patch.pairs(200)
        fitted = fit_surface(
            points, SurfaceConfig(), synthetic.TOWARD, patch.pixel, patch.mask.shape
        )
        geodesic_lines(fitted, points[a], points[b], GeodesicConfig())

    yield "200 lines with the surface fit, points", len(points), both


def view_jobs(recording: Path, rotations: Sequence[Path], quick: bool) -> Iterator[Job]:
    """The whole method, over views: of several recordings, or of one, some of them or repeated."""
    config, templates = Config(), load_templates()
    views = _views(recording, config)
    half = [views[i] for i in range(0, len(views), 2)]
    several = [_views(path, config) for path in rotations]
    if not several:
        several = [half] + ([] if quick else [_repeated(views, times) for times in (2, 4)])
    for chosen in sorted([views, *several], key=len):
        yield (
            "views to flattened item, views",
            len(chosen),
            lambda v=chosen: flatten_garment(v, (), templates, config),
        )


def _views(recording: Path, config: Config) -> list[View]:
    calibration = load_calibration(calibration_beside(recording))
    return list(gather_views(open_recording(recording), calibration, config).views())


def _repeated(views: list[View], times: int) -> list[View]:
    """The views several times over, the copies with noise of their own along the rays."""
    random = np.random.default_rng(0)
    out = list(views)
    for view in views * (times - 1):
        ray = view.points_rig / np.linalg.norm(view.points_rig, axis=1, keepdims=True)
        noise = random.normal(0.0, NOISE_M, (len(ray), 1))
        out.append(replace(view, view_id=len(out), points_rig=view.points_rig + noise * ray))
    return out


def measure(run: Callable[[], Any]) -> float:
    """Best CPU time of up to three runs, no more than some seconds in all."""
    best, spent = np.inf, 0.0
    for _ in range(3):
        start = time.process_time()
        run()
        took = time.process_time() - start
        best, spent = min(best, took), spent + took
        if spent > 3.0:
            break
    return float(best)


def collect(recording: Path, rotations: Sequence[Path], quick: bool) -> dict[str, dict[str, float]]:
    """Stage -> size -> seconds, printed as they come."""
    found: dict[str, dict[str, float]] = {}
    sources = (
        segmentation_jobs(recording),
        surface_jobs(quick),
        line_jobs(),
        view_jobs(recording, rotations, quick),
    )
    print(f"{'stage':44} {'size':>9} {'s':>8} {'us each':>9} {'growth':>7}")
    for source in sources:
        for stage, size, run in source:
            seconds = measure(run)
            sizes = found.setdefault(stage, {})
            sizes[str(size)] = seconds
            smallest = min(sizes, key=int)
            growth = (seconds / size) / (sizes[smallest] / int(smallest))
            each = 1e6 * seconds / size
            print(f"{stage:44} {size:9} {seconds:8.3f} {each:9.2f} {growth:7.2f}", flush=True)
    return found


def compare(old: Path, new: Path) -> None:
    """Print the ratios of two saved runs."""
    before, after = (json.loads(path.read_text())["seconds"] for path in (old, new))
    print(f"{'stage':44} {'size':>9} {'old s':>8} {'new s':>8} {'ratio':>6}")
    for stage, sizes in after.items():
        for size, seconds in sizes.items():
            then = before.get(stage, {}).get(size)
            if then is not None:
                print(f"{stage:44} {size:>9} {then:8.3f} {seconds:8.3f} {seconds / then:6.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--save", type=Path, help="write the times to this file")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("OLD", "NEW"))
    parser.add_argument("--recording", type=Path, default=ROOT / "bags" / "LS1_1")
    parser.add_argument(
        "--rotations", type=Path, nargs="+", default=[], metavar="DIR",
        help="recordings with other numbers of views, in place of the one's views repeated",
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="leave the largest sizes out")
    parser.add_argument("--docs", action="store_true", help="write docs/benchmarks.md")
    options = parser.parse_args()
    if options.compare:
        compare(*options.compare)
        return
    found = collect(options.recording, options.rotations, options.quick)
    if options.docs:
        docs = ROOT / "docs"
        picture = docs / "figures" / "cost.png"
        write_page(found, docs / "benchmarks.md", picture, not options.rotations)
    if options.save:
        host = f"Python {platform.python_version()}, numpy {np.__version__}, {platform.machine()}"
        options.save.write_text(json.dumps({"host": host, "seconds": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
