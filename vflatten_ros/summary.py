"""The table that the command line ends with."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from vflatten_ros.core.buffer import DROP_REASONS
from vflatten_ros.core.values import FlatGarment, Measurement
from vflatten_ros.replay import Replayed

BESIDE_THE_METHOD = (
    "open",
    "views",
    "mcap",
    "figures",
)  # before the last view, or after the result


def summary(replayed: Replayed, seconds: Mapping[str, float]) -> str:
    """Category, sizes, what was used, what was dropped and why, wall time per stage."""
    garment, drops = replayed.garment, replayed.drops
    rows = [
        ("source", replayed.source),
        *(("", note) for note in replayed.notes),
        ("category", _category(garment)),
        *((m.name.replace("_", " "), _size(m)) for m in _sizes(garment)),
        ("used", _used(garment)),
        ("clouds", f"{replayed.clouds} read, {sum(drops.values())} dropped"),
        *(
            ("", f"{count} {reason}: {DROP_REASONS.get(reason, '')}")
            for reason, count in drops.items()
        ),
        ("seen", f"{garment.coverage:.0%} of the item; quality {garment.quality:.2f} of 1"),
        *(("notice", f"{notice.code}: {notice.text}") for notice in garment.notices),
        ("time", _times(seconds)),
    ]
    width = max(len(name) for name, _ in rows) + 2
    return "\n".join(f"{name:<{width}}{text}" for name, text in _merged(rows))


def _category(garment: FlatGarment) -> str:
    ranked = sorted(garment.scores.items(), key=lambda item: (-item[1], item[0]))
    kind = "R" if garment.score_kind == "R" else "p"
    scores = ", ".join(f"{name} {score:.2f}" for name, score in ranked)
    return f"{garment.category} ({kind}: {scores})"


def _sizes(garment: FlatGarment) -> list[Measurement]:
    first = {"width": 0, "length": 1}
    return sorted(garment.measurements, key=lambda m: first.get(m.name, 2))


def _size(measurement: Measurement) -> str:
    value = f"{100 * measurement.value_m:5.1f} ± {100 * measurement.sigma_m:.1f} cm"
    return f"{value}  inferred, not seen" if measurement.inferred else value


def _used(garment: FlatGarment) -> str:
    ids = _ranges(garment.view_ids)
    pairs = len(garment.correspondences)
    given = sum(pair.manual for pair in garment.correspondences)
    points = f"; {pairs} corresponding points, {given} given by hand" if pairs else ""
    return f"method {garment.method}, views {ids}{points}"


def _ranges(ids: Sequence[int]) -> str:
    """1, 2, 3, 7 -> "1-3, 7"."""
    runs: list[list[int]] = []
    for i in sorted(ids):
        if runs and i == runs[-1][-1] + 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    return ", ".join(
        f"{run[0]}-{run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs
    )


def _times(seconds: Mapping[str, float]) -> str:
    shown = [f"{stage} {value:.2f}" for stage, value in seconds.items() if value >= 0.005]
    after = sum(value for stage, value in seconds.items() if stage not in BESIDE_THE_METHOD)
    total = sum(seconds.values())
    return f"{total:.2f} s, {after:.2f} s after the last view: {', '.join(shown)}"


def _merged(rows: Iterable[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """A name is written once where several rows in a row share it."""
    before = None
    for name, text in rows:
        yield ("" if name == before else name), text
        before = name
