"""Which flattening is worked on, which wait, and who is told; no ROS in here."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from vflatten_ros.core.config import Config
from vflatten_ros.core.values import Correspondence, View
from vflatten_ros.worker import Died, Outcome, Ready, Step, Worker

CANCEL_GRACE_S = 0.2  # then the process is ended
# Seconds of each stage; only their shares count, and only until the first flattening is done.
FIRST_GUESS: Mapping[str, Mapping[str, float]] = {
    "kita2019": {
        "surface": 0.5, "register": 0.0, "choose": 0.0, "integration": 0.1, "geodesics": 0.7,
        "flattening": 0.5, "outline": 0.1, "recognition": 0.3, "measurement": 0.1, "messages": 0.1,
    },
    "rotation": {
        "surface": 0.1, "register": 0.3, "fuse": 0.5, "link": 0.4, "distances": 0.6, "unfold": 0.4,
        "outline": 0.1, "recognition": 0.4, "parts": 0.4, "measurement": 0.1, "messages": 0.1,
    },
}  # fmt: skip
START_PAUSE_S = 5.0  # before another try, if the process cannot even start


@dataclass(frozen=True)
class Task:
    """What to flatten: the views and settings at the moment it was asked for."""

    views: tuple[View, ...]
    correspondences: tuple[Correspondence, ...]
    config: Config
    item: int = 0  # which item the views are of


@dataclass(frozen=True)
class Finished:
    """A task that ended."""

    task: Task
    outcome: Outcome
    again: bool = False  # it had ended before; somebody asked for it once more


class _Scale:
    """0-1 of a whole flattening, from how long each stage took the last time."""

    def __init__(self) -> None:
        self._seconds: dict[str, Mapping[str, float]] = dict(FIRST_GUESS)

    def learn(self, method: str, seconds: Mapping[str, float]) -> None:
        self._seconds[method] = seconds

    def at(self, method: str, stage: str, fraction: float) -> float:
        seconds = self._seconds.get(method, {})
        if stage not in seconds:
            return 0.0
        before = list(seconds).index(stage)
        done = sum(list(seconds.values())[:before]) + fraction * seconds[stage]
        return min(done / max(sum(seconds.values()), 1e-9), 1.0)


@dataclass(eq=False)
class Listener:
    """Somebody who waits for a task."""

    on_progress: Callable[[str, float], None]
    on_done: Callable[[Outcome], None]


@dataclass(eq=False)
class _Run:
    number: int
    task: Task
    listeners: list[Listener] = field(default_factory=list)
    cancelled_at: float | None = None


class Goals:
    """A queue of tasks over one worker, first come, first served.

    A task that equals the one being worked on, a waiting one or the last one done is not worked on
    twice: all who asked get the same outcome. Call everything from one thread.
    """

    def __init__(self, worker: Worker, max_waiting: Callable[[], int]) -> None:
        self._worker = worker
        self._max_waiting = max_waiting
        self._numbers = itertools.count(1)
        self._now: _Run | None = None
        self._waiting: list[_Run] = []
        self._last: tuple[Task, Outcome] | None = None
        self._finished: list[Finished] = []
        self.stage, self.fraction = "", 0.0
        self._progress = 0.0
        self._scale = _Scale()
        self.restarts = 0
        self.ready = False
        self._start_at: float | None = None

    @property
    def busy(self) -> bool:
        """Whether a task is being worked on."""
        return self._now is not None

    @property
    def progress(self) -> float:
        """0-1 of the task being worked on."""
        return self._progress

    @property
    def waiting(self) -> int:
        """Tasks in the queue."""
        return len(self._waiting)

    def submit(self, task: Task, listener: Listener) -> bool:
        """Ask for a task; False if the queue is full."""
        if self._last is not None and self._last[0] == task:
            # published once more: outputs may have been switched on meanwhile
            self._finished.append(Finished(*self._last, again=True))
            listener.on_done(self._last[1])
            return True
        for run in [self._now, *self._waiting]:
            if run is not None and run.task == task and run.cancelled_at is None:
                run.listeners.append(listener)
                return True
        if self._now is not None and len(self._waiting) >= self._max_waiting():
            return False
        self._waiting.append(_Run(next(self._numbers), task, [listener]))
        self._begin_next()
        return True

    def withdraw(self, listener: Listener) -> None:
        """No longer wait for a task; it is cancelled if nobody else does."""
        for run in [self._now, *self._waiting]:
            if run is not None and listener in run.listeners:
                run.listeners.remove(listener)
                if not run.listeners:
                    self._cancel(run)
                return

    def cancel_all(self, reason: str) -> None:
        """Answer everybody that nothing will come."""
        runs = [run for run in [self._now, *self._waiting] if run is not None]
        for run in runs:
            listeners, run.listeners = run.listeners, []
            self._cancel(run)
            for listener in listeners:
                listener.on_done(Outcome(run.number, error=reason, cancelled=True))

    def keep(self, views: Sequence[View], config: Config) -> None:
        """Have these views ready at the worker, beside those of the tasks."""
        if self._last is not None and not set(self._last[0].views) <= set(views):
            self._last = None
        runs = [run for run in [self._now, *self._waiting] if run is not None]
        kept = dict.fromkeys([*views, *(view for run in runs for view in run.task.views)])
        self._worker.keep(list(kept), config)

    def handle_events(self) -> list[str]:
        """Take what the worker has reported; gives lines for the log."""
        lines: list[str] = []
        for event in self._worker.events():
            if isinstance(event, Ready):
                self.ready = True
                self._begin_next()
            elif isinstance(event, Step):
                self._step(event)
            elif isinstance(event, Outcome):
                self._done(event)
            elif isinstance(event, Died):
                lines.append(self._died(event))
        return lines

    def take_finished(self) -> list[Finished]:
        """Tasks that ended since the last call, each once however many waited for it."""
        finished, self._finished = self._finished, []
        return finished

    def check_deadlines(self) -> list[str]:
        """End the process where a cancelled task does not stop; call often. Lines for the log."""
        if self._start_at is not None and time.monotonic() >= self._start_at:
            self._restart("")
        run = self._now
        if run is None or run.cancelled_at is None:
            return []
        if time.monotonic() - run.cancelled_at < CANCEL_GRACE_S:
            return []
        self._restart("cancelled")
        return [
            "a cancelled flattening did not stop by itself; its process was ended and started anew"
        ]

    def stop(self) -> None:
        """Answer everybody and end the process."""
        self.cancel_all("the node is being stopped")
        self._worker.stop()

    def _begin_next(self) -> None:
        if self._now is None and self._waiting and self.ready:
            run = self._now = self._waiting.pop(0)
            self.stage, self.fraction, self._progress = "start", 0.0, 0.0
            task = run.task
            self._worker.submit(
                run.number, task.views, task.correspondences, task.config, task.item
            )

    def _step(self, step: Step) -> None:
        if self._now is not None and step.number == self._now.number:
            self.stage, self.fraction = step.stage, step.fraction
            method = self._now.task.config.method
            self._progress = max(self._progress, self._scale.at(method, step.stage, step.fraction))
            for listener in list(self._now.listeners):
                listener.on_progress(step.stage, step.fraction)

    def _done(self, outcome: Outcome) -> None:
        run = self._now
        if run is None or outcome.number != run.number:
            return
        self._now = None
        self._finished.append(Finished(run.task, outcome))
        if outcome.garment is not None:
            self._scale.learn(run.task.config.method, outcome.seconds)
            self._last = (run.task, outcome)
        self._begin_next()
        for listener in run.listeners:
            listener.on_done(outcome)

    def _cancel(self, run: _Run) -> None:
        if run is self._now:
            if run.cancelled_at is None:
                run.cancelled_at = time.monotonic()
                self._worker.cancel(run.number)
        elif run in self._waiting:
            self._waiting.remove(run)

    def _died(self, event: Died) -> str:
        text = f"the flattening process ended (exit code {event.exit_code})"
        if self.ready:
            self._restart(f"{text}; see the log, and try again")
            return f"{text}; started anew"
        waiting, self._waiting = self._waiting, []
        for run in waiting:
            self._fail(run, f"{text} while it started; see the log")
        self._start_at = time.monotonic() + START_PAUSE_S
        return f"{text} while it started; next try in {START_PAUSE_S:g} s"

    def _restart(self, reason: str) -> None:
        run, self._now = self._now, None
        self.ready = False
        self._start_at = None
        self.restarts += 1
        self._worker.restart()
        if run is not None:
            self._fail(run, reason)

    def _fail(self, run: _Run, reason: str) -> None:
        cancelled = run.cancelled_at is not None
        outcome = Outcome(run.number, error=reason, cancelled=cancelled)
        self._finished.append(Finished(run.task, outcome))
        for listener in run.listeners:
            listener.on_done(outcome)
