"""Reads the descriptions of the garment categories (config/categories/*.yaml)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import yaml

from vflatten_ros.core.errors import InvalidConfig
from vflatten_ros.core.templates import Template, templates_from

_HERE = Path(__file__).resolve().parent
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the one in C is ten times as fast


def default_folder() -> Path:
    """Where the descriptions lie: in the source tree, in the Python package, or in a ROS prefix.

    Raises
    ------
    InvalidConfig
        They are in none of these places.
    """
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    places = [_HERE.parent / "config", _HERE / "config"]
    places += [Path(p) / "share" / "vflatten_ros" / "config" for p in prefixes if p]
    for place in places:
        if any((place / "categories").glob("*.yaml")):
            return place / "categories"
    raise InvalidConfig(
        f"no categories/*.yaml in {', '.join(map(str, places))}; name the folder of the categories"
    )


def load_templates(folder: Path | str | None = None) -> tuple[Template, ...]:
    """All categories of a folder, sorted by name.

    Parameters
    ----------
    folder : path, optional
        Holds one .yaml file for every category; by default the folder that comes with the program.

    Raises
    ------
    InvalidConfig
        No file there, or one that cannot be read or used; names the file.
    """
    folder = Path(folder) if folder is not None else default_folder()
    files = sorted(folder.glob("*.yaml"))
    if not files:
        raise InvalidConfig(f"{folder}: no .yaml file; expected one for every category")
    descriptions = [_read(path) for path in files]
    for path, description in zip(files, descriptions):
        try:
            templates_from([description])
        except InvalidConfig as error:
            raise InvalidConfig(f"{path}: {error}") from error
    return templates_from(descriptions)


def _read(path: Path) -> dict[str, Any]:
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), LOADER)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InvalidConfig(f"{path}: cannot be read: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise InvalidConfig(f"{path}: expected keys and values, got {type(data).__name__}")
    return data
