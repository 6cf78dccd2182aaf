"""Work on two threads: numpy and scipy's trees let go of Python's lock while they compute.

Results come in order and do not depend on how many threads there are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from threading import Event, Lock
from typing import Generic, TypeVar

from vflatten_ros.core.errors import Cancelled
from vflatten_ros.core.values import Progress

THREADS = 2  # cores that a robot's computer has to spare
REPORT_S = 0.02  # between two looks at how far a call is

Item = TypeVar("Item")
Done = TypeVar("Done")


def mapped(work: Callable[[Item], Done], items: Iterable[Item]) -> Iterator[Done]:
    """What `work` makes of each item, in order; what has not begun is left if nobody goes on."""
    pool = ThreadPoolExecutor(THREADS)
    try:
        yield from pool.map(work, items)
    finally:
        pool.shutdown(cancel_futures=True)


class Once(Generic[Done]):
    """A value that several calls need: the first computes it, the others wait."""

    def __init__(self, make: Callable[[Progress], Done]) -> None:
        self._make, self._lock = make, Lock()
        self._made: list[Done] = []

    def __call__(self, progress: Progress) -> Done:
        """The value, or the error of its computation, which the next caller tries again."""
        with self._lock:
            if not self._made:
                self._made.append(self._make(progress))
            return self._made[0]


class Ahead(Generic[Done]):
    """Calls that are begun in order before it is certain that all are needed. A context.

    Parameters
    ----------
    calls : sequence of callable
        Each takes a progress callback, which raises Cancelled once the call is dropped.
    """

    def __init__(self, calls: Sequence[Callable[[Progress], Done]]) -> None:
        self._dropped = [Event() for _ in calls]
        self._stage = [("", 0.0)] * len(calls)
        self._pool = ThreadPoolExecutor(THREADS)
        self._calls = [self._pool.submit(self._run, k, call) for k, call in enumerate(calls)]

    def __enter__(self) -> Ahead[Done]:
        return self

    def __exit__(self, *error: object) -> None:
        self.drop(0)
        self._pool.shutdown(wait=False)

    def drop(self, first: int) -> None:
        """Neither begin nor go on with this call and those after it; does not wait for them."""
        for dropped, call in zip(self._dropped[first:], self._calls[first:], strict=True):
            dropped.set()
            call.cancel()

    def result(self, number: int, progress: Progress) -> Done:
        """Wait for a call, reporting how far it is; raises what it raised."""
        call = self._calls[number]
        while not call.done():
            wait([call], timeout=REPORT_S)
            stage, fraction = self._stage[number]
            if stage:
                progress(stage, fraction)
        return call.result()

    def _run(self, number: int, call: Callable[[Progress], Done]) -> Done:
        def progress(stage: str, fraction: float) -> None:
            if self._dropped[number].is_set():
                raise Cancelled("not needed any more")
            self._stage[number] = stage, fraction

        return call(progress)
