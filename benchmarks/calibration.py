#!/usr/bin/env python3
"""How well a rotation of cloth tells the wrist axis: writes the table of docs/calibration.md.

    calibration.py [FOLDER ...] [--jobs N]

Each FOLDER is a recording with truth.json and truth.npz, or holds such recordings (default: bags/).
The axis of its calibration is put off, and found again by `vflatten calibrate`; and the recording
is flattened with the axis that is off.
"""

# ruff: noqa: E402  (threads must be limited before numpy is imported)

from __future__ import annotations

from vflatten_ros import threads

threads.use_one()  # as the command does: the same bits

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import yaml
from accuracy import ROOT, Row, judged, misplaced, recordings
from report import row, say, table_head, write_part

from vflatten_ros.calibrate import calibrate_recording
from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import VFlattenError
from vflatten_ros.core.turning import apart
from vflatten_ros.files import calibration_beside, load_calibration
from vflatten_ros.replay import replay_recording
from vflatten_ros.results import garment_result

PAGE = ROOT / "docs" / "calibration.md"
TITLE = "How well it is found"
OFF = ((0.0, 0.0), (0.003, 0.5), (0.012, 2.0), (0.025, 4.0), (0.05, 8.0), (0.1, 10.0))  # m, degrees
INTRO = """Written by `benchmarks/calibration.py`; do not edit. {count} simulated recordings
({names}), each with its axis shifted and leaning another way. Left: how far the axis
of `vflatten calibrate` is from the true one, with the joint's sign right and wrong. Right: the item
flattened with the axis that is off, not calibrated, all views and no manual input; landmarks are
where they hang in the frame of the clouds.
"""


@dataclass(frozen=True)
class Found:
    """One recording, its axis off."""

    off: tuple[float, float]
    apart: tuple[tuple[float, float], ...]  # m, rad: with the right sign and the wrong one
    signs_right: bool
    flattened: Row


def main() -> int:
    """Calibrate, flatten, write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="*", default=[ROOT / "bags"])
    parser.add_argument("--jobs", type=int, default=1, help="recordings at a time")
    args = parser.parse_args()
    folders = list(recordings(args.folders))
    if not folders:
        print("calibration: no recording with truth.json in the folders given", file=sys.stderr)
        return 1
    with ProcessPoolExecutor(args.jobs, get_context("spawn")) as pool:
        tasks = [(folder, off) for off in OFF for folder in folders]
        found = list(pool.map(tried, *zip(*tasks, strict=True)))
    names = ", ".join(folder.name for folder in folders)
    text = [INTRO.format(count=len(folders), names=names), *table(found)]
    write_part(PAGE, TITLE, "\n".join(text))
    print(PAGE)
    return 0


def tried(folder: Path, off: tuple[float, float]) -> Found:
    """Calibrate from an axis that is off, and flatten with it."""
    say(f"{folder.name}: {1e3 * off[0]:.0f} mm, {off[1]:g} degrees")
    config, truth = Config(), json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    true = load_calibration(calibration_beside(folder))
    with tempfile.TemporaryDirectory() as scratch:
        path = misplaced(folder, Path(scratch), off[0], float(np.radians(off[1])))
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
        notes, result = [], {}
        try:
            replayed = replay_recording(folder, config, calibration=path)
            result = garment_result(replayed.garment, replayed.views)
            notes = [notice["code"] for notice in result["notices"]]
        except VFlattenError as error:
            notes = [str(error)]
        axes = []
        for sign in (1, -1):
            path.write_text(yaml.safe_dump(values | {"joint_sign": sign * true.joint_sign}))
            axes.append(calibrate_recording(folder, config, calibration=path).axis.calibration)
    return Found(
        off,
        tuple(apart(true, axis) for axis in axes),
        all(axis.joint_sign == true.joint_sign for axis in axes),
        judged(folder, truth, result, 0.0, tuple(notes)),
    )


def table(found: Sequence[Found]) -> list[str]:
    """A line for each error of the axis."""
    columns = [
        "axis off by",
        "found: mean",
        "worst",
        "signs right",
        "flattened: right",
        "trusted",
        "W, L: mean",
        "worst",
        "landmarks, median",
        "says `axis_off`",
    ]
    lines = table_head("", columns)[3:]
    for off in OFF:
        mine = [one for one in found if one.off == off]
        away = np.array([each for one in mine for each in one.apart])
        rows = [one.flattened for one in mine]
        sizes = [abs(e) for r in rows for e in r.error_pct.values() if e is not None]
        named = [r.landmark_median_m for r in rows if "ends_alike" not in r.notes]
        marks = [100 * mark for mark in named if mark is not None]
        lines.append(
            row(
                [
                    f"{1e3 * off[0]:.0f} mm, {off[1]:g}°",
                    _apart(away.mean(axis=0)),
                    _apart(away.max(axis=0)),
                    sum(one.signs_right for one in mine),
                    f"{sum(r.right for r in rows)} of {len(rows)}",
                    sum(r.trusted for r in rows),
                    f"{np.mean(sizes):.1f} %",
                    f"{max(sizes):.1f} %",
                    f"{np.mean(marks):.2f} cm",
                    sum("axis_off" in r.notes for r in rows),
                ]
            )
        )
    return lines


def _apart(away: np.ndarray) -> str:
    return f"{1e3 * away[0]:.1f} mm, {np.degrees(away[1]):.2f}°"


if __name__ == "__main__":
    sys.exit(main())
