"""The node with a callback that is almost always at work: `python busy_node.py ARGS`."""

import sys
import time

import quick_node

from vflatten_ros import node
from vflatten_ros.flatten_node import FlattenNode


class BusyNode(FlattenNode):
    """Says when it begins a callback of half a second and when that has ended."""

    def __init__(self, **given):
        super().__init__(**given)
        self.create_timer(0.01, self._work)

    def _work(self):
        print("begins", flush=True)
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            time.sleep(0.001)
        print("ended", flush=True)


if __name__ == "__main__":
    node.FlattenNode = BusyNode
    sys.exit(node.main(sys.argv[1:], quick_node.loader))
