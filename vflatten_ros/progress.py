"""A progress callback that times the stages and draws a bar. The core has no clock: this is it."""

from __future__ import annotations

import sys
import time
from typing import Any

_REDRAW_S = 0.1


class Stages:
    """Called as stages(name, fraction); use as a context, so that the bar goes away.

    Parameters
    ----------
    show : bool
        Draw a bar on stderr.
    """

    def __init__(self, show: bool = False) -> None:
        self.seconds: dict[str, float] = {}  # stage -> wall time, in order of first appearance
        self._stage = ""
        self._since = self._drawn = time.perf_counter()
        self._bar = _bar() if show else None

    def __enter__(self) -> Stages:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def __call__(self, stage: str, fraction: float) -> None:
        """The core's progress callback (core.values.Progress)."""
        now = time.perf_counter()
        new = stage != self._stage
        if new:
            self._close(now)
            self._stage = stage
        if self._bar is not None and (new or now - self._drawn > _REDRAW_S):
            self._drawn = now
            self._bar.set_description_str(f"{stage:<16}", refresh=False)
            self._bar.n = min(max(fraction, 0.0), 1.0)
            self._bar.refresh()

    def warn(self, text: str) -> None:
        """Print a line above the bar."""
        if self._bar is not None:
            self._bar.clear()
        print(f"vflatten: warning: {' '.join(text.split())}", file=sys.stderr)

    def stop(self) -> None:
        """End the last stage and take the bar away."""
        self._close(time.perf_counter())
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _close(self, now: float) -> None:
        if self._stage:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = "", now


def _bar() -> Any:
    from tqdm import tqdm

    form = "{desc} {bar:30} {percentage:3.0f} %  {elapsed}"
    return tqdm(total=1.0, bar_format=form, leave=False, file=sys.stderr)
