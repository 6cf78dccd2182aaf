"""How much memory the processes that we start keep to themselves."""

from __future__ import annotations

from collections.abc import MutableMapping

# glibc gives larger arrays back when they are freed; left to itself it soon keeps most of them, and
# those of each thread for that thread alone: half as much memory again. With a fixed threshold it
# would give smaller ones back at once, too, to ask for them again (a tenth of the time)
SETTINGS = {
    "MALLOC_MMAP_THRESHOLD_": str(4 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(32 << 20),
    "MALLOC_ARENA_MAX": "1",
}


def keep_little(environment: MutableMapping[str, str]) -> None:
    """For processes started with this environment, unless it says otherwise."""
    for name, value in SETTINGS.items():
        environment.setdefault(name, value)
