"""Work on two threads: numpy and scipy's trees let go of Python's lock while they compute.

Results come in order and do not depend on how many threads there are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

THREADS = 2  # cores that a robot's computer has to spare

Item = TypeVar("Item")
Done = TypeVar("Done")


def mapped(work: Callable[[Item], Done], items: Iterable[Item]) -> Iterator[Done]:
    """What `work` makes of each item, in order; what has not begun is left if nobody goes on."""
    pool = ThreadPoolExecutor(THREADS)
    try:
        yield from pool.map(work, items)
    finally:
        pool.shutdown(cancel_futures=True)
