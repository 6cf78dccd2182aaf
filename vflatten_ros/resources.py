"""Where the files of config/ are, however the package came here."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from vflatten_ros.core.errors import InvalidConfig

PACKAGE = Path(__file__).resolve().parent


def config_path(relative: str) -> Path:
    """A file or folder of config/, such as "categories" or "vflatten.yaml".

    Raises
    ------
    InvalidConfig
        None of the places has it; the message lists them.
    """
    tried = [folder / relative for folder in _config_folders()]
    for path in tried:
        if path.exists():
            return path
    raise InvalidConfig(
        f"config/{relative} is not installed; looked for {', '.join(map(str, tried))}; "
        "build the package and source its environment, or install it with pip"
    )


def _config_folders() -> Iterator[Path]:
    yield PACKAGE / "config"  # installed by pip
    if (PACKAGE.parent / "package.xml").exists():
        yield PACKAGE.parent / "config"  # source tree
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(prefix, "share", "vflatten_ros", "config")  # installed by colcon
