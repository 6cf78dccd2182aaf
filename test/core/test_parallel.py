"""Work on threads: in order, dropped when it is not needed, errors passed on."""

from __future__ import annotations

from functools import partial
from threading import Event

import pytest

from vflatten_ros.core.errors import Cancelled
from vflatten_ros.core.parallel import Ahead, Once, mapped
from vflatten_ros.core.values import no_progress

LONG_S = 30.0  # only a failing test waits so long


def test_results_come_in_order():
    assert list(mapped(lambda n: n * n, range(20))) == [n * n for n in range(20)]


def test_an_error_of_one_item_is_raised_in_its_turn():
    results = mapped(lambda n: 6 // n, (3, 2, 0))
    assert [next(results), next(results)] == [2, 3]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_a_value_is_made_once_and_again_only_after_an_error():
    made = []

    def make(progress):
        made.append(None)
        if len(made) == 1:
            raise ValueError("the first time")
        return len(made)

    value = Once(make)
    with pytest.raises(ValueError, match="first"):
        value(no_progress)
    assert [value(no_progress), value(no_progress)] == [2, 2]


def test_waiting_for_a_call_tells_how_far_it_is_and_can_be_cancelled():
    ended = Event()

    def call(progress):
        try:
            while not ended.wait(0.001):
                progress("stage", 0.5)
        finally:
            ended.set()

    def cancel(stage, fraction):
        assert (stage, fraction) == ("stage", 0.5)
        raise Cancelled("asked to stop")

    with pytest.raises(Cancelled, match="asked"), Ahead([call]) as ahead:
        ahead.result(0, cancel)
    assert ended.wait(LONG_S)


def test_a_dropped_call_stops_and_those_before_it_go_on():
    begun, stopped, go_on = Event(), Event(), Event()

    def first(progress):
        assert begun.wait(LONG_S)
        assert go_on.wait(LONG_S)
        progress("first", 1.0)
        return "first"

    def second(progress):
        begun.set()
        try:
            while True:
                progress("second", 0.0)
        except Cancelled:
            stopped.set()
            raise

    def never(progress):
        raise AssertionError("was not needed")

    with Ahead([first, second, never]) as ahead:
        assert begun.wait(LONG_S)
        ahead.drop(1)
        assert stopped.wait(LONG_S)
        go_on.set()
        assert ahead.result(0, no_progress) == "first"


def test_an_error_of_a_call_is_raised_where_its_result_is_asked_for():
    with Ahead([partial(int, "no number"), lambda progress: 1]) as ahead:
        assert ahead.result(1, no_progress) == 1
        with pytest.raises((TypeError, ValueError)):
            ahead.result(0, no_progress)
