"""The node with work of a known length in place of the method: `python quick_node.py ARGS`."""

import dataclasses
import sys
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import garments
import slow_work

from vflatten_ros import job, node


def prepare(folder):
    return partial(prepared, folder)


def prepared(folder):
    return work


def work(views, task, progress):
    """The example towel, said to be of the views asked for."""
    slow_work.work(views, task, progress)
    towel = dataclasses.replace(
        garments.example_garment(),
        view_ids=tuple(view.view_id for view in views),
        stamp_ns=max(view.stamp_ns for view in views),
        correspondences=task.correspondences,
    )
    return towel, job.serialized(towel, views)


if __name__ == "__main__":
    sys.exit(node.main(sys.argv[1:], prepare))
