#!/usr/bin/env python3
"""How far results are from the truth of simulated recordings: writes docs/accuracy.md.

    accuracy.py [NAME=FOLDER,... ...] [--runs rotation,half,...] [--jobs N] [--output FILE]
                [--about TEXT] [--append]

Each argument is a group of recordings with a table of its own, "NAME=" left out: named as its first
folder. Each FOLDER is a recording with truth.json and truth.npz, or holds such (default: bags/).
Every recording is flattened with all views and no manual input (rotation), with every second view
(half), by the paper's protocol (protocol), by the paper's method with views and points chosen by
itself (chosen), with all views and a calibration that is off (calibration), and with all views and
other samples (drawn). The truth is read only after the result is there, to compare.
"""

# ruff: noqa: E402  (threads must be limited before numpy is imported)

from __future__ import annotations

from vflatten_ros import threads

threads.use_one()  # as the command does: the same bits

import argparse
import dataclasses
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.stats import spearmanr

from vflatten_ros.bag import open_recording
from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import VFlattenError
from vflatten_ros.core.geometry import rotation_about
from vflatten_ros.figures import DPI, flattening_figure
from vflatten_ros.replay import replay_recording
from vflatten_ros.results import garment_result

Float = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
PIXEL_M = 0.002  # raster of the overlap
AXIS_SHIFT_M, AXIS_TILT_RAD = 0.003, np.radians(0.5)  # of the calibration that is off
RUNS = {
    "rotation": "All views, no manual input (`method: rotation`)",
    "half": "Every second view, no manual input",
    "protocol": "The paper's protocol: two views, three to five points (`method: kita2019`)",
    "chosen": "The paper's method, views and points chosen by itself (`method: kita2019`)",
    "calibration": "All views, the calibrated axis 3 mm and 0.5 degrees off",
    "drawn": "All views, other samples of the same surface (`rotation.draw`)",
}
DRAWN = 20  # none of the draws that the method takes, or that it was built with
USUAL_M = 1.4  # from the rig to the wrist's axis, at most
SURE = (("0.99 and more", 0.99, 2.0), ("0.9 to 0.99", 0.9, 0.99), ("less", 0.0, 0.9))
FEWEST_RANKED = 8  # results, for their ranks to be compared
FAILED_SIZE_PCT = 7.0  # a size further off than this is drawn

HEAD = """# Accuracy

Written by `make accuracy`; do not edit.

Recordings of simulated garments (bags/README.md says how), compared with what the simulation knows.
Real items will do worse in ways that only real recordings can show. Sizes are signed errors in per
cent, with how many stated standard deviations they are. A recording has 24 views taken at rest
from 1.3 m away, 1 mm of noise at that distance and no wall unless it says otherwise; those named
`sway` swing by 8 mm and lag by 1.5 degrees in place of 3 and 0.5. Points and landmarks: median
distance to the truth. Overlap: intersection over union with the true outline. Seconds: opening,
reading and all stages on the machine that wrote this page.
"""


@dataclass(frozen=True)
class Row:
    """One recording compared with its truth."""

    name: str
    how: str  # it was recorded
    true_category: str
    category: str
    trusted: bool
    error_pct: Mapping[str, float | None]  # "W", "L"
    in_sigmas: Mapping[str, float | None]
    point_median_m: float | None
    overlap: float | None
    landmark_median_m: float | None
    seconds: float
    notes: tuple[str, ...]
    probability: float | None = None  # of its category, where scores are probabilities
    quality: float | None = None

    @property
    def right(self) -> bool:
        return self.category == self.true_category

    @property
    def failed(self) -> bool:
        sizes = [e for e in self.error_pct.values() if e is not None]
        return not self.right or any(abs(e) > FAILED_SIZE_PCT for e in sizes)


def main() -> int:
    """Replay, compare, write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "groups", nargs="*", default=[str(ROOT / "bags")], metavar="NAME=FOLDER,..."
    )
    parser.add_argument("--runs", default=",".join(RUNS), help="some of " + ",".join(RUNS))
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "accuracy.md")
    parser.add_argument("--about", default="", help="a paragraph about these recordings")
    parser.add_argument("--jobs", type=int, default=1, help="recordings at a time")
    parser.add_argument("--append", action="store_true", help="add to the page, as it is")
    args = parser.parse_args()
    runs = args.runs.split(",")
    if not set(runs) <= set(RUNS):
        parser.error(f"--runs: expected some of {','.join(RUNS)}, got {args.runs}")
    named = [group(text) for text in args.groups]
    groups = dict(named)
    if len(groups) < len(named):
        names = ", ".join(name for name, _ in named)
        parser.error(f"groups need names of their own, got {names}; give NAME=FOLDER")
    folders = [folder for several in groups.values() for folder in several]
    for name, several in groups.items():
        if not several:
            print(f"accuracy: no recording with truth.json in {name}", file=sys.stderr)
            return 1
    parts = [] if args.append else [HEAD, *([args.about, ""] if args.about else [])]
    with ProcessPoolExecutor(args.jobs, get_context("spawn")) as pool:
        for run in runs:
            pictures = args.output.with_suffix("") / run
            compared = pool.map(partial(compare, run=run, pictures=pictures), folders)
            rows = dict(zip(folders, compared, strict=True))
            tables = {
                name: [row for folder in several if (row := rows[folder])]
                for name, several in groups.items()
            }
            parts += section(RUNS[run], tables, f"{pictures.parent.name}/{run}")
    with args.output.open("a" if args.append else "w", encoding="utf-8") as page:
        page.write("\n".join(parts) + "\n")  # a blank line before what is added
    print(args.output)
    return 0


def group(text: str) -> tuple[str, list[Path]]:
    """Name and recordings of a group, as given on the command line."""
    name, _, folders = text.rpartition("=")
    paths = [Path(folder) for folder in folders.split(",")]
    return name or paths[0].resolve().name, list(recordings(paths))


def recordings(folders: Sequence[Path]) -> Iterator[Path]:
    """Every recording with a truth, in order of name."""
    for folder in folders:
        if (folder / "truth.json").is_file():
            yield folder
        else:
            yield from sorted(path.parent for path in folder.glob("*/truth.json"))


def compare(folder: Path, run: str, pictures: Path) -> Row | None:
    """Flatten one recording, then read its truth; None where the run has no input for it."""
    protocol = folder / "protocol.json" if run == "protocol" else None
    if protocol and "views" not in json.loads(protocol.read_text(encoding="utf-8")):
        return None
    print(f"{run}: {folder.name}", file=sys.stderr)
    config = dataclasses.replace(
        Config(), method="kita2019" if run in ("protocol", "chosen") else "rotation"
    )
    if run == "drawn":
        config = dataclasses.replace(
            config, rotation=dataclasses.replace(config.rotation, draw=DRAWN)
        )
    started = time.perf_counter()
    result: dict[str, Any] = {}
    notes: list[str] = []
    replayed = None
    with tempfile.TemporaryDirectory() as scratch:
        calibration = misplaced(folder, Path(scratch)) if run == "calibration" else None
        try:
            ids = range(0, open_recording(folder).clouds or 0, 2) if run == "half" else ()
            replayed = replay_recording(
                folder, config, calibration=calibration, protocol=protocol, view_ids=ids
            )
            result = garment_result(replayed.garment, replayed.views)
            notes += [notice["code"] for notice in result["notices"]]
        except VFlattenError as error:
            notes.append(str(error).replace(str(folder), folder.name))
    seconds = time.perf_counter() - started
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    row = judged(folder, truth, result, seconds, tuple(notes))
    if row.failed and replayed is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        figure = flattening_figure(replayed.garment)
        figure.savefig(pictures / f"{row.name}.png", dpi=0.45 * DPI, metadata={"Software": None})
    return row


def misplaced(
    folder: Path, scratch: Path, shift_m: float = AXIS_SHIFT_M, tilt_rad: float = AXIS_TILT_RAD
) -> Path:
    """A calibration whose axis is off; the direction of the error depends on the name alone."""
    values = yaml.safe_load((folder / "calibration.yaml").read_text(encoding="utf-8"))
    random = np.random.default_rng(list(folder.name.encode()))
    up = np.array(values["axis_direction"])
    side = np.cross(up, random.normal(size=3))
    side /= np.linalg.norm(side)
    for key in ("axis_point", "gripper_tip"):
        values[key] = (np.array(values[key]) + shift_m * side).tolist()
    values["axis_direction"] = (rotation_about(side, tilt_rad) @ up).tolist()
    path = scratch / "calibration.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    return path


def judged(
    folder: Path,
    truth: Mapping[str, Any],
    result: Mapping[str, Any],
    seconds: float,
    notes: tuple[str, ...],
) -> Row:
    """Errors of one result."""
    errors: dict[str, float | None] = {}
    sigmas: dict[str, float | None] = {}
    for letter, key in (("W", "width"), ("L", "length")):
        value, sigma = result.get(f"{key}_m"), result.get(f"{key}_sigma_m")
        errors[letter] = None if value is None else 100.0 * (value / truth[letter] - 1.0)
        sigmas[letter] = abs(value - truth[letter]) / sigma if value and sigma else None
    moved, median = aligned(folder, result)
    outline = np.array(truth["outline"])
    return Row(
        name=folder.name,
        how=recorded(truth),
        true_category=truth["category"],
        category=result.get("category", "failed"),
        trusted=bool(result.get("trusted", False)),
        error_pct=errors,
        in_sigmas=sigmas,
        point_median_m=median,
        overlap=None if moved is None else overlap(moved, outline),
        landmark_median_m=landmark_error(truth, result),
        seconds=seconds,
        notes=notes,
        probability=probability(result),
        quality=result.get("quality"),
    )


def probability(result: Mapping[str, Any]) -> float | None:
    """Of the category that a result names; None where its scores are no probabilities."""
    if result.get("score_kind") != "probability":
        return None
    return float(result["scores"][result["category"]])


def recorded(truth: Mapping[str, Any]) -> str:
    """Size, and what differs from 24 views at rest, 1.3 m away, 1 mm of noise and no wall."""
    parts = [f"{100 * truth['W']:.0f} x {100 * truth['L']:.0f} cm"]
    if len(truth["views"]) != 24:
        parts.append(f"{len(truth['views'])} views")
    if truth["noise"] != 1.0:
        parts.append(f"noise {truth['noise']:g} mm")
    away_m = truth["wrist_to_optical"]["t"][2]
    if away_m > USUAL_M:
        parts.append(f"{away_m:.1f} m away")
    parts += ["wall"] * bool(truth["wall"]) + ["turning"] * bool(truth["continuous"])
    return ", ".join(parts)


def aligned(folder: Path, result: Mapping[str, Any]) -> tuple[Float | None, float | None]:
    """The outline moved onto the truth as the points fit it best, and their median error."""
    points = result.get("points")
    if not points or not points["u"]:
        return None, None
    with np.load(folder / "truth.npz") as pixels:
        shape = [
            int(max(pixels[key].max(), max(points[key]))) + 1 for key in ("view", "row", "col")
        ]
        place = np.full(shape, -1)
        place[pixels["view"], pixels["row"], pixels["col"]] = np.arange(len(pixels["u"]))
        index = place[points["view"], points["row"], points["col"]]
        true = np.c_[pixels["u"], pixels["v"]].astype(float)[index[index >= 0]]
    flat = np.c_[points["u"], points["v"]][index >= 0]
    keep = np.ones(len(flat), dtype=bool)
    for _ in range(4):  # the farthest tenth does not decide the pose
        center, target = flat[keep].mean(axis=0), true[keep].mean(axis=0)
        left, _, right = np.linalg.svd((flat[keep] - center).T @ (true[keep] - target))
        turn = left @ right  # mirror images are allowed: the two sides look alike
        distance = np.linalg.norm((flat - center) @ turn + target - true, axis=1)
        keep = distance <= np.quantile(distance, 0.9)
    outline = np.array(result["contour_uv"]).reshape(-1, 2)
    return (outline - center) @ turn + target, float(np.median(distance))


def overlap(a: Float, b: Float) -> float:
    """Intersection over union of two polygons."""
    low = np.minimum(a.min(axis=0), b.min(axis=0)) - 2 * PIXEL_M
    size = np.ceil((np.maximum(a.max(axis=0), b.max(axis=0)) - low) / PIXEL_M).astype(int) + 2
    images = []
    for polygon in (a, b):
        image = np.zeros(size[::-1], dtype=np.uint8)
        cv2.fillPoly(image, [np.rint((polygon - low) / PIXEL_M).astype(np.int32)], 1)
        images.append(image > 0)
    return float((images[0] & images[1]).sum() / max(int((images[0] | images[1]).sum()), 1))


def landmark_error(truth: Mapping[str, Any], result: Mapping[str, Any]) -> float | None:
    """Median distance of the hanging landmarks that some view shows.

    Left and right may be exchanged, all together: front and back look alike. The naming with the
    smaller mean counts, of those that name the most.
    """
    rotation, shift = (np.array(truth["wrist_to_optical"][key]) for key in "Rt")
    given = {m["name"]: m["xyz"] for m in result.get("landmarks", ()) if m["xyz"] is not None}
    mirrored = {"left": "right", "right": "left"}
    namings = []
    for swap in (False, True):
        found = []
        for name, mark in truth["landmarks"].items():
            side, _, rest = name.partition("_")
            asked = f"{mirrored[side]}_{rest}" if swap and side in mirrored else name
            if any(mark["visible"]) and asked in given:
                true = rotation @ np.array(mark["hanging"]) + shift
                found.append(float(np.linalg.norm(np.array(given[asked]) - true)))
        namings.append(found)
    most = max(map(len, namings))
    best = min((n for n in namings if n and len(n) == most), key=np.mean, default=None)
    return None if best is None else float(np.median(best))


def section(title: str, tables: Mapping[str, Sequence[Row]], pictures: str) -> list[str]:
    """One run: its figures of merit, the table of each group, and what failed."""
    lines = [f"## {title}", "", *figures_of_merit(tables), "", *how_sure(tables)]
    for name, rows in tables.items():
        lines += [f"### {name[0].upper()}{name[1:]}", "", *table(rows), ""]
        for row in (row for row in rows if row.failed):
            lines += [f"**{row.name}**: " + ("; ".join(row.notes) or "no notice"), ""]
            if row.category != "failed":
                lines += [f"![flattened {row.name}]({pictures}/{row.name}.png)", ""]
    return lines


def table(rows: Sequence[Row]) -> list[str]:
    """One line a recording."""
    names = [
        "recording",
        "category",
        "W",
        "L",
        "points",
        "overlap",
        "landmarks",
        "trusted",
        "seconds",
    ]
    lines = ["| " + " | ".join(names) + " |", "|" + " --- |" * len(names)]
    for row in rows:
        category = row.category if row.right else f"**{row.category}**, is {row.true_category}"
        cells = [
            f"{row.name}: {row.how}",
            category.replace("_", " "),
            *(_size(row, letter) for letter in "WL"),
            _centimetres(row.point_median_m),
            "" if row.overlap is None else f"{row.overlap:.3f}",
            _centimetres(row.landmark_median_m),
            "yes" if row.trusted else "no",
            f"{row.seconds:.1f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _size(row: Row, letter: str) -> str:
    error, sigmas = row.error_pct[letter], row.in_sigmas[letter]
    return "" if error is None or sigmas is None else f"{error:+.1f} % ({sigmas:.1f} σ)"


def _centimetres(value_m: float | None) -> str:
    return "" if value_m is None else f"{100 * value_m:.2f} cm"


def figures_of_merit(tables: Mapping[str, Sequence[Row]]) -> list[str]:
    """Numbers and means of each group, of all, and of those that the result itself trusts."""
    names = [
        "recordings",
        "number",
        "right",
        "trusted",
        "W, L: mean",
        "worst",
        "within one σ",
        "within two",
        "points",
        "overlap",
        "landmarks",
    ]
    lines = ["| " + " | ".join(names) + " |", "|" + " --- |" * len(names)]
    everything = [row for rows in tables.values() for row in rows]
    groups = {**tables, "all": everything}
    if len(tables) == 1:
        del groups["all"]
    groups["those that are trusted"] = [row for row in everything if row.trusted]
    for name, rows in groups.items():
        sizes = [abs(e) for row in rows for e in row.error_pct.values() if e is not None]
        sigmas = [s for row in rows for s in row.in_sigmas.values() if s is not None]
        named = [row for row in rows if "ends_alike" not in row.notes]
        cells = [
            name,
            f"{len(rows)}",
            f"{sum(row.right for row in rows)}",
            f"{sum(row.trusted for row in rows)}",
            f"{np.mean(sizes):.1f} %" if sizes else "",
            f"{max(sizes):.1f} %" if sizes else "",
            _share(sigmas, 1) if sigmas else "",
            _share(sigmas, 2) if sigmas else "",
            _centimetres(_mean(rows, "point_median_m")),
            f"{_mean(rows, 'overlap') or 0:.3f}",
            f"{_centimetres(_mean(rows, 'landmark_median_m'))} "
            f"({_centimetres(_mean(named, 'landmark_median_m'))})",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return [
        *lines,
        "",
        "Means over the recordings; landmarks in brackets: without items whose ends are alike, of "
        "which nothing but the hold tells which is called top.",
    ]


def how_sure(tables: Mapping[str, Sequence[Row]]) -> list[str]:
    """Whether categories are right as often as they are said to be, and what the quality tells."""
    everything = [row for rows in tables.values() for row in rows]
    told = [row for row in everything if row.probability is not None]
    lines: list[str] = []
    if told:
        lines += ["| probability of the category | results | its mean | right |"]
        lines += ["| --- | --- | --- | --- |"]
        for name, low, high in SURE:
            rows = [row for row in told if low <= (row.probability or 0.0) < high]
            if rows:
                mean = float(np.mean([row.probability for row in rows]))
                right = float(np.mean([row.right for row in rows]))
                lines.append(f"| {name} | {len(rows)} | {mean:.3f} | {right:.3f} |")
        lines.append("")
    errors = {
        "median error of the points": [row.point_median_m for row in everything],
        "overlap": [None if row.overlap is None else -row.overlap for row in everything],
        "larger error of W and L": [
            max((abs(e) for e in row.error_pct.values() if e is not None), default=None)
            for row in everything
        ],
    }
    found = []
    for name, values in errors.items():
        pairs = [
            (row.quality, value)
            for row, value in zip(everything, values, strict=True)
            if row.quality is not None and value is not None
        ]
        if len(pairs) >= FEWEST_RANKED:
            found.append(f"{spearmanr(*zip(*pairs, strict=True)).statistic:+.2f} ({name})")
    if found:
        lines += [
            "Rank correlation (Spearman) of the quality with how wrong a result is: "
            + ", ".join(found)
            + ". -1: the better the quality, the better the result; 0: it tells nothing.",
            "",
        ]
    return lines


def _share(sigmas: Sequence[float], limit: float) -> str:
    return f"{100 * np.mean(np.array(sigmas) <= limit):.0f} %"


def _mean(rows: Sequence[Row], name: str) -> float | None:
    values = [v for row in rows if (v := getattr(row, name)) is not None]
    return float(np.mean(values)) if values else None


if __name__ == "__main__":
    sys.exit(main())
