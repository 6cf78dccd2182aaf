"""Work on two threads: numpy and scipy's trees let go of Python's lock while they compute.

Results come in order and do not depend on how many threads there are.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from vflatten_ros.core.errors import Cancelled
from vflatten_ros.core.values import Progress

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


@contextmanager
def beside(work: Callable[[Progress], Done]) -> Iterator[Future[Done]]:
    """Work on a thread of its own during the block, which its result is for the end of.

    Parameters
    ----------
    work : callable
        Gets a progress callback, through which it is stopped if the block fails.
    """
    failed = threading.Event()

    def stop_if_failed(stage: str, fraction: float) -> None:
        if failed.is_set():
            raise Cancelled(f"{stage} at {fraction:.0%}: what it was for has failed")

    with ThreadPoolExecutor(1) as pool:
        try:
            yield pool.submit(work, stop_if_failed)
        except BaseException:
            failed.set()
            raise
