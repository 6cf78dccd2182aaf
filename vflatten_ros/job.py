"""What the flattening process does with a job: the method, then the messages of its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from vflatten_ros.categories import load_templates
from vflatten_ros.core.templates import Template
from vflatten_ros.core.values import FlatGarment, Progress, View
from vflatten_ros.messages import fill, message_class
from vflatten_ros.outputs import TYPES, result_messages
from vflatten_ros.worker import Job, Work


def prepare(categories: str) -> Work:
    """Load the categories of a folder ("": those of the package)."""
    # now, so that the first job need not wait for it
    from rclpy.serialization import serialize_message

    import vflatten_ros.core.pipeline  # noqa: F401

    for name in TYPES.values():
        serialize_message(message_class(name)())

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
            serialize_message(fill(message_class(message.type)(), message.fields))
        )
        for message in result_messages(garment, views)
    }
