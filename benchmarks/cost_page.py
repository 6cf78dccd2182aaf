"""The part of docs/benchmarks.md about cost against size: a table, a figure."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from report import row, table_head, write_part

Seconds = Mapping[str, Mapping[str, float]]  # stage -> size -> CPU seconds
PANELS = ("points", "lines", "views")
TITLE = "Cost against size"
ABOUT = """CPU seconds of one thread, the best of up to three runs, by `make bench ARGS=--docs`.
The exponent is the slope of a straight line through log(seconds) over log(size): 1 is a cost in
proportion to size. Clouds are view 0 of `bags/LS1_1`, resized: 172,800 points are its own
480 x 360, 1,228,800 are 1280 x 960. Surfaces, patches and lines are on a curtain with folds of
20 mm seen on finer and finer grids; pixels much finer than the fit can tell apart are put together
first.{views}"""
CARRIED = """
Views are those of `bags/LS1_1`: every other one, all, and all two and four times, with noise of
their own."""
RECORDED = """
Views are those of recordings of one shirt by the simulation that made `bags/`, alike
but for the number of views (`--rotations`); they are not carried with the code. How many
ways to lay it flat are tried differs between them, and counts more than the number of views."""


def exponent(sizes: Mapping[str, float]) -> float:
    """Power of size with which the cost grows; nan of one size."""
    if len(sizes) < 2:
        return float("nan")
    size, seconds = np.array([(int(n), s) for n, s in sizes.items()]).T
    return float(np.polyfit(np.log(size), np.log(seconds), 1)[0])


def write_page(found: Seconds, page: Path, picture: Path, carried: bool) -> None:
    """Write the part of the page and its figure."""
    draw(found, picture)
    host = (
        f"Python {platform.python_version()}, numpy {np.__version__}, {platform.machine()}, "
        f"{os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f}."
    )
    lines = [ABOUT.format(views=CARRIED if carried else RECORDED), "", host, ""]
    lines += [f"![cost against size]({picture.relative_to(page.parent)})"]
    lines += table_head("Seconds", ["stage", "sizes", "seconds", "exponent"])
    for stage, sizes in found.items():
        if len(sizes) < 2:
            continue
        ordered = sorted(sizes, key=int)
        numbers = ", ".join(f"{sizes[n]:.3f}" for n in ordered)
        counts = " / ".join(f"{int(n):,}" for n in ordered)
        lines.append(row([stage, counts, numbers.replace(", ", " / "), f"{exponent(sizes):.2f}"]))
    write_part(page, TITLE, "\n".join(lines))


def draw(found: Seconds, path: Path) -> None:
    """Seconds over points, lines and views, beside what is in proportion to size."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullFormatter

    figure, axes = plt.subplots(1, 3, figsize=(10, 3.6), layout="constrained")
    for unit, axis in zip(PANELS, axes, strict=True):
        for stage, sizes in found.items():
            if _unit(stage) == unit and len(sizes) > 1:
                size, seconds = np.array(sorted((int(n), s) for n, s in sizes.items())).T
                name = stage.replace(", points of an", ",").removesuffix(f", {unit}")
                axis.loglog(size, seconds, "o-", label=f"{name} ({exponent(sizes):.2f})")
        low, high = axis.get_xlim()
        bottom, top = axis.get_ylim()
        for start in np.geomspace(bottom / 1e3, top, 12):
            line = (start, start * high / low)
            axis.plot((low, high), line, ":", color="0.8", linewidth=0.7, zorder=0)
        axis.set(xlabel=unit, xlim=(low, high), ylim=(bottom, top))
        for scale in (axis.xaxis, axis.yaxis):
            scale.set_major_locator(LogLocator(subs=(1, 2, 5) if unit != "points" else (1,)))
            scale.set_major_formatter("{x:,.15g}")
            scale.set_minor_formatter(NullFormatter())
        axis.legend(frameon=False, fontsize=7)
    axes[0].set_ylabel("CPU seconds")
    figure.suptitle("dotted: in proportion to size; in brackets: exponent", fontsize=8)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _unit(stage: str) -> str:
    about = stage.partition(", ")[2]
    return next(unit for unit in PANELS if about.startswith(unit))
