"""The process that flattens, so that the node's callbacks never wait for the method.

Views are sent as they arrive, and prepared while the process has no job; a job names those it wants
by key. A process, not a thread: the method holds Python's interpreter lock in bursts, and a process
can be ended when it does not stop.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import queue
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, Protocol

from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import Cancelled, NotEnoughViews, VFlattenError
from vflatten_ros.core.values import Correspondence, FlatGarment, Progress, View
from vflatten_ros.processes import keep_little

PROGRESS_PERIOD_S = 0.05
STOP = (
    signal.SIGUSR1
)  # from the process to itself: the main thread looks whether its job is cancelled


@dataclass(frozen=True)
class Job:
    """One flattening."""

    number: int
    view_keys: tuple[int, ...]
    correspondences: tuple[Correspondence, ...]
    config: Config
    item: int = 0  # which item the views are of


@dataclass(frozen=True)
class Step:
    """How far a job is."""

    number: int
    stage: str
    fraction: float  # of the stage


@dataclass(frozen=True)
class Outcome:
    """How a job ended: with a garment, or with an error."""

    number: int
    garment: FlatGarment | None = None
    messages: Mapping[str, bytes] = field(default_factory=dict)  # topic -> serialized message
    seconds: Mapping[str, float] = field(default_factory=dict)  # stage -> wall time
    error: str = ""
    cancelled: bool = False
    few_views: bool = False  # the error is that the method needs more


@dataclass(frozen=True)
class Ready:
    """The process has loaded everything and waits for jobs."""


@dataclass(frozen=True)
class Died:
    """The process is gone."""

    exit_code: int | None


Event = Step | Outcome | Ready | Died


class Work(Protocol):
    """What the process can do."""

    def prepare(self, view: View, config: Config) -> None:
        """What can be done of a view before a job asks for it."""

    def flatten(
        self, views: Sequence[View], job: Job, progress: Progress
    ) -> tuple[FlatGarment, Mapping[str, bytes]]:
        """A garment, and its serialized messages by topic."""


Load = Callable[[], Work]


class Worker:
    """Handle of the process. Not thread-safe; `notify` is called from another thread.

    Parameters
    ----------
    load : callable
        Called once in the process; gives what does the work. Must be importable.
    notify : callable
        Called when `events` has something.
    nice : int
        Added to the process's nice value.
    """

    def __init__(self, load: Load, notify: Callable[[], None], nice: int = 0) -> None:
        self._load, self._notify, self._nice = load, notify, nice
        self._events: queue.SimpleQueue[tuple[int, Event]] = queue.SimpleQueue()
        self._keys: dict[View, int] = {}
        self._next_key = 0
        self._config = Config()
        self._generation = 0
        self._start()

    @property
    def pid(self) -> int | None:
        """Process id."""
        return self._process.pid

    def keep(self, views: Sequence[View], config: Config) -> None:
        """Send the views that the process does not have, and let it forget all others.

        It prepares them with these settings; a job with others can use them, too, only later.
        """
        self._config = config
        wanted = set(views)
        for view in [view for view in self._keys if view not in wanted]:
            self._outbox.put(("forget", self._keys.pop(view)))
        for view in views:
            if view not in self._keys:
                self._keys[view] = self._next_key
                self._next_key += 1
                self._send(view)

    def _send(self, view: View) -> None:
        self._outbox.put(("view", self._keys[view], view, self._config))

    def submit(
        self,
        number: int,
        views: Sequence[View],
        pairs: Sequence[Correspondence],
        config: Config,
        item: int = 0,
    ) -> None:
        """Begin a job on views that were kept before."""
        keys = tuple(self._keys[view] for view in views)
        self._outbox.put(("job", Job(number, keys, tuple(pairs), config, item)))

    def cancel(self, number: int) -> None:
        """Ask a job to stop; its outcome says that it was cancelled."""
        self._outbox.put(("cancel", number))

    def events(self) -> Iterator[Event]:
        """What has happened since the last call."""
        while not self._events.empty():
            generation, event = self._events.get()
            if generation == self._generation:
                yield event

    def restart(self) -> None:
        """End the process as it is and begin a new one, which gets the kept views again."""
        self.stop()
        self._start()
        for view in self._keys:
            self._send(view)

    def stop(self) -> None:
        """End the process, and the threads that speak with it."""
        self._generation += 1
        self._outbox.put(None)
        self._process.kill()
        self._process.join(timeout=5.0)
        for thread in self._threads:
            thread.join(timeout=5.0)

    def _start(self) -> None:
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        keep_little(os.environ)  # read as a process starts
        self._process = context.Process(
            target=serve, args=(theirs, self._load, self._nice), daemon=True, name="flatten"
        )
        self._process.start()
        theirs.close()
        self._outbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        args = (ours, self._process, self._outbox, self._generation)
        self._threads = [
            threading.Thread(target=run, args=args, daemon=True)
            for run in (self._write, self._read)
        ]
        for thread in self._threads:
            thread.start()

    def _write(self, pipe: Connection, _: Any, outbox: queue.SimpleQueue[Any], __: int) -> None:
        for message in iter(outbox.get, None):
            try:
                pipe.send(message)
            except OSError:
                return

    def _read(self, pipe: Connection, process: Any, outbox: Any, generation: int) -> None:
        while True:
            try:
                event = pipe.recv()
            except (EOFError, OSError):
                process.join(timeout=1.0)
                event = Died(process.exitcode)
            if generation != self._generation:
                return  # stopped meanwhile: nobody wants to know
            self._events.put((generation, event))
            self._notify()
            if isinstance(event, Died):
                outbox.put(None)
                return


def serve(pipe: Connection, load: Load, nice: int) -> None:
    """What the process runs: take jobs until the other end is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the group; the node decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.nice(nice)
    inbox = _Inbox(pipe)
    signal.signal(STOP, lambda number, frame: inbox.stop_if_cancelled())
    threading.Thread(target=inbox.receive, daemon=True).start()
    work = load()
    pipe.send(Ready())
    while True:
        inbox.next_task()(work)


_Task = Callable[[Work], None]
_JOB, _PREPARE = 0, 1  # priorities


class _Inbox:
    """Messages of the node, taken by a thread so that a cancel is seen during a job."""

    def __init__(self, pipe: Connection) -> None:
        self.cancelled: set[int] = set()
        self.running: int | None = None  # number of the job that may be stopped wherever it is
        self._pipe = pipe
        self._views: dict[int, View] = {}
        self._tasks: queue.PriorityQueue[tuple[int, int, _Task]] = queue.PriorityQueue()
        self._numbers = itertools.count()

    def stop_if_cancelled(self) -> None:
        """Raises Cancelled in the middle of a cancelled job."""
        if self.running in self.cancelled:
            raise Cancelled("the caller asked to stop")

    @contextlib.contextmanager
    def sending(self) -> Iterator[None]:
        """While a job sends: half a message would spoil the pipe."""
        running, self.running = self.running, None
        yield
        self.running = running
        self.stop_if_cancelled()  # a request that came meanwhile

    def next_task(self) -> _Task:
        """Wait for something to do: jobs first, then views to prepare."""
        return self._tasks.get()[2]

    def receive(self) -> None:
        try:
            self._receive()
        except (EOFError, OSError):
            os._exit(0)  # the node is gone, whatever is being computed is for nobody
        except BaseException:
            traceback.print_exc()
            os._exit(1)  # the node starts another

    def _receive(self) -> None:
        while True:
            kind, *rest = self._pipe.recv()
            if kind == "view":
                key, self._views[key], config = rest
                self._put(_PREPARE, partial(self._prepare, key, config))
            elif kind == "forget":
                self._views.pop(rest[0], None)
            elif kind == "cancel":
                self.cancelled.add(rest[0])
                signal.pthread_kill(_main_thread(), STOP)
            else:
                views = [self._views[key] for key in rest[0].view_keys]
                self._put(_JOB, partial(self._do, rest[0], views, time.perf_counter()))

    def _put(self, priority: int, task: _Task) -> None:
        self._tasks.put((priority, next(self._numbers), task))

    def _prepare(self, key: int, config: Config, work: Work) -> None:
        view = self._views.get(key)
        if view is not None:
            with contextlib.suppress(Exception):  # the job that needs the view will say it
                work.prepare(view, config)

    def _do(self, job: Job, views: list[View], came: float, work: Work) -> None:
        try:
            self.running = job.number
            outcome = _outcome(work, job, views, _Reporter(self._pipe, job, self, came))
            self.running = None
        except Cancelled as error:  # just as it ended
            self.running = None
            outcome = Outcome(job.number, error=str(error), cancelled=True)
        self._pipe.send(outcome)


class _Reporter:
    """The progress callback of a job: reports, times the stages, raises Cancelled."""

    def __init__(self, pipe: Connection, job: Job, inbox: _Inbox, came: float) -> None:
        self._pipe, self._number, self._inbox = pipe, job.number, inbox
        # a view may have been in preparation when the job came: the job waited for it
        self._stage, self._since, self._reported = "start", came, 0.0
        self.seconds: dict[str, float] = {}

    def __call__(self, stage: str, fraction: float) -> None:
        self._inbox.stop_if_cancelled()
        now = time.perf_counter()
        if stage != self._stage:
            self.close(now)
            self._stage, self._reported = stage, 0.0
        if now - self._reported >= PROGRESS_PERIOD_S:
            self._reported = now
            with self._inbox.sending():
                self._pipe.send(Step(self._number, stage, fraction))

    def close(self, now: float) -> None:
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._since = now


def _main_thread() -> int:
    ident = threading.main_thread().ident
    assert ident is not None
    return ident


def _outcome(work: Work, job: Job, views: list[View], report: _Reporter) -> Outcome:
    try:
        report("start", 0.0)
        garment, messages = work.flatten(views, job, report)
        report.close(time.perf_counter())
        return Outcome(job.number, garment, messages, report.seconds)
    except Cancelled as error:
        return Outcome(job.number, error=str(error), cancelled=True)
    except VFlattenError as error:
        few = isinstance(error, NotEnoughViews)
        return Outcome(job.number, error=str(error), few_views=few)
    except Exception:  # our own mistake must not take the process with it
        trace = traceback.format_exc()
        return Outcome(job.number, error=f"internal error, please report it:\n{trace}")
