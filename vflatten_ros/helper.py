"""A second process that tries other ways of laying an item flat meanwhile (core.hypotheses.Helper).

Not a thread: the method holds Python's interpreter lock most of the time. Not multiprocessing's
process: that runs the user's main module once more, and may not be started by a daemonic one, as
the node's worker is. Results do not depend on it; if it dies, the caller does all by itself, and
the next task finds another one.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from vflatten_ros.processes import keep_little

if TYPE_CHECKING:
    from vflatten_ros.core.tried import Tried
    from vflatten_ros.core.ways import Said, Task

SILENT_S = 10.0  # without a word in the midst of a task: it hangs. Its longest silence is 0.3 s
WAIT_S = 0.05
PERIOD_S = 0.05  # between reports of a stage
STILLBORN = 3  # that die before they are ready, after which no more are started


class HelperProcess:
    """Handle of the process. A context; for one caller at a time.

    Results have the same bits if linear algebra uses as many threads as in the caller: the process
    reads OPENBLAS_NUM_THREADS and its like as they are now (see threads.use_one).
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._number = 0  # of the task
        self._said: dict[int, Said] = {}
        self._at: int | None = None
        self._laid: tuple[int, Tried] | None = None
        self._stage, self._heard = ("start", 0.0), 0.0
        self._stillborn = 0
        self._process: subprocess.Popen[bytes]
        self._outbox: queue.SimpleQueue[_Message | None]
        self._start()

    def __enter__(self) -> HelperProcess:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def ready(self) -> bool:
        """Whether it can be given a task now."""
        return self._ready and not self._gone

    def wait_until_ready(self, timeout_s: float) -> bool:
        """For benchmarks and tests; whoever does not wait does without it meanwhile."""
        with self._changed:
            return self._changed.wait_for(lambda: self._ready or self._gone, timeout_s) and (
                self.ready
            )

    def close(self) -> None:
        """End the process."""
        self._outbox.put(None)
        self._process.kill()
        self._process.wait()

    # ---- core.hypotheses.Helper

    def begin(self, task: Task, ways: Sequence[int]) -> None:
        """Try these ways, in this order; it does nothing while it is not ready."""
        if self._gone and self._stillborn < STILLBORN:
            self._process.kill()
            code = self._process.wait()
            print(f"vflatten: helper process ended ({code}), starting another", file=sys.stderr)
            self._start()
        with self._changed:
            self._number += 1
            self._said, self._laid, self._stage = {}, None, ("start", 0.0)
            self._at = ways[0] if self.ready else None
            self._heard = time.monotonic()
        if self._at is not None:
            self._send("begin", task, tuple(ways))

    def said(self) -> Mapping[int, Said]:
        """Of the ways that it has tried since."""
        with self._changed:
            return dict(self._said)

    def at(self) -> int | None:
        """The way that it is trying; None: it is through, or gone."""
        with self._changed:
            return None if self._gone else self._at

    def leave(self, way: int) -> None:
        """Not to try a way."""
        self._send("leave", way)

    def wait(self) -> tuple[str, float]:
        """For a moment, or until it has said more; gives the stage that it is at, and how far."""
        with self._changed:
            before = len(self._said)
            self._changed.wait_for(lambda: self._gone or len(self._said) > before, WAIT_S)
        self._check()
        return self._stage

    def laid_flat(self, way: int) -> Tried | None:
        """What a way led to; None: it is gone."""
        self._send("lay", way)
        with self._changed:
            self._heard = time.monotonic()
        while not self._gone:
            with self._changed:
                self._changed.wait_for(lambda: self._gone or self._laid is not None, WAIT_S)
                if self._laid is not None and self._laid[0] == way:
                    return self._laid[1]
            self._check()
        return None

    def end(self) -> None:
        """Stop, and forget the task."""
        self._send("end")
        with self._changed:
            self._number += 1  # what it still says is of no task
            self._at, self._said, self._laid = None, {}, None

    # ---- the pipe

    def _start(self) -> None:
        ours, theirs = Pipe()
        environment = dict(os.environ)
        keep_little(environment)
        code = (
            f"import sys; sys.path[:] = {sys.path!r}\n"
            f"from vflatten_ros.helper import serve; serve({theirs.fileno()})"
        )
        self._ready = self._gone = False
        self._at = None
        self._outbox = queue.SimpleQueue()
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            pass_fds=[theirs.fileno()],
            env=environment,
            start_new_session=True,  # Ctrl-C reaches the group of a terminal: the caller decides
        )
        theirs.close()
        threading.Thread(target=self._write, args=(ours, self._outbox), daemon=True).start()
        threading.Thread(
            target=self._read, args=(ours, self._process, self._outbox), daemon=True
        ).start()

    def _send(self, kind: str, *content: Any) -> None:
        if not self._gone:
            self._outbox.put(_packed(kind, self._number, *content))

    @staticmethod
    def _write(pipe: Connection, outbox: queue.SimpleQueue[_Message | None]) -> None:
        with suppress(OSError):  # the reader sees that it is gone
            for message in iter(outbox.get, None):
                _send(pipe, message)
                del message  # a task is large

    def _read(
        self,
        pipe: Connection,
        process: subprocess.Popen[bytes],
        outbox: queue.SimpleQueue[_Message | None],
    ) -> None:
        with suppress(EOFError, OSError):
            while process is self._process:
                kind, number, *content = _received(pipe)
                with self._changed:
                    self._heard = time.monotonic()
                    if kind == "ready":
                        self._ready, self._stillborn = True, 0
                    elif number == self._number:
                        self._take(kind, content)
                    self._changed.notify_all()
        with self._changed:
            if process is self._process:
                self._stillborn += not self._ready
                self._gone = True
                self._changed.notify_all()
        outbox.put(None)

    def _take(self, kind: str, content: list[Any]) -> None:
        if kind == "stage":
            (self._stage,) = content
        elif kind == "laid":
            self._laid = (content[0], content[1])
        else:  # what it says of one way, and which it is at next
            said, self._at = content
            self._said |= said

    def _check(self) -> None:
        """Do without it if it hangs."""
        if time.monotonic() - self._heard > SILENT_S:
            self._process.kill()
            with self._changed:
                self._gone = True


_Message = list[bytes | memoryview]


def helper_for(processes: int) -> HelperProcess | None:
    """One, if two processes are wanted and there is more than one core for them."""
    return HelperProcess() if processes > 1 and len(os.sched_getaffinity(0)) > 1 else None


def _packed(*content: Any) -> _Message:
    """Arrays as they are, without a copy."""
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(content, protocol=5, buffer_callback=buffers.append)
    return [head, *(buffer.raw() for buffer in buffers)]


def _send(pipe: Connection, message: _Message) -> None:
    pipe.send_bytes(len(message).to_bytes(4, "big"))
    for part in message:
        pipe.send_bytes(part)


def _received(pipe: Connection) -> list[Any]:
    count = int.from_bytes(pipe.recv_bytes(), "big")
    head, *buffers = (pipe.recv_bytes() for _ in range(count))
    content: list[Any] = list(pickle.loads(head, buffers=buffers))
    return content


# ---- in the process


class _Interrupted(Exception):
    """The caller wants something else."""


class _Inbox:
    """What the caller wants; taken by a thread, so that it is seen in the midst of a way."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._changed = threading.Condition()
        self.number = 0  # of the task; 0: none
        self.task: tuple[Task, tuple[int, ...]] | None = None
        self.left: set[int] = set()
        self.wanted: int | None = None

    def receive(self) -> None:
        while True:
            try:
                message = _received(self._pipe)
            except (EOFError, OSError):
                os._exit(0)  # nobody is there any more
            with self._changed:
                self._take(*message)
                self._changed.notify_all()
            del message

    def _take(self, kind: str, number: int, *content: Any) -> None:
        if kind == "begin":
            self.number, self.task = number, (content[0], content[1])
            self.left, self.wanted = set(), None
        elif number != self.number:
            return
        elif kind == "leave":
            self.left.add(content[0])
        elif kind == "lay":
            self.wanted = content[0]
        else:
            self.number, self.task = 0, None

    def next_task(self) -> tuple[int, Task, tuple[int, ...]]:
        """Wait for one."""
        with self._changed:
            self._changed.wait_for(lambda: self.task is not None)
            assert self.task is not None
            (task, ways), self.task = self.task, None
            return self.number, task, ways

    def next_wanted(self, number: int) -> int | None:
        """Wait until something is wanted of a task; None: it is over."""
        with self._changed:
            self._changed.wait_for(lambda: self.number != number or self.wanted is not None)
            wanted, self.wanted = self.wanted, None
            return wanted if self.number == number else None


def serve(handle: int) -> None:
    """What the process runs: take tasks until the other end of the pipe is gone."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    pipe = Connection(handle)
    inbox = _Inbox(pipe)
    threading.Thread(target=inbox.receive, daemon=True).start()
    import vflatten_ros.core.ways  # noqa: F401  so that the first task need not wait for it

    with suppress(OSError):  # the caller is gone
        _send(pipe, _packed("ready", 0))
        while True:
            _work(pipe, inbox, *inbox.next_task())


def _work(pipe: Connection, inbox: _Inbox, number: int, task: Task, ways: tuple[int, ...]) -> None:
    from vflatten_ros.core.ways import Ways

    reported = 0.0
    finishing = False

    def report(stage: str, fraction: float) -> None:
        nonlocal reported
        if inbox.number != number or (inbox.wanted is not None and not finishing):
            raise _Interrupted
        now = time.monotonic()
        if now - reported > PERIOD_S:
            reported = now
            _send(pipe, _packed("stage", number, (stage, fraction)))

    trying = Ways(task)
    with suppress(_Interrupted):
        said: dict[int, Said] = {}
        for way in ways:
            if way in inbox.left:
                continue
            _send(pipe, _packed("said", number, said, way))
            said = {way: trying.verdict(way, report)}
        _send(pipe, _packed("said", number, said, None))
    finishing = True
    with suppress(_Interrupted):
        while (wanted := inbox.next_wanted(number)) is not None:
            _send(pipe, _packed("laid", number, wanted, trying.laid_flat(wanted, report)))
