"""The search for the way to lay the surface flat that makes the best item.

Ways are tried in turn until one is good enough. A helper may try some of them at the same time;
they still count in their order, so that the result is the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Protocol

from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.fused import Fused
from vflatten_ros.core.templates import Template
from vflatten_ros.core.tried import Tried, Verdict, best_of, contradicted, rival, settled
from vflatten_ros.core.values import Progress
from vflatten_ros.core.ways import Said, Task, Ways

FIRST_BESIDE = 1  # way that a helper begins with, while the caller tries those before


class Helper(Protocol):
    """Tries ways beside the caller. It may be slow, or gone: only the time depends on it."""

    def begin(self, task: Task, ways: Sequence[int]) -> None:
        """Try these ways, in this order."""

    def said(self) -> Mapping[int, Said]:
        """Of the ways that it has tried since."""

    def at(self) -> int | None:
        """The way that it is trying; None: it is through, or gone."""

    def leave(self, way: int) -> None:
        """Not to try a way: the caller does."""

    def wait(self) -> tuple[str, float]:
        """For a moment, or until it has said more; gives the stage that it is at, and how far."""

    def laid_flat(self, way: int) -> Tried | None:
        """What a way led to; None: it is gone."""

    def end(self) -> None:
        """Stop, and forget the task."""


class _Enough(Exception):
    """What is being tried is not needed any more."""


def likeliest(
    fused: Fused,
    templates: tuple[Template, ...],
    config: Config,
    progress: Progress,
    helper: Helper | None = None,
) -> Tried:
    """The way of laying the surface flat that makes the best item.

    Raises
    ------
    DisconnectedSurface
        No way led to a flat surface.
    """
    task = Task(fused, templates, config)
    beside = range(FIRST_BESIDE, config.rotation.ways)
    if helper is None or not beside:
        return _Search(task, progress, None).best()
    try:
        helper.begin(task, beside)
        return _Search(task, progress, helper).best()
    finally:
        helper.end()


class _Search:
    def __init__(self, task: Task, progress: Progress, helper: Helper | None) -> None:
        self._count = task.config.rotation.ways
        self._helper, self._progress = helper, progress
        self._ways = Ways(task)
        self._said: dict[int, Said] = {}

    def best(self) -> Tried:
        while (counted := self._enough()) is None:
            self._go_on()
        first = self._said[0]
        if not counted and isinstance(first, DisconnectedSurface):
            raise first
        verdicts = list(counted.values())
        best = best_of(verdicts)
        way = list(counted)[verdicts.index(best)]
        return replace(
            self._laid_flat(way), rival=rival(verdicts), contradicted=contradicted(best, verdicts)
        )

    def _enough(self) -> dict[int, Verdict] | None:
        """The ways that settle it, or all if they do not; None: others have to be tried."""
        if self._helper is not None:
            self._said = {**self._helper.said(), **self._said}
        counted: dict[int, Verdict] = {}
        for way in range(self._count):
            if settled(list(counted.values())):
                break
            if way not in self._said:
                return None
            said = self._said[way]
            if isinstance(said, Verdict):
                counted[way] = said
        return counted

    def _go_on(self) -> None:
        """Try the first way that nobody has tried, or wait for the helper."""
        at = self._helper.at() if self._helper is not None else None
        left = [k for k in range(self._count) if k not in self._said and k != at]
        if not left and self._helper is not None:
            self._progress(*self._helper.wait())
            return
        if self._helper is not None:
            self._helper.leave(left[0])
        with suppress(_Enough):
            self._said[left[0]] = self._ways.verdict(left[0], self._report)

    def _report(self, stage: str, fraction: float) -> None:
        self._progress(stage, fraction)
        if self._helper is not None and self._enough() is not None:
            raise _Enough

    def _laid_flat(self, way: int) -> Tried:
        if self._helper is not None and way in self._helper.said():
            tried = self._helper.laid_flat(way)
            if tried is not None:
                return tried
        return self._ways.laid_flat(way, self._progress)
