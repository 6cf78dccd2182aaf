#!/usr/bin/env python3
"""Time from the last view to the result of the automatic method, for each recording.

    source env.sh
    python3 benchmarks/last_view.py RECORDING [RECORDING ...] [--rounds 3] [--docs]

Views are prepared and folded in before, as they are while the wrist turns. Wall time, the best of
some rounds, without and with the helper process. `--docs` writes the table of docs/benchmarks.md.
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
import re
import threading
import time
from dataclasses import dataclass
from multiprocessing import get_context

from report import row, table_head, write_part

from vflatten_ros.bag import gather_views, open_recording
from vflatten_ros.categories import load_templates
from vflatten_ros.core.config import Config
from vflatten_ros.core.pipeline import flatten_garment, prepare_view
from vflatten_ros.core.registration import ViewSurface, fold_in
from vflatten_ros.core.values import no_progress
from vflatten_ros.files import calibration_beside, load_calibration
from vflatten_ros.helper import HelperProcess
from vflatten_ros.processes import keep_little
from vflatten_ros.progress import Stages

PAGE = ROOT / "docs" / "benchmarks.md"
ABOUT = """
Written by `python3 benchmarks/last_view.py RECORDING ... --docs`: wall seconds of `rotation` after
the views are prepared and folded in, the best of some rounds. Stages, and their sum in one process,
are without the helper process; those that every way of laying the item flat goes through are summed
over the ways that it took. The memory is the most in use at any time, libraries that both processes
share counted once.
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
    stages: dict[str, float]


@dataclass
class Measured:
    """The fastest flattening by one process, and by two."""

    alone: Run
    both: Run
    prepare_s: float  # a view, before
    alone_mb: float
    both_mb: float


def measure(folder: Path, rounds: int) -> Measured:
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

    def fastest(helper: HelperProcess | None) -> Run:
        runs = []
        for _ in range(rounds):
            wall, cpu, stages = time.perf_counter(), time.process_time(), Watched()
            garment = flatten_garment(
                views, (), templates, config, stages, prepared, so_far, helper
            )
            stages.stop()
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            runs.append(Run(wall, cpu, stages.gap_s, garment.category, stages.seconds))
        return min(runs, key=lambda run: run.wall_s)

    alone = fastest(None)
    with Memory("self") as alone_mb:
        flatten_garment(views, (), templates, config, no_progress, prepared, so_far)
    with HelperProcess() as helper:
        helper.wait_until_ready(60.0)
        both = fastest(helper)
        with Memory("self", str(helper.pid)) as both_mb:
            flatten_garment(views, (), templates, config, no_progress, prepared, so_far, helper)
    return Measured(alone, both, each, alone_mb.most, both_mb.most)


class Memory:
    """The most memory that processes had together while the context lasted, MB.

    What they share (libraries) counts once.
    """

    def __init__(self, *processes: str) -> None:
        self._files = [Path(f"/proc/{process}/smaps_rollup") for process in processes]
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self.most = 0.0

    def __enter__(self) -> Memory:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._over.wait(0.01):
            shares = re.findall(r"^Pss: +(\d+)", "".join(f.read_text() for f in self._files), re.M)
            self.most = max(self.most, sum(map(int, shares)) * 1.024e-3)


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("recordings", type=Path, nargs="+")
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--docs", action="store_true", help="write docs/benchmarks.md")
    args = options.parse_args()
    ends = ["one process", "its CPU", "two", "longest without a report", "MB, one", "MB, two"]
    lines = table_head("", ["recording", "result", *TOGETHER, *ends])[-2:]
    print("\n".join(lines))
    slowest = 0.0
    keep_little(os.environ)  # as the node's process has it
    for folder in args.recordings:
        with get_context("spawn").Pool(1) as pool:  # its own process: memory is its own, too
            got = pool.apply(measure, (folder, args.rounds))
        slowest = max(slowest, got.prepare_s)
        alone, both = got.alone, got.both
        shares = [sum(alone.stages.get(s, 0.0) for s in stages) for stages in TOGETHER.values()]
        seconds = [*shares, alone.wall_s, alone.cpu_s, both.wall_s, max(alone.gap_s, both.gap_s)]
        memory = [f"{got.alone_mb:.0f}", f"{got.both_mb:.0f}"]
        lines.append(row([folder.name, both.category, *(f"{s:.2f}" for s in seconds), *memory]))
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
