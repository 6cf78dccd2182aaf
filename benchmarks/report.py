"""Tables of `make bench-peers`."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def cell(error: Float) -> str:
    if not len(error):
        return "failed"
    size = np.abs(error)
    return f"{np.median(size):.2f} / {np.percentile(size, 95):.2f} / {np.median(error):+.2f}"


def table_head(title: str, columns: list[str]) -> list[str]:
    return ["", f"### {title}", "", row(columns), row(["---"] * len(columns))]


def row(cells: list[Any]) -> str:
    return "| " + " | ".join(str(c) for c in cells) + " |"


def write_part(page: Path, title: str, text: str) -> None:
    """Replace the part of a page under `## title`, or add it at the end."""
    parts = page.read_text(encoding="utf-8").rstrip("\n").split("\n## ")
    new = f"{title}\n\n{text.strip()}\n"
    at = [k for k, part in enumerate(parts) if k and part.startswith(f"{title}\n")]
    parts[at[0] if at else len(parts) :] = [new, *parts[(at[0] + 1 if at else len(parts)) :]]
    page.write_text("\n\n## ".join(part.strip() for part in parts) + "\n", encoding="utf-8")


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


# key of build/bench-peers.json: what it is, the largest that will do, what we aim at
NEEDED = {
    "geodesic_p95_vs_paper": ("lines, p95 against the paper's, curtains 20, 40 mm", 0.35, 0.15),
    "geodesic_p95_vs_best": ("lines, p95 against the better of edge flip and ARAP", 1.0, 0.5),
    "geodesic_bias_pct": ("lines, largest median bias, %", 0.1, 0.05),
    "geodesic_time_vs_edge_flip": ("lines, time of a batch of 400 against edge flip", 1 / 3, 1 / 8),
    "steep_p95_vs_edge_flip": ("steep border, p95 against edge flip", 0.7, 0.3),
    "unflagged_errors": ("unflagged errors above 5 % at jumps, flaps and gaps", 0, 0),
    "flatten_rms_vs_arap": ("flattening, RMS against ARAP", 1.0, 0.5),
    "flatten_worst_vs_arap": ("flattening, worst boundary length against ARAP", 1.0, 0.5),
    "flatten_time_vs_arap": ("flattening, time against ARAP", 0.5, 0.5),
    "slit_or_stripe_vs_uncut": (
        "flattening with a slit or a stripe missing against uncut",
        1.3,
        1.1,
    ),
}


def summary(keys: dict[str, Any]) -> list[str]:
    lines = table_head("Summary", ["figure", "found", "needed", "aim"])
    for name, (text, needed, aim) in NEEDED.items():
        found = keys[name] if isinstance(keys[name], int) else f"{keys[name]:.3f}"
        lines.append(row([text, found, f"{needed:.3g}", f"{aim:.3g}"]))
    return lines


def machine() -> str:
    names = ("numpy", "scipy", "potpourri3d", "libigl", "pygeodesic", "scikit-learn", "pymeshlab")
    versions = []
    for name in names:
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            versions.append(f"{name} -")
    host = f"Python {platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores"
    return f"{host}; {', '.join(versions)}."


TITLE = "Beside other libraries"
INTRO = """Written by `make bench-peers`. Surfaces are developable, so the exact distance is that of
their unrolling. They are seen on a 2.5 mm grid with noise along the view, independent from pixel to
pixel unless said otherwise, and turned in the image. Errors of lines are median / 95th percentile /
median signed error in per cent, over pairs of 5 to 40 cm. Other libraries get the points after a
quadratic fit with a Gaussian weight of 7.5 mm ("smooth +"), which they do not bring. Ratios of
errors are ratios of means over surfaces and over 1 and 2 mm of noise. Times are CPU seconds of one
thread.
"""
