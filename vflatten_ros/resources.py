"""Where the files of config/ and msg/ are, however the package came here."""

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


def message_definition(name: str) -> str:
    """Text of one of our messages, such as "Landmark".

    Raises
    ------
    InvalidConfig
        None of the places has it; the message lists them.
    """
    tried = [folder / f"{name}.msg" for folder in _message_folders()]
    for path in tried:
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise InvalidConfig(
        f"msg/{name}.msg is not installed; looked for {', '.join(map(str, tried))}; "
        "build the package and source its environment, or install it with pip"
    )


def _message_folders() -> Iterator[Path]:
    yield PACKAGE / "definitions"  # installed by pip
    if (PACKAGE.parent / "package.xml").exists():
        yield PACKAGE.parent / "msg"  # source tree
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(prefix, "share", "vflatten_ros", "msg")  # installed by colcon


def manifest() -> str:
    """Text of package.xml, in the source tree or as colcon installs it."""
    places = [PACKAGE.parent / "package.xml"]
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        places.append(Path(prefix, "share", "vflatten_ros", "package.xml"))
    for path in places:
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise InvalidConfig(f"package.xml is not installed; looked for {', '.join(map(str, places))}")
