"""What the system knows of running processes."""

from __future__ import annotations

import time
from pathlib import Path


def children_of(pid, word):
    """Processes that one has started whose command has a word in it."""
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [
        int(child) for child in text.split() if word in Path(f"/proc/{child}/cmdline").read_bytes()
    ]


def gone(pid, within_s=20.0):
    """Whether a process, not necessarily our child, ends."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        try:
            if _fields(pid)[0] == "Z":
                return True
        except FileNotFoundError:
            return True
        time.sleep(0.05)
    return False


def _fields(pid):
    """Of /proc/PID/stat, from the state on."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
