#!/usr/bin/env python3
"""What other cameras and livelier items would do to the results: writes docs/cameras.md.

    cameras.py [FOLDER ...] [--jobs N] [--output FILE]

Each FOLDER is a recording with truth.json and truth.npz, or holds such recordings (default: bags/).
Its clouds are altered as they are read: fewer points, other errors of depth, an item that bends
as it swings. All views are flattened, with no manual input, and compared with the truth, which
is read only after the result is there.
"""

# ruff: noqa: E402  (threads must be limited before numpy is imported)

from __future__ import annotations

from vflatten_ros import threads

threads.use_one()  # as the command does: the same bits

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from accuracy import ROOT, Row, judged, recordings
from numpy.typing import NDArray
from report import row, table_head

from vflatten_ros.bag import (
    RecordedCloud,
    RecordedJoints,
    Recording,
    gather_views,
    open_recording,
)
from vflatten_ros.categories import load_templates
from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import VFlattenError
from vflatten_ros.core.pipeline import flatten_garment
from vflatten_ros.core.values import Cloud
from vflatten_ros.files import calibration_beside, load_calibration
from vflatten_ros.results import garment_result

Image = NDArray[np.float32]  # (rows, cols): depth, m, NaN where unmeasured
Random = np.random.Generator
STEP_AT_M = 1.3  # depth at which steps of disparity are named
BUMP_PX = 6.0  # standard deviation of the blur that makes bumps
SEED = 5

HEAD = """# Other cameras

Written by `benchmarks/cameras.py`; do not edit.

The recordings of [accuracy.md](accuracy.md) have the errors of one simulated stereo rig. Here the
clouds of {count} of them ({names}) were altered as they
were read, each view by other chance, and flattened with all views and no manual input. No real
camera is like any line of this table; it shows what kind of error matters. "Right" is the category;
sizes are errors of W and L, in per cent; "points" is the mean over the recordings of the median
distance of flattened points from the truth. An unorganised cloud, or one with fewer pixels, has no
pixels by which its points could be compared with the truth. What is done about bumps and fat edges,
and why filters of the depth are better turned off, is in [rotation.md](rotation.md).
"""


@dataclass(frozen=True)
class Rig:
    """That the recording was made with; optical frame."""

    fx: float  # px
    fy: float
    cx: float
    cy: float
    top_m: float  # y of the gripper tip


@dataclass(frozen=True)
class Camera:
    """Another way to see the item."""

    name: str
    alter: Callable[[Cloud, Random, Rig], Cloud]
    same_pixels: bool = True  # its pixels are those of the recording
    trim_px: int = 0  # setting that suits it


def as_recorded(cloud: Cloud, random: Random, rig: Rig) -> Cloud:
    """No change."""
    return cloud


def half_resolution(cloud: Cloud, random: Random, rig: Rig) -> Cloud:
    """Every second row and column."""
    rgb = None if cloud.rgb is None else np.ascontiguousarray(cloud.rgb[::2, ::2])
    return dataclasses.replace(cloud, xyz=np.ascontiguousarray(cloud.xyz[::2, ::2]), rgb=rgb)


def unorganised(cloud: Cloud, random: Random, rig: Rig) -> Cloud:
    """One point in each cube of 3 mm, in no image, without colour."""
    points = cloud.xyz[np.isfinite(cloud.xyz[..., 2])]
    _, first = np.unique(np.round(points / 0.003).astype(np.int64), axis=0, return_index=True)
    return dataclasses.replace(cloud, xyz=points[np.sort(first)][None], rgb=None)


def steps(cloud: Cloud, random: Random, rig: Rig, step_m: float) -> Cloud:
    """Disparity in whole steps."""
    step = step_m / STEP_AT_M**2
    with np.errstate(divide="ignore"):
        return _at_depth(cloud, 1.0 / (np.round(1.0 / cloud.xyz[..., 2] / step) * step))


def bumps(cloud: Cloud, random: Random, rig: Rig, height_m: float) -> Cloud:
    """Errors that neighbouring pixels share."""
    noise = cv2.GaussianBlur(random.normal(size=cloud.xyz.shape[:2]), (0, 0), BUMP_PX)
    return _at_depth(cloud, cloud.xyz[..., 2] + height_m * noise / noise.std())


def holes(cloud: Cloud, random: Random, rig: Rig, count: int) -> Cloud:
    """Ellipses, 8 to 28 pixels across, in which nothing was measured."""
    rows, cols = cloud.xyz.shape[:2]
    missing = np.zeros((rows, cols), np.uint8)
    for _ in range(count):
        center = int(random.uniform(0.3, 0.7) * cols), int(random.uniform() * rows)
        axes = tuple(int(a) for a in random.uniform(4, 14, 2))
        cv2.ellipse(missing, center, axes, 0.0, 0.0, 360.0, 1, -1)
    return dataclasses.replace(cloud, xyz=_where(missing > 0, np.nan, cloud.xyz))


def floating(cloud: Cloud, random: Random, rig: Rig) -> Cloud:
    """Pixels beside every step of depth float before and behind it."""
    depth, measured = cloud.xyz[..., 2], np.isfinite(cloud.xyz[..., 2])
    around = np.ones((3, 3), np.uint8)
    near = cv2.erode(_where(measured, depth, np.inf), around)
    far = cv2.dilate(_where(measured, depth, -np.inf), around)
    between = near + (np.minimum(far - near, 0.1)) * random.random(depth.shape)
    return _at_depth(cloud, _where(measured & (far - near > 0.01), between, depth))


def fat(cloud: Cloud, random: Random, rig: Rig, px: int) -> Cloud:
    """Pixels beside an edge have the depth of what is in front."""
    depth = cloud.xyz[..., 2]
    known = _where(np.isfinite(depth), depth, np.inf)
    near = cv2.erode(known, np.ones((2 * px + 1, 2 * px + 1), np.uint8))
    with np.errstate(invalid="ignore"):
        depth = _where(known - near > 0.01, near, depth)
    depth = _where(np.isfinite(depth), depth, np.nan)
    row, col = np.indices(depth.shape)
    ray = [(col - rig.cx) / rig.fx, (row - rig.cy) / rig.fy]
    xyz = np.stack([ray[0] * depth, ray[1] * depth, depth], axis=-1)
    return dataclasses.replace(cloud, xyz=xyz.astype(np.float32))


def median(cloud: Cloud, random: Random, rig: Rig, px: int) -> Cloud:
    """Depth as a median filter leaves it, which cuts corners of layers."""
    depth = cloud.xyz[..., 2]
    measured = np.isfinite(depth)
    smooth = cv2.medianBlur(_where(measured, depth, 0.0), px)
    with np.errstate(invalid="ignore"):
        near = measured & (np.abs(smooth - depth) < 0.02)
    return _at_depth(cloud, _where(near, smooth, depth))


def mean(cloud: Cloud, random: Random, rig: Rig, px: int, reach_m: float = 0.015) -> Cloud:
    """Depth as the mean of the pixels around that are nearly as far, which makes steps ramps."""
    depth = cloud.xyz[..., 2]
    total, count = np.zeros_like(depth), np.zeros_like(depth)
    for rows in range(-(px // 2), px // 2 + 1):
        for cols in range(-(px // 2), px // 2 + 1):
            other = np.roll(depth, (rows, cols), (0, 1))
            with np.errstate(invalid="ignore"):
                near = np.abs(other - depth) < reach_m
            total += _where(near, other, 0.0)
            count += near
    return _at_depth(cloud, _where(count > 0, total / np.maximum(count, 1), np.nan))


def moved(cloud: Cloud, random: Random, rig: Rig, by_m: float) -> Cloud:
    """The whole item elsewhere in every view."""
    by = random.normal(0.0, by_m, 3).astype(np.float32)
    return dataclasses.replace(cloud, xyz=cloud.xyz + by)


def bent(cloud: Cloud, random: Random, rig: Rig, by_m: float) -> Cloud:
    """The item in another shape in every view: the lower, the farther it swings, in waves."""
    xyz = cloud.xyz.copy()
    below = np.clip(xyz[..., 1] - rig.top_m, 0.0, None)  # optical frame: y is down
    for axis in (0, 2):
        swing, phase = random.normal(), random.uniform(0, 2 * np.pi)
        wave = np.sin(2 * np.pi * below / 0.5 + phase) * np.clip(below / 0.3, 0, 1)
        xyz[..., axis] += by_m * (0.7 * swing * (below / 0.8) ** 2 + 0.5 * wave)
    return dataclasses.replace(cloud, xyz=xyz)


def _where(condition: NDArray[np.bool_], yes: Any, no: Any) -> Image:
    if np.ndim(no) > condition.ndim:
        condition = condition[..., None]
    return np.where(condition, yes, no).astype(np.float32)


def _at_depth(cloud: Cloud, depth: NDArray[np.floating]) -> Cloud:
    """Points moved along their rays."""
    with np.errstate(invalid="ignore"):
        xyz = cloud.xyz * (depth / cloud.xyz[..., 2])[..., None]
    return dataclasses.replace(cloud, xyz=xyz.astype(np.float32))


CAMERAS = (
    Camera("as recorded", as_recorded),
    Camera("half the rows and columns", half_resolution, same_pixels=False),
    Camera("unorganised: a point every 3 mm, no colour", unorganised, same_pixels=False),
    Camera("60 holes, 8 to 28 pixels across", partial(holes, count=60)),
    Camera("pixels float at every step of depth", floating),
    Camera("steps of disparity: 4 mm at 1.3 m", partial(steps, step_m=0.004)),
    Camera("steps of disparity: 8 mm at 1.3 m", partial(steps, step_m=0.008)),
    Camera("bumps of 1.5 mm, 15 mm across", partial(bumps, height_m=0.0015)),
    Camera("bumps of 3 mm", partial(bumps, height_m=0.003)),
    Camera("bumps of 5 mm", partial(bumps, height_m=0.005)),
    Camera("edges fat by 2 pixels", partial(fat, px=2)),
    Camera("the same, `segmentation.trim_px: 2`", partial(fat, px=2), trim_px=2),
    Camera("depth filtered: median of 5 x 5 pixels", partial(median, px=5)),
    Camera("depth filtered: mean of 5 x 5 pixels", partial(mean, px=5)),
    Camera("depth filtered: mean of 9 x 9 pixels", partial(mean, px=9)),
    Camera("the item 10 mm elsewhere in each view", partial(moved, by_m=0.010)),
    Camera("the item bent by 4 mm, otherwise in each view", partial(bent, by_m=0.004)),
    Camera("the item bent by 8 mm", partial(bent, by_m=0.008)),
)


@dataclass(frozen=True, eq=False)
class AlteredCloud(RecordedCloud):
    """A cloud as another camera would have seen it."""

    alter: Callable[[Cloud], Cloud] = dataclasses.field(kw_only=True)

    def decode(self) -> Cloud:
        return self.alter(super().decode())


class AlteredRecording(Recording):
    """A recording whose clouds are altered as they are read."""

    alter: Callable[[Cloud], Cloud]

    def messages(self) -> Iterator[RecordedCloud | RecordedJoints]:
        for message in super().messages():
            if isinstance(message, RecordedCloud):
                values = {f.name: getattr(message, f.name) for f in dataclasses.fields(message)}
                yield AlteredCloud(**values, alter=self.alter)
            else:
                yield message


def main() -> int:
    """Alter, flatten, compare, write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="*", default=[ROOT / "bags"])
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "cameras.md")
    parser.add_argument("--jobs", type=int, default=1, help="recordings at a time")
    args = parser.parse_args()
    folders = list(recordings(args.folders))
    if not folders:
        print("cameras: no recording with truth.json in the folders given", file=sys.stderr)
        return 1
    names = ", ".join(folder.name for folder in folders)
    lines = [HEAD.format(count=len(folders), names=names)]
    lines += table_head(
        "",
        ["camera", "right", "trusted", "of these right", "W, L mean", "worst of all",
         "worst of trusted", "points"],
    )[2:]  # fmt: skip
    with ProcessPoolExecutor(args.jobs, get_context("spawn")) as pool:
        tasks = [(camera.name, folder) for camera in CAMERAS for folder in folders]
        rows = list(pool.map(compare, tasks))
    for k, camera in enumerate(CAMERAS):
        of_camera = rows[k * len(folders) : (k + 1) * len(folders)]
        lines.append(row(_cells(camera.name, of_camera)))
    args.output.write_text("\n".join([*lines, ""]), encoding="utf-8")
    print(args.output)
    return 0


def compare(task: tuple[str, Path]) -> Row:
    """Flatten one altered recording, then read its truth."""
    name, folder = task
    print(f"{name}: {folder.name}", file=sys.stderr)
    camera = next(camera for camera in CAMERAS if camera.name == name)
    config = dataclasses.replace(Config(), method="rotation")
    segmentation = dataclasses.replace(config.segmentation, trim_px=camera.trim_px)
    config = dataclasses.replace(config, segmentation=segmentation)
    result: dict[str, Any] = {}
    notes: list[str] = []
    plain = open_recording(folder)
    recording = AlteredRecording(
        **{f.name: getattr(plain, f.name) for f in dataclasses.fields(plain)}
    )
    random = np.random.default_rng([SEED, *folder.name.encode()])
    calibration = load_calibration(calibration_beside(folder))
    values = yaml.safe_load((folder / "calibration.yaml").read_text(encoding="utf-8"))
    known = {name: values["camera"][name] for name in ("fx", "fy", "cx", "cy")}
    rig = Rig(**known, top_m=calibration.gripper_tip[1])
    recording.alter = partial(camera.alter, random=random, rig=rig)
    try:
        views = gather_views(recording, calibration, config).views()
        garment = flatten_garment(views, (), load_templates(), config)
        result = dict(garment_result(garment, views))
        notes = [notice["code"] for notice in result["notices"]]
    except VFlattenError as error:
        notes.append(str(error).replace(str(folder), folder.name))
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    if not camera.same_pixels:
        result.pop("points", None)
    return judged(folder, truth, result, 0.0, tuple(notes))


def _cells(name: str, rows: Sequence[Row]) -> list[object]:
    trusted = [r for r in rows if r.trusted]
    points = [r.point_median_m for r in rows if r.point_median_m is not None]
    errors, told = _sizes(rows), _sizes(trusted)
    return [
        name,
        f"{sum(r.right for r in rows)} of {len(rows)}",
        len(trusted),
        sum(r.right for r in trusted),
        f"{np.mean(errors):.1f} %" if errors else "",
        f"{max(errors):.1f} %" if errors else "",
        f"{max(told):.1f} %" if told else "",
        f"{100 * np.mean(points):.2f} cm" if points else "",
    ]


def _sizes(rows: Sequence[Row]) -> list[float]:
    return [abs(e) for r in rows for e in r.error_pct.values() if e is not None]


if __name__ == "__main__":
    sys.exit(main())
