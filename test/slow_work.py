"""Work for the tests of the flattening process: as long, as stubborn or as broken as asked for.

`geodesics.nodes` of the job's settings chooses what happens.
"""

from __future__ import annotations

import dataclasses
import os
import signal
import time

import garments

from vflatten_ros.worker import STOP

ENOUGH = 10  # views
GOOD, SLOW, STUBBORN, CRASH, WRONG, MISTAKE, SILENT, ENDLESS, UNTRUSTED = range(30, 39)
STEP_S = 0.02
HOURS_S = 1e4  # longer than any test waits


def load():
    return SlowWork()


def load_and_fail():
    raise ValueError("cannot even start")


class SlowWork:
    """Counts the views that were prepared before a job asked for them."""

    def __init__(self):
        self.prepared = []

    def prepare(self, view, config):
        self.prepared.append(view.view_id)
        if config.geodesics.nodes == WRONG:
            raise ValueError("a view that cannot be prepared")

    def flatten(self, views, job, progress):
        garment = example_or_trouble(job.config.geodesics.nodes, progress)
        return garment, {"garment": b"bytes", "prepared": bytes(self.prepared)}


def example_or_trouble(what, progress):
    from vflatten_ros.core.errors import NotEnoughViews
    from vflatten_ros.core.values import Notice

    if what == STUBBORN:  # before it says that it works, or a quick cancel is heard
        signal.pthread_sigmask(signal.SIG_BLOCK, {STOP})  # as a long computation in C
    progress("work", 0.0)
    if what in (SILENT, STUBBORN):
        time.sleep(HOURS_S)  # without a word
    if what == CRASH:
        os._exit(7)
    if what == WRONG:
        raise NotEnoughViews("three views are needed")
    if what == MISTAKE:
        raise ZeroDivisionError("a mistake of ours")
    steps = {SLOW: 100, ENDLESS: int(HOURS_S / STEP_S)}.get(what, 2)
    for step in range(steps):
        progress("work", step / steps)
        time.sleep(STEP_S)
    garment = garments.example_garment()
    if what == UNTRUSTED:
        notices = (*garment.notices, Notice("untrusted", "nobody knows"))
        garment = dataclasses.replace(garment, notices=notices)
    return garment
