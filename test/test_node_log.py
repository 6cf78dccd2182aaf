"""The log says what happens once, however often it happens."""

from __future__ import annotations

import pytest

from vflatten_ros.node_log import MOST_CAUSES, REPEAT_S, Log


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
