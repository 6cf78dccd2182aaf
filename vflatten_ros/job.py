"""What the flattening process does with a job: the method, then the messages of its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import Any

from vflatten_ros.categories import load_templates
from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import FlatGarment, Progress, View
from vflatten_ros.messages import fill
from vflatten_ros.outputs import result_messages
from vflatten_ros.worker import Job, Work


def prepare(categories: str) -> Work:
    """Load the categories of a folder ("": those of the package)."""
    # now, so that the first job need not wait for them
    import rclpy.serialization  # noqa: F401
    from visualization_msgs.msg import MarkerArray

    import vflatten_ros.core.pipeline  # noqa: F401

    MarkerArray()

    return partial(flatten, load_templates(categories or None))


def flatten(
    templates: Sequence[Template], views: Sequence[View], job: Job, progress: Progress
) -> tuple[FlatGarment, Mapping[str, bytes]]:
    """Flatten, and serialize the messages of the outputs by the last part of their topic."""
    from vflatten_ros.core.pipeline import flatten_garment  # not needed by the node's own process

    garment = flatten_garment(views, job.correspondences, templates, job.config, progress)
    progress("messages", 0.0)
    return garment, serialized(garment, views)


def serialized(garment: FlatGarment, views: Sequence[View]) -> dict[str, bytes]:
    """Every message of a result, serialized: filling them would hold up the node's callbacks."""
    from rclpy.serialization import serialize_message

    return {
        message.topic.rpartition("/")[2]: bytes(
            serialize_message(fill(_class_of(message.type)(), message.fields))
        )
        for message in result_messages(garment, views)
    }


def _class_of(name: str) -> Any:
    """The class of "package/Message"."""
    package, message = name.split("/")
    return getattr(import_module(f"{package}.msg"), message)
