"""The helper process: real ones, killed, stopped and left alone."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from recordings import BAGS
from running import gone

from vflatten_ros import helper as helping
from vflatten_ros.bag import gather_views, open_recording
from vflatten_ros.categories import load_templates
from vflatten_ros.core import hypotheses, ways
from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import Cancelled
from vflatten_ros.core.pipeline import flatten_garment, prepare_view
from vflatten_ros.core.values import no_progress
from vflatten_ros.files import calibration_beside, load_calibration
from vflatten_ros.helper import HelperProcess
from vflatten_ros.processes import SETTINGS

COARSE = {"spacing_m": 0.012, "link_m": 0.0264, "landmarks": 80}  # soon done, and all ways tried
CONFIG = dataclasses.replace(
    Config(), rotation=dataclasses.replace(Config().rotation, draw=2, **COARSE)
)  # the best way of the item is one that the helper tries
TEMPLATES = load_templates()
READY_S = 60.0


def alike(a, b, path=""):
    """Where two values differ, to the bit."""
    if dataclasses.is_dataclass(a):
        names = [field.name for field in dataclasses.fields(a)]
        return [p for n in names for p in alike(getattr(a, n), getattr(b, n), f"{path}.{n}")]
    if isinstance(a, dict):
        return [p for k in a.keys() | b.keys() for p in alike(a[k], b[k], f"{path}[{k}]")]
    if isinstance(a, (tuple, list)):
        if len(a) != len(b):
            return [path]
        return [p for i, (x, y) in enumerate(zip(a, b)) for p in alike(x, y, f"{path}[{i}]")]
    if isinstance(a, np.ndarray):
        same = a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        return [] if same else [path]
    return [] if a == b else [path]


def until_it_speaks(helper, stage):
    """The caller is late at its first way: the helper has said something of another before."""
    while stage == "link" and helper.ready and helper.at() is not None and not helper.said():
        time.sleep(0.02)


class Item:
    """An item that needs all ways, as it is looked at; what it is by one process."""

    def __init__(self):
        folder = BAGS / "SK2_1"
        rig = load_calibration(calibration_beside(folder))
        self.views = gather_views(open_recording(folder), rig, CONFIG).views()
        self.prepared = {view.view_id: prepare_view(view, CONFIG) for view in self.views}
        self.tried = []
        self.alone = self.flattened(None, lambda stage, _: self.tried.append(stage))

    def flattened(self, helper, progress=no_progress):
        return flatten_garment(
            self.views, (), TEMPLATES, CONFIG, progress, self.prepared, helper=helper
        )


@pytest.fixture(scope="module")
def item():
    return Item()


@pytest.fixture
def helper():
    with HelperProcess() as process:
        assert process.wait_until_ready(READY_S)
        yield process


def test_two_processes_give_what_one_gives_to_the_bit(item, helper, monkeypatch):
    laid_flat, fetched = HelperProcess.laid_flat, []
    monkeypatch.setattr(
        HelperProcess, "laid_flat", lambda self, k: (fetched.append(k), laid_flat(self, k))[1]
    )
    assert item.tried.count("link") > 2 and item.tried.count("ramps") > 1  # both draws

    def patient(stage, fraction):
        """The caller is late at its first way: the helper does all of its own."""
        while stage == "link" and helper.at() is not None:
            time.sleep(0.02)

    assert alike(item.flattened(helper, patient), item.alone) == []
    assert fetched  # it took part, and had the best way
    assert alike(item.flattened(helper), item.alone) == []  # and forgot what was before


def test_what_goes_to_another_process_adds_up_the_same_there(item, monkeypatch):
    """An array that is a view of another is copied on the way, and its sums round otherwise."""
    sent = []
    search = hypotheses.likeliest

    def likeliest(fused, *rest):
        sent.append(ways.Task(fused, *rest[:2]))
        sent.append(search(fused, *rest))
        return sent[-1]

    monkeypatch.setattr("vflatten_ros.core.pipeline.likeliest", likeliest)
    item.flattened(None)
    for value in sent:
        head, *buffers = helping._packed(value)
        (copy,) = helping.pickle.loads(head, buffers=buffers)
        assert odd_layouts(value, copy) == []
        assert alike(value, copy) == []


def odd_layouts(a, b, path=""):
    if dataclasses.is_dataclass(a):
        names = [field.name for field in dataclasses.fields(a)]
        return [p for n in names for p in odd_layouts(getattr(a, n), getattr(b, n), f"{path}.{n}")]
    if isinstance(a, dict):
        return [p for k in a for p in odd_layouts(a[k], b[k], f"{path}[{k}]")]
    if isinstance(a, (tuple, list)):
        return [p for i, (x, y) in enumerate(zip(a, b)) for p in odd_layouts(x, y, f"{path}[{i}]")]
    if isinstance(a, np.ndarray) and a.size:
        return [] if a.strides == b.strides else [path]
    return []


@pytest.mark.parametrize("when", ["as it begins", "when it has said something"])
def test_if_it_is_killed_the_result_is_the_same_and_there_is_another_next_time(
    item, helper, capfd, when
):
    pid, threads = helper.pid, threading.active_count()

    def kill(stage, fraction):
        if when != "as it begins" and helper.pid == pid:
            until_it_speaks(helper, stage)
        now = stage == "link" if when == "as it begins" else helper.said()
        if helper.pid == pid and helper.ready and now:
            os.kill(pid, signal.SIGKILL)

    assert alike(item.flattened(helper, kill), item.alone) == []
    assert not helper.ready
    assert alike(item.flattened(helper), item.alone) == []
    assert helper.wait_until_ready(READY_S) and helper.pid != pid
    assert "helper process ended (-9), starting another" in capfd.readouterr().err
    assert threading.active_count() == threads


def test_if_it_hangs_the_result_is_the_same(item, helper, monkeypatch):
    monkeypatch.setattr(helping, "SILENT_S", 1.0)

    def stop(stage, fraction):
        until_it_speaks(helper, stage)
        if helper.ready and helper.said():
            os.kill(helper.pid, signal.SIGSTOP)

    assert alike(item.flattened(helper, stop), item.alone) == []
    assert not helper.ready and gone(helper.pid)


def test_a_cancelled_task_is_left_and_the_next_one_done(item, helper):
    def cancel(stage, fraction):
        until_it_speaks(helper, stage)
        if helper.said():
            raise Cancelled("the caller asked to stop")

    with pytest.raises(Cancelled):
        item.flattened(helper, cancel)
    time.sleep(1.0)  # what it had said before it heard of it is not taken for news
    assert helper.ready and helper.said() == {} and helper.at() is None
    assert alike(item.flattened(helper), item.alone) == []


@pytest.mark.parametrize(("processes", "cores"), [(1, 2), (2, 1)])
def test_there_is_none_where_none_is_wanted_or_could_run(monkeypatch, processes, cores):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(cores)))
    monkeypatch.setattr(helping, "HelperProcess", lambda: pytest.fail("one was started"))
    assert helping.helper_for(processes) is None


def test_it_gives_memory_back(helper):
    environment = Path(f"/proc/{helper.pid}/environ").read_bytes().split(b"\0")
    assert {f"{name}={value}".encode() for name, value in SETTINGS.items()} <= set(environment)


def test_what_interrupts_its_caller_does_not_reach_it():
    """Ctrl-C goes to the process group of the terminal, from the first moment on."""
    with HelperProcess() as another:
        assert os.getpgid(another.pid) != os.getpgid(0)
        assert os.getsid(another.pid) != os.getsid(0)


def test_it_ends_with_its_caller():
    code = (
        "import time\nfrom vflatten_ros.helper import HelperProcess\n"
        "helper = HelperProcess()\nassert helper.wait_until_ready(60)\n"
        "print(helper.pid, flush=True)\ntime.sleep(600)"
    )
    caller = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    pid = int(caller.stdout.readline())
    assert not gone(pid, 0.2)
    caller.kill()
    caller.wait()
    assert gone(pid)


def test_no_more_are_started_where_none_comes_to_life(monkeypatch, capfd):
    started = []
    monkeypatch.setattr(sys, "executable", "/bin/false")
    start = HelperProcess._start
    monkeypatch.setattr(HelperProcess, "_start", lambda self: (started.append(1), start(self)))
    with HelperProcess() as process:
        for _ in range(9):
            assert not process.wait_until_ready(READY_S)
            process.begin(None, (2, 3))
            assert process.at() is None and process.said() == {} and process.laid_flat(2) is None
            process.end()
    assert len(started) == helping.STILLBORN
    assert capfd.readouterr().err.count("helper process ended (1)") == helping.STILLBORN - 1
