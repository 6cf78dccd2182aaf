"""The node's log: a line for each event that matters, no floods."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import Any

REPEAT_S = 60.0  # between lines of one cause
MOST_CAUSES = 256  # remembered
MOST_OF_KIND = 8  # lines of different causes of one kind within that time


class Log:
    """Lets a line through, then holds back those of the same cause for a while.

    Lines without a cause are all let through: for what happens on request, or once for an item.

    Parameters
    ----------
    logger : rclpy logger
    clock : callable
        Seconds that only grow.
    """

    def __init__(self, logger: Any, clock: Callable[[], float] = time.monotonic) -> None:
        self._logger, self._clock = logger, clock
        self._last: dict[str, float] = {}  # the oldest first
        self._held: dict[str, int] = {}

    def info(self, text: str, cause: str = "") -> None:
        """Log what an operator may want to know."""
        if (line := self._line(text, cause)) is not None:
            self._logger.info(line)

    def warning(self, text: str, cause: str = "", kind: str = "") -> None:
        """Log what an operator should look at; of one kind, a few different causes at a time."""
        if kind:
            cause = self._of_kind(kind, cause)
        if (line := self._line(text, cause)) is not None:
            self._logger.warning(line)

    def error(self, text: str, cause: str = "") -> None:
        """Log what does not work."""
        if (line := self._line(text, cause)) is not None:
            self._logger.error(line)

    def _of_kind(self, kind: str, cause: str) -> str:
        """A cause of its own, or where there are many already, that of the others."""
        own, now = f"{kind}: {cause}", self._clock()
        lately = [
            known
            for known, at in self._last.items()
            if known.startswith(f"{kind}: ") and now - at < REPEAT_S
        ]
        return own if own in lately or len(lately) < MOST_OF_KIND else kind

    def _line(self, text: str, cause: str) -> str | None:
        if not cause:
            return text
        now = self._clock()
        if now - self._last.get(cause, -REPEAT_S) < REPEAT_S:
            self._held[cause] = self._held.get(cause, 0) + 1
            return None
        self._last.pop(cause, None)
        self._last[cause] = now
        held = self._held.pop(cause, 0)
        while len(self._last) > MOST_CAUSES:
            oldest = next(iter(self._last))
            del self._last[oldest]
            self._held.pop(oldest, None)
        return f"{text} ({held} more like this since the last line)" if held else text


def without_numbers(text: str) -> str:
    """The same for lines that differ in numbers only, which change from cloud to cloud."""
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", text)
