"""From a file to a flattened garment: what `vflatten replay` and `vflatten flatten` do."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from weakref import WeakKeyDictionary

from vflatten_ros.bag import gather_views, open_recording
from vflatten_ros.categories import load_templates
from vflatten_ros.cloud_files import cloud_to_view, load_cloud_file
from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import (
    EmptyView,
    InvalidCloud,
    InvalidCorrespondence,
    InvalidRecording,
    NotEnoughViews,
)
from vflatten_ros.core.events import CloudDropped
from vflatten_ros.core.hypotheses import Helper
from vflatten_ros.core.parallel import THREADS
from vflatten_ros.core.pipeline import flatten_garment, prepare_view
from vflatten_ros.core.registration import ViewSurface
from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import Correspondence, FlatGarment, Progress, View, no_progress
from vflatten_ros.files import calibration_beside, load_calibration, load_protocol
from vflatten_ros.messages import checked_correspondence

FEWEST_PAIRS = 2  # that fix one view's place in the plane of the other


@dataclass(frozen=True, eq=False)
class Replayed:
    """A flattened garment and where it came from."""

    garment: FlatGarment
    views: tuple[View, ...]  # that the method was given
    templates: tuple[Template, ...]
    source: str
    clouds: int
    drops: Mapping[str, int]  # reason -> clouds that gave no view
    notes: tuple[str, ...] = ()  # what was chosen


def replay_recording(
    path: Path,
    config: Config,
    *,
    calibration: Path | None = None,
    protocol: Path | None = None,
    view_ids: Sequence[int] = (),
    cloud_topic: str | None = None,
    joint_topic: str | None = None,
    progress: Progress = no_progress,
    warn: Callable[[str], None] = lambda text: None,
    helper: Helper | None = None,
) -> Replayed:
    """Flatten the item of a recorded rotation.

    Parameters
    ----------
    path : Path
        rosbag2 folder or .mcap file.
    config : Config
    calibration : Path, optional
        By default calibration.yaml beside the recording.
    protocol : Path, optional
        Views and corresponding points that a person chose.
    view_ids : sequence of int
        Use these views only; the protocol's, or all, if empty.
    cloud_topic, joint_topic : str, optional
        Where the recording has several of the type.
    progress : Progress
    warn : callable
        Told what went wrong and could be worked round.
    helper : Helper, optional
        Another process that shares the work of method rotation.

    Raises
    ------
    VFlattenError
        Says what came, what was expected, what to try.
    """
    progress("open", 0.0)
    templates = load_templates()
    if not path.exists():
        raise InvalidRecording(f"{path}: no such recording; give a rosbag2 folder or an .mcap file")
    rig = load_calibration(calibration or calibration_beside(path))
    chosen, pairs = load_protocol(protocol) if protocol else ((), ())
    wanted = tuple(view_ids) or chosen
    recording = open_recording(path, cloud_topic, joint_topic)
    with _Preparation(config, wanted) as preparation:
        gathering = _keeping_all(config) if wanted else config
        dropped: dict[int, CloudDropped] = {}
        buffer = gather_views(
            recording,
            rig,
            gathering,
            progress,
            preparation.begin,
            lambda event: dropped.update({event.view_id: event}),
        )
        for text in recording.warnings:
            warn(text)
        state = buffer.state()
        views = _select(buffer.views(), wanted, dropped, path)
        if config.method == "rotation" and len(views) < 2:
            raise NotEnoughViews(
                f"{path}: method rotation needs two views or more, got {len(views)}; use more of "
                "them, or flatten what one view shows with --method kita2019"
            )
        kept = _check_pairs(pairs, views, protocol, config.integration.pair_reach_px, warn)
        prepared = preparation.of(views, progress)
    garment = flatten_garment(views, kept, templates, config, progress, prepared, helper=helper)
    return Replayed(
        garment=garment,
        views=views,
        templates=templates,
        source=str(path),
        clouds=state.clouds_received,
        drops=state.drops,
        notes=recording.guessed,
    )


def flatten_file(
    path: Path,
    config: Config,
    *,
    up: Sequence[float],
    crop: Sequence[float] | None = None,
    progress: Progress = no_progress,
) -> Replayed:
    """Flatten what one cloud shows, without a robot.

    Parameters
    ----------
    path : Path
        .ply, .npy or .npz.
    config : Config
    up : three numbers
        Upwards in the cloud's frame.
    crop : six numbers, optional
        Least x, y, z, then greatest x, y, z of the item, m.
    progress : Progress

    Raises
    ------
    VFlattenError
        Says what came, what was expected, what to try.
    """
    progress("open", 0.0)
    templates = load_templates()
    cloud = load_cloud_file(path)
    try:
        view = cloud_to_view(cloud, up, crop, config.segmentation)
    except (EmptyView, InvalidCloud) as error:
        raise type(error)(f"{path}: {error}") from error
    garment = flatten_garment((view,), (), templates, config, progress)
    return Replayed(garment, (view,), templates, str(path), clouds=1, drops={})


class _Preparation:
    """Prepares views on other threads while the next are read. A context."""

    def __init__(self, config: Config, wanted: Sequence[int]) -> None:
        self._config, self._wanted = config, frozenset(wanted)
        self._pool = ThreadPoolExecutor(THREADS)
        # goes with its view, as when a new item begins
        self._begun: WeakKeyDictionary[View, Future[ViewSurface | None]] = WeakKeyDictionary()

    def __enter__(self) -> _Preparation:
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def begin(self, view: View) -> None:
        if not self._wanted or view.view_id in self._wanted:
            self._begun[view] = self._pool.submit(prepare_view, view, self._config)

    def of(self, views: Sequence[View], progress: Progress) -> dict[int, ViewSurface]:
        """What flatten_garment takes: of views that show enough of the item."""
        prepared = {}
        for number, view in enumerate(views):
            progress("surface", number / len(views))
            surface = None
            with suppress(NotEnoughViews):  # the method says it
                surface = self._begun[view].result()
            if surface is not None:
                prepared[view.view_id] = surface
        return prepared


def _keeping_all(config: Config) -> Config:
    """Views that are asked for by id do not give way to others at the same angle."""
    buffer = dataclasses.replace(config.buffer, duplicate_angle_deg=0.0)
    return dataclasses.replace(config, buffer=buffer)


def _select(
    views: Sequence[View], wanted: Sequence[int], dropped: Mapping[int, CloudDropped], path: Path
) -> tuple[View, ...]:
    by_id = {view.view_id: view for view in views}
    for i in wanted:
        if i not in by_id:
            known = ", ".join(str(i) for i in by_id)
            why = "is not in the recording"
            if i in dropped:
                why = f"gave no view, {dropped[i].reason}: {dropped[i].text}"
            raise NotEnoughViews(f"{path}: cloud {i} {why}; there are views {known}")
    return tuple(by_id[i] for i in wanted) if wanted else tuple(views)


def _check_pairs(
    pairs: Sequence[Correspondence],
    views: Sequence[View],
    protocol: Path | None,
    reach_px: float,
    warn: Callable[[str], None],
) -> tuple[Correspondence, ...]:
    """The corresponding points that lie on the item; InvalidCorrespondence if they are too few."""
    by_id = {view.view_id: view for view in views}
    kept: list[Correspondence] = []
    refused: list[str] = []
    for number, pair in enumerate(pairs):
        try:
            kept.append(checked_correspondence(pair, by_id, reach_px))
        except InvalidCorrespondence as error:
            refused.append(f"corresponding point {number} left out: {error}")
    if protocol is not None and len(kept) < FEWEST_PAIRS:
        more = f"; and {len(refused) - 1} more" if len(refused) > 1 else ""
        raise InvalidCorrespondence(
            f"{protocol}: {len(kept)} of {len(pairs)} corresponding points are usable, at least "
            f"{FEWEST_PAIRS} are needed; {refused[0] + more if refused else 'give more pairs'}"
        )
    for text in refused:
        warn(text)
    return tuple(kept)
