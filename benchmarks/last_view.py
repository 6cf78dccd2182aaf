#!/usr/bin/env python3
"""Time from the last view to the result of the automatic method, for each recording.

    source env.sh
    python3 benchmarks/last_view.py RECORDING [RECORDING ...] [--rounds 3] [--docs]

Views are prepared and folded in before, as they are while the wrist turns. Wall time, the best of
some rounds; CPU time beside it, since two threads share the work. `--docs` writes the table of
docs/benchmarks.md.
"""

# ruff: noqa: E402  (threads must be limited before numpy is imported)
from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from vflatten_ros import threads

threads.use_one()

import argparse
import os
import resource
import time
from dataclasses import dataclass, field
from multiprocessing import get_context

from report import row, table_head, write_part

from vflatten_ros.bag import gather_views, open_recording
from vflatten_ros.categories import load_templates
from vflatten_ros.core.config import Config
from vflatten_ros.core.pipeline import flatten_garment, prepare_view
from vflatten_ros.core.registration import ViewSurface, fold_in
from vflatten_ros.files import calibration_beside, load_calibration
from vflatten_ros.progress import Stages
from vflatten_ros.worker import KEPT_BYTES

PAGE = ROOT / "docs" / "benchmarks.md"
ABOUT = """
Written by `python3 benchmarks/last_view.py RECORDING ... --docs`: wall seconds of `rotation` after
the views are prepared and folded in, the best of some rounds. Stages that every way of laying the
item flat goes through are summed over the ways that it took.
"""
TOGETHER = {
    "register, fuse": ("surface", "register", "fuse"),
    "link, ramps": ("link", "ramps"),
    "pieces, distances, unfold": ("pieces", "distances", "unfold"),
    "place": ("place",),
    "outline, recognition": ("outline", "recognition"),
    "parts, measurement": ("parts", "measurement"),
}


class Watched(Stages):
    """Times the stages, and the longest time without a report."""

    def __init__(self) -> None:
        super().__init__()
        self.gap_s, self._last = 0.0, time.perf_counter()

    def __call__(self, stage: str, fraction: float) -> None:
        now = time.perf_counter()
        self.gap_s, self._last = max(self.gap_s, now - self._last), now
        super().__call__(stage, fraction)


@dataclass
class Run:
    """One flattening after the last view."""

    wall_s: float
    cpu_s: float
    gap_s: float
    category: str
    prepare_s: float  # a view, before
    memory_mb: float = 0.0  # most of the process
    stages: dict[str, float] = field(default_factory=dict)


def measure(folder: Path, rounds: int) -> Run:
    """The fastest of some runs."""
    config, templates = Config(), load_templates()
    rig = load_calibration(calibration_beside(folder))
    views = gather_views(open_recording(folder), rig, config).views()
    begin = time.perf_counter()
    prepared: dict[int, ViewSurface] = {}
    so_far = None
    for view in views:
        prepared[view.view_id] = prepare_view(view, config)
        so_far = fold_in(list(prepared.values()), config.rotation, so_far)
    each = (time.perf_counter() - begin) / len(views)
    runs = []
    for _ in range(rounds):
        wall, cpu, stages = time.perf_counter(), time.process_time(), Watched()
        garment = flatten_garment(views, (), templates, config, stages, prepared, so_far)
        stages.stop()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        runs.append(Run(wall, cpu, stages.gap_s, garment.category, each, stages=stages.seconds))
    best = min(runs, key=lambda run: run.wall_s)
    best.memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return best


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("recordings", type=Path, nargs="+")
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--docs", action="store_true", help="write docs/benchmarks.md")
    args = options.parse_args()
    lines = table_head(
        "", ["recording", "result", *TOGETHER, "all", "CPU", "longest without a report", "MB"]
    )[-2:]
    print("\n".join(lines))
    slowest = 0.0
    os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", str(KEPT_BYTES))  # as the node's process has it
    for folder in args.recordings:
        with get_context("spawn").Pool(1) as pool:  # its own process: memory is its own, too
            run = pool.apply(measure, (folder, args.rounds))
        slowest = max(slowest, run.prepare_s)
        shares = [sum(run.stages.get(s, 0.0) for s in stages) for stages in TOGETHER.values()]
        times = [f"{s:.2f}" for s in (*shares, run.wall_s, run.cpu_s, run.gap_s)]
        lines.append(row([folder.name, run.category, *times, f"{run.memory_mb:.0f}"]))
        print(lines[-1], flush=True)
    about = (
        f"{os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f} with this; preparing a "
        f"view and folding it in takes {slowest:.2f} s at most."
    )
    print(about)
    if args.docs:
        write_part(PAGE, "After the last view", "\n".join([ABOUT, *lines, "", about]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
