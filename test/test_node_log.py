"""The log says what happens once, however often it happens."""

from __future__ import annotations

import pytest

from vflatten_ros.node_log import MOST_CAUSES, MOST_OF_KIND, REPEAT_S, Log, without_numbers


class Logger:
    def __init__(self):
        self.lines = []

    def __getattr__(self, level):
        return lambda line: self.lines.append((level, line))


@pytest.fixture
def time():
    return [1000.0]


@pytest.fixture
def log(time):
    return Log(Logger(), lambda: time[0])


def test_lines_of_one_cause_are_held_back_and_counted(log, time):
    for _ in range(100):
        log.warning("a cloud was dropped", cause="wrong_frame")
        log.error("the process ended", cause="process")
    time[0] += REPEAT_S
    log.warning("a cloud was dropped", cause="wrong_frame")
    assert log._logger.lines == [
        ("warning", "a cloud was dropped"),
        ("error", "the process ended"),
        ("warning", "a cloud was dropped (99 more like this since the last line)"),
    ]


def test_lines_without_a_cause_are_all_logged(log):
    for item in (1, 2):
        log.info(f"item {item} begins")
    assert log._logger.lines == [("info", "item 1 begins"), ("info", "item 2 begins")]


def test_causes_are_not_remembered_without_bound(log):
    for number in range(3 * MOST_CAUSES):
        for _ in range(2):
            log.info("again", cause=str(number))
    assert len(log._last) == MOST_CAUSES >= len(log._held)
    assert len(log._logger.lines) == 3 * MOST_CAUSES


def test_different_causes_of_one_kind_are_each_logged_but_a_few_at_a_time(log, time):
    for _ in range(2):
        for cause in ("no fields", "rows too short"):
            log.warning(cause, cause, kind="invalid_cloud")
    assert [line for _, line in log._logger.lines] == ["no fields", "rows too short"]
    for number in range(100):
        log.warning(f"frame {number}", f"frame {number}", kind="wrong_frame")
    assert len(log._logger.lines) == 2 + MOST_OF_KIND + 1  # the rest shares one
    time[0] += REPEAT_S
    log.warning("frame 200", "frame 200", kind="wrong_frame")
    assert log._logger.lines[-1] == ("warning", "frame 200")


def test_lines_that_differ_in_numbers_only_have_one_cause():
    one, other = "stamped 0.250 s before view 3", "stamped 1e-06 s before view 17"
    assert without_numbers(one) == without_numbers(other) == "stamped # s before view #"
