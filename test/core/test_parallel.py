"""Work on threads: in order, errors passed on."""

from __future__ import annotations

import threading

import pytest

from vflatten_ros.core.errors import Cancelled
from vflatten_ros.core.parallel import beside, mapped


def test_results_come_in_order():
    assert list(mapped(lambda n: n * n, range(20))) == [n * n for n in range(20)]


def test_an_error_of_one_item_is_raised_in_its_turn():
    results = mapped(lambda n: 6 // n, (3, 2, 0))
    assert [next(results), next(results)] == [2, 3]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_work_beside_the_block_gives_its_result_and_its_errors():
    with beside(lambda progress: 6) as six:
        pass
    assert six.result() == 6
    with beside(lambda progress: 6 // 0) as failed:
        pass
    with pytest.raises(ZeroDivisionError):
        failed.result()


def test_work_beside_a_block_that_fails_stops_at_its_next_report():
    begun, futures = threading.Event(), []

    def work(progress):
        begun.set()
        while True:  # for ever, if nobody stops it
            progress("work", 0.5)

    with pytest.raises(KeyError), beside(work) as future:
        futures.append(future)
        begun.wait()
        raise KeyError("of the block")
    assert isinstance(futures[0].exception(), Cancelled)
