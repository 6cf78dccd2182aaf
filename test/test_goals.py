"""The queue of flattenings and the process that does them, without ROS."""

from __future__ import annotations

import dataclasses
import itertools
import os
import signal
import threading
import time

import garments
import pytest
import slow_work

from vflatten_ros import goals
from vflatten_ros.core.config import Config, GeodesicConfig
from vflatten_ros.goals import CANCEL_GRACE_S, Goals, Listener, Task
from vflatten_ros.worker import Worker

VIEWS = tuple(garments.example_views())


class Asker:
    """Somebody who waits for a task."""

    def __init__(self):
        self.outcomes, self.steps = [], []
        self.listener = Listener(
            lambda stage, fraction: self.steps.append((stage, fraction)), self.outcomes.append
        )


class Office:
    """A queue with its worker, and a loop as the node's."""

    def __init__(self, load=slow_work.load, max_waiting=2):
        self.woken = threading.Event()
        self.worker = Worker(load, self.woken.set)
        self.goals = Goals(self.worker, lambda: max_waiting)
        self.log = []

    def ask(self, what, views=VIEWS):
        asker = Asker()
        config = dataclasses.replace(Config(), geodesics=GeodesicConfig(nodes=what))
        self.goals.keep(views, config)
        asker.accepted = self.goals.submit(Task(tuple(views), (), config), asker.listener)
        return asker

    def until(self, condition, limit_s=30.0):
        end = time.monotonic() + limit_s
        while not condition():
            assert time.monotonic() < end, f"did not come to pass; log: {self.log}"
            self.woken.wait(0.01)
            self.woken.clear()
            self.log += self.goals.handle_events() + self.goals.check_deadlines()

    def answer(self, asker):
        self.until(lambda: asker.outcomes)
        assert len(asker.outcomes) == 1
        return asker.outcomes[0]


@pytest.fixture(scope="module")
def shared_office():
    office = Office()
    yield office
    office.goals.stop()


@pytest.fixture
def office(shared_office):
    yield shared_office
    shared_office.goals.cancel_all("the test is over")
    shared_office.until(lambda: not shared_office.goals.busy)
    shared_office.goals.keep((), Config())  # forgets the last outcome


def test_a_task_ends_with_a_garment_feedback_and_times(office):
    asker = office.ask(slow_work.GOOD)
    outcome = office.answer(asker)
    assert outcome.garment.category == "towel"
    assert outcome.messages["garment"] == b"bytes"
    assert outcome.seconds["work"] >= 0.03
    assert "work" in [stage for stage, _ in asker.steps]


class Spy:
    """Notes what is sent to the process."""

    def __init__(self, outbox):
        self.outbox, self.sent = outbox, []

    def put(self, message):
        self.sent.append(message)
        self.outbox.put(message)


def test_the_process_gets_every_view_once(office):
    spy = office.worker._outbox = Spy(office.worker._outbox)
    try:
        office.answer(office.ask(slow_work.GOOD))
        office.goals.keep(VIEWS, Config())
        office.goals.keep(VIEWS[:1], Config())
    finally:
        office.worker._outbox = spy.outbox
    kinds = [message[0] for message in spy.sent]
    assert kinds.count("view") == len(VIEWS)
    assert kinds.count("forget") == 1


def test_views_are_prepared_as_they_come_before_a_task_asks(office):
    """One that cannot be is left to the task that needs it."""
    wrong = dataclasses.replace(Config(), geodesics=GeodesicConfig(nodes=slow_work.WRONG))
    office.goals.keep(VIEWS, wrong)
    ids = bytes(view.view_id for view in VIEWS)
    tasks = itertools.count(100)  # each another one, so that it is worked on
    office.until(lambda: office.answer(office.ask(next(tasks))).messages["prepared"][-2:] == ids)
    assert office.answer(office.ask(slow_work.WRONG)).error == "three views are needed"


def test_equal_tasks_are_done_once_and_answered_alike(office):
    office.goals.take_finished()
    first, second = office.ask(slow_work.SLOW), office.ask(slow_work.SLOW)
    assert office.goals.waiting == 0
    assert office.answer(first) is office.answer(second)
    assert [finished.again for finished in office.goals.take_finished()] == [False]
    third = office.ask(slow_work.SLOW)
    assert third.outcomes[0] is first.outcomes[0]
    assert [finished.again for finished in office.goals.take_finished()] == [True]


def test_different_tasks_wait_for_one_another_and_the_queue_is_bounded(office):
    office.until(lambda: office.goals.ready)
    askers = [office.ask(slow_work.SLOW, VIEWS[:1]), office.ask(slow_work.GOOD, VIEWS[1:])]
    askers.append(office.ask(slow_work.GOOD, VIEWS))
    refused = office.ask(slow_work.SLOW, VIEWS)
    assert [asker.accepted for asker in askers] == [True] * 3
    assert not refused.accepted
    assert all(office.answer(asker).garment for asker in askers)
    assert not refused.outcomes


def test_errors_of_the_method_are_told_and_the_next_task_goes_on(office):
    few = office.answer(office.ask(slow_work.WRONG))
    assert (few.error, few.few_views) == ("three views are needed", True)
    mistake = office.answer(office.ask(slow_work.MISTAKE))
    assert "internal error" in mistake.error and "ZeroDivisionError" in mistake.error
    assert office.answer(office.ask(slow_work.GOOD)).garment


@pytest.mark.parametrize("work", [slow_work.ENDLESS, slow_work.SILENT])
def test_a_cancelled_task_stops_and_the_process_stays(office, work, monkeypatch):
    monkeypatch.setattr(goals, "CANCEL_GRACE_S", 1e3)  # it is not ended, however slow the machine
    asker = office.ask(work)
    office.until(lambda: ("work", 0.0) in asker.steps)
    restarts = office.goals.restarts
    office.goals.withdraw(asker.listener)
    office.until(lambda: not office.goals.busy)  # the work itself never ends
    assert office.goals.restarts == restarts
    assert not asker.outcomes


def test_a_task_goes_on_while_one_of_two_still_waits(office):
    first, second = office.ask(slow_work.SLOW), office.ask(slow_work.SLOW)
    office.goals.withdraw(first.listener)
    assert office.answer(second).garment
    assert not first.outcomes


def test_a_process_that_does_not_stop_is_ended_and_the_next_task_is_done(office):
    asker = office.ask(slow_work.STUBBORN)
    office.until(lambda: ("work", 0.0) in asker.steps)
    time.sleep(0.3)  # it still hears until its report is sent; then nothing
    began = time.monotonic()
    office.goals.withdraw(asker.listener)
    office.until(lambda: not office.goals.busy)
    assert time.monotonic() - began >= CANCEL_GRACE_S
    assert any("did not stop" in line for line in office.log)
    assert office.answer(office.ask(slow_work.GOOD)).garment


@pytest.mark.parametrize("how", ["by itself", "killed"])
def test_a_process_that_dies_costs_one_task(office, how):
    asker = office.ask(slow_work.CRASH if how == "by itself" else slow_work.STUBBORN)
    if how == "killed":
        office.until(lambda: asker.steps)
        os.kill(office.worker.pid, signal.SIGKILL)
    office.goals.take_finished()
    assert "ended" in office.answer(asker).error
    (failed,) = office.goals.take_finished()  # it counts as any other that failed
    assert failed.outcome is asker.outcomes[0] and not failed.outcome.cancelled
    assert office.answer(office.ask(slow_work.GOOD)).garment


def test_a_process_that_cannot_start_answers_and_is_not_started_at_once_again():
    office = Office(slow_work.load_and_fail)
    try:
        outcome = office.answer(office.ask(slow_work.GOOD))
        assert "while it started" in outcome.error and not outcome.cancelled
        assert [finished.outcome for finished in office.goals.take_finished()] == [outcome]
        assert office.goals.restarts == 0
    finally:
        office.goals.stop()


def test_stopping_answers_everybody_and_ends_the_process():
    office = Office()
    askers = [office.ask(slow_work.STUBBORN), office.ask(slow_work.GOOD)]
    office.goals.stop()
    assert all(asker.outcomes[0].cancelled for asker in askers)
    with pytest.raises(ProcessLookupError):
        os.kill(office.worker.pid, 0)


def test_stopping_leaves_no_thread_behind():
    """One that still spoke of the process could wake a node that is being taken down."""
    before = set(threading.enumerate())
    office = Office()
    office.until(lambda: office.goals.ready)
    assert set(threading.enumerate()) - before
    office.goals.stop()
    assert not set(threading.enumerate()) - before
