"""The node with work of a known length in place of the method: `python quick_node.py ARGS`."""

import dataclasses
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import slow_work

from vflatten_ros import job, node


class QuickWork(slow_work.SlowWork):
    """Gives the example towel, said to be of the views asked for."""

    def flatten(self, views, task, progress):
        towel = dataclasses.replace(
            slow_work.example_or_trouble(task.config.geodesics.nodes, progress),
            view_ids=tuple(view.view_id for view in views),
            stamp_ns=max(view.stamp_ns for view in views),
            correspondences=task.correspondences,
            enough=len(views) >= slow_work.ENOUGH,
        )
        return towel, job.serialized(towel, views, task.item)


def loader(folder):
    return QuickWork


if __name__ == "__main__":
    sys.exit(node.main(sys.argv[1:], loader))
