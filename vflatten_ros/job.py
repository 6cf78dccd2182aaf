"""What the flattening process does with views and jobs: the method, then the result's messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakKeyDictionary

from vflatten_ros.categories import load_templates
from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import NotEnoughViews
from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import FlatGarment, Progress, View
from vflatten_ros.helper import helper_for
from vflatten_ros.messages import fill, message_class
from vflatten_ros.outputs import TYPES, result_messages
from vflatten_ros.worker import Job

if TYPE_CHECKING:
    from vflatten_ros.core.hypotheses import Helper
    from vflatten_ros.core.registration import Folded, ViewSurface


def load(categories: str, processes: int = 1) -> Flattening:
    """Ready for work with the categories of a folder ("": those of the package)."""
    helper = helper_for(processes)  # it loads meanwhile
    # now, so that the first job need not wait for it
    from rclpy.serialization import serialize_message

    import vflatten_ros.core.pipeline  # noqa: F401

    for name in TYPES.values():
        serialize_message(message_class(name)())

    return Flattening(load_templates(categories or None), helper)


class Flattening:
    """The method, with views folded in as they arrive; the numbers are the same without."""

    def __init__(self, templates: Sequence[Template], helper: Helper | None = None) -> None:
        self._templates, self._helper = templates, helper
        # goes with its view
        self._prepared: WeakKeyDictionary[View, _Prepared] = WeakKeyDictionary()
        self._folded: Folded | None = None

    def prepare(self, view: View, config: Config) -> None:
        """What flattening needs of a view whatever comes after it."""
        if self._of(view, config) is None:
            self._prepared[view] = _prepared(view, config)
        # strong references end here: to views that are gone, too
        held = sorted(self._prepared, key=lambda held: held.view_id)
        self._fold([s for s in (self._of(each, config) for each in held) if s is not None], config)

    def _fold(self, surfaces: Sequence[ViewSurface], config: Config) -> Folded:
        # not needed by the node's process
        from vflatten_ros.core.registration import fold_in

        self._folded = fold_in(surfaces, config.rotation, self._folded)
        return self._folded

    def flatten(
        self, views: Sequence[View], job: Job, progress: Progress
    ) -> tuple[FlatGarment, Mapping[str, bytes]]:
        """Flatten, and serialize the messages of the outputs by the last part of their topic."""
        from vflatten_ros.core.parallel import mapped
        from vflatten_ros.core.pipeline import flatten_garment

        progress("surface", 0.0)
        alone = job.config.method != "rotation" and (job.correspondences or len(views) < 2)
        wanted = () if alone else views  # else two views are named
        missing = [view for view in wanted if not self._is_prepared(view, job.config)]
        for number, made in enumerate(mapped(partial(_prepared, config=job.config), missing)):
            self._prepared[missing[number]] = made
            progress("surface", number / len(missing))
        of_views = [(view.view_id, self._of(view, job.config)) for view in wanted]
        prepared = {view_id: surface for view_id, surface in of_views if surface is not None}
        folded = self._fold(list(prepared.values()), job.config) if prepared else None
        garment = flatten_garment(
            views,
            job.correspondences,
            self._templates,
            job.config,
            progress,
            prepared,
            folded,
            self._helper,
        )
        progress("messages", 0.0)
        return garment, serialized(garment, views, job.item)

    def _is_prepared(self, view: View, config: Config) -> bool:
        return view in self._prepared and self._prepared[view].settings == _settings(config)

    def _of(self, view: View, config: Config) -> ViewSurface | None:
        """A view as it was prepared with these settings."""
        return self._prepared[view].surface if self._is_prepared(view, config) else None


class _Prepared(NamedTuple):
    settings: tuple[Any, ...]
    surface: ViewSurface | None  # None: it shows hardly anything; the method says it


def _settings(config: Config) -> tuple[Any, ...]:
    """What the preparation of a view depends on."""
    return config.rotation, config.correspondences.features


def _prepared(view: View, config: Config) -> _Prepared:
    from vflatten_ros.core.pipeline import prepare_view

    surface = None
    with suppress(NotEnoughViews):
        surface = prepare_view(view, config)
    return _Prepared(_settings(config), surface)


def serialized(garment: FlatGarment, views: Sequence[View], item: int = 0) -> dict[str, bytes]:
    """Every message of a result, serialized: filling them would hold up the node's callbacks."""
    from rclpy.serialization import serialize_message

    return {
        message.topic.rpartition("/")[2]: bytes(
            serialize_message(fill(message_class(message.type)(), message.fields))
        )
        for message in result_messages(garment, views, item)
    }
