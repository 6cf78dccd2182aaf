"""What the flattening process does with views and jobs: the method, then the result's messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from vflatten_ros.categories import load_templates
from vflatten_ros.core.config import Config, RotationConfig
from vflatten_ros.core.errors import NotEnoughViews
from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import FlatGarment, Progress, View
from vflatten_ros.messages import fill, message_class
from vflatten_ros.outputs import TYPES, result_messages
from vflatten_ros.worker import Job

if TYPE_CHECKING:
    from vflatten_ros.core.registration import ViewSurface


def load(categories: str) -> Flattening:
    """Ready for work with the categories of a folder ("": those of the package)."""
    # now, so that the first job need not wait for it
    from rclpy.serialization import serialize_message

    import vflatten_ros.core.pipeline  # noqa: F401

    for name in TYPES.values():
        serialize_message(message_class(name)())

    return Flattening(load_templates(categories or None))


class Flattening:
    """The method, with views prepared as they arrive; the numbers are the same without."""

    def __init__(self, templates: Sequence[Template]) -> None:
        self._templates = templates
        # goes with its view
        self._prepared: WeakKeyDictionary[View, tuple[RotationConfig, ViewSurface | None]] = (
            WeakKeyDictionary()
        )

    def prepare(self, view: View, config: Config) -> None:
        """What flattening needs of a view whatever the others are."""
        from vflatten_ros.core.pipeline import prepare_view

        if self._of(view, config) is None:
            self._prepared[view] = (config.rotation, prepare_view(view, config))

    def flatten(
        self, views: Sequence[View], job: Job, progress: Progress
    ) -> tuple[FlatGarment, Mapping[str, bytes]]:
        """Flatten, and serialize the messages of the outputs by the last part of their topic."""
        # not needed by the node's process
        from vflatten_ros.core.parallel import mapped
        from vflatten_ros.core.pipeline import flatten_garment

        progress("surface", 0.0)
        alone = job.config.method != "rotation" and (job.correspondences or len(views) < 2)
        wanted = () if alone else views  # else two views are named
        missing = [view for view in wanted if self._of(view, job.config) is None]
        for number, surface in enumerate(mapped(partial(_prepared, config=job.config), missing)):
            self._prepared[missing[number]] = (job.config.rotation, surface)
            progress("surface", number / len(missing))
        of_views = [(view.view_id, self._of(view, job.config)) for view in wanted]
        prepared = {view_id: surface for view_id, surface in of_views if surface is not None}
        garment = flatten_garment(
            views, job.correspondences, self._templates, job.config, progress, prepared
        )
        progress("messages", 0.0)
        return garment, serialized(garment, views)

    def _of(self, view: View, config: Config) -> ViewSurface | None:
        """A view as it was prepared with these settings."""
        settings, surface = self._prepared.get(view, (None, None))
        return surface if settings == config.rotation else None


def _prepared(view: View, config: Config) -> ViewSurface | None:
    """None: the view shows hardly anything; the method says it, or does without."""
    from vflatten_ros.core.pipeline import prepare_view

    with suppress(NotEnoughViews):
        return prepare_view(view, config)
    return None


def serialized(garment: FlatGarment, views: Sequence[View]) -> dict[str, bytes]:
    """Every message of a result, serialized: filling them would hold up the node's callbacks."""
    from rclpy.serialization import serialize_message

    return {
        message.topic.rpartition("/")[2]: bytes(
            serialize_message(fill(message_class(message.type)(), message.fields))
        )
        for message in result_messages(garment, views)
    }
