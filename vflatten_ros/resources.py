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
    return _find(f"config/{relative}", PACKAGE / "config" / relative)


def message_definition(name: str) -> str:
    """Text of one of our messages, such as "Landmark"; raises InvalidConfig as `config_path`."""
    path = _find(f"msg/{name}.msg", PACKAGE / "definitions" / f"{name}.msg")
    return path.read_text(encoding="utf-8")


def manifest() -> str:
    """Text of package.xml, where it came along; raises InvalidConfig as `config_path`."""
    return _find("package.xml").read_text(encoding="utf-8")


def _find(relative: str, by_pip: Path | None = None) -> Path:
    """A file of the source tree: as pip installed it, in the tree itself, or as colcon did."""
    tried = [*([by_pip] if by_pip else []), *(root / relative for root in _roots())]
    for path in tried:
        if path.exists():
            return path
    raise InvalidConfig(
        f"{relative} is not installed; looked for {', '.join(map(str, tried))}; "
        "build the package and source its environment, or install it with pip"
    )


def _roots() -> Iterator[Path]:
    if (PACKAGE.parent / "package.xml").exists():
        yield PACKAGE.parent
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(prefix, "share", "vflatten_ros")
