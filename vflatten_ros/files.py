"""Calibration, protocol and settings files."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml

from vflatten_ros.core.calibration import calibration_from
from vflatten_ros.core.config import Config, config_from, flatten_config
from vflatten_ros.core.errors import InvalidCalibration, InvalidConfig, InvalidCorrespondence
from vflatten_ros.core.values import Calibration, Correspondence
from vflatten_ros.parameters import entries

CALIBRATION_NAME = "calibration.yaml"
SECTIONS = {name.split(".")[0] for name in flatten_config(Config()) if "." in name}


def calibration_beside(recording: str | Path) -> Path:
    """Where a recording's calibration is looked for: in its folder."""
    path = Path(recording)
    return (path if path.is_dir() else path.parent) / CALIBRATION_NAME


def load_calibration(path: str | Path) -> Calibration:
    """Read calibration.yaml.

    Raises
    ------
    InvalidCalibration
        The file is missing, no YAML, or one of its keys is wrong; names file and key.
    """
    path = Path(path)
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InvalidCalibration(f"{path}: no such file; give one with --calibration") from error
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InvalidCalibration(f"{path}: cannot be read as YAML: {_one_line(error)}") from error
    try:
        return calibration_from(values)
    except InvalidCalibration as error:
        raise InvalidCalibration(f"{path}: {error}") from error


def load_protocol(path: str | Path) -> tuple[tuple[int, ...], tuple[Correspondence, ...]]:
    """Read protocol.json: the views chosen by a person, and points that correspond between them.

    Returns
    -------
    view_ids : tuple of int
    correspondences : tuple of Correspondence

    Raises
    ------
    InvalidCorrespondence
        The file is missing, no JSON, or lacks views or pairs.
    """
    path = Path(path)
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InvalidCorrespondence(f"{path}: no such file; check --protocol") from error
    except (OSError, ValueError) as error:
        raise InvalidCorrespondence(
            f"{path}: cannot be read as JSON: {_one_line(error)}"
        ) from error
    try:
        views = tuple(_whole(view) for view in values["views"])
        pairs = [(_pixel(pair["a"]), _pixel(pair["b"])) for pair in values["pairs"]]
        first, second = views
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidCorrespondence(
            f"{path}: expected 'views': [i, j] and 'pairs': [{{'a': [row, col], 'b': [row, col]}}, "
            f"...]; trouble with {_one_line(error)}"
        ) from error
    return views, tuple(Correspondence(first, second, a, b) for a, b in pairs)


def load_config(path: str | Path) -> Config:
    """Read the method's settings from a ROS parameter file; the node's own are passed over.

    Parameters
    ----------
    path : path
        YAML as config/vflatten.yaml, or the settings alone without `ros__parameters`.

    Raises
    ------
    InvalidConfig
        The file is missing, no YAML, or names an unknown setting or a wrong value.
    """
    path = Path(path)
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except FileNotFoundError as error:
        raise InvalidConfig(f"{path}: no such file; check --config") from error
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InvalidConfig(f"{path}: cannot be read as YAML: {_one_line(error)}") from error
    if not isinstance(values, Mapping):
        raise InvalidConfig(f"{path}: expected settings, name: value; got {type(values).__name__}")
    try:
        given = dict(_settings(values))
    except InvalidConfig as error:
        raise InvalidConfig(f"{path}: {error}") from error
    core = flatten_config(Config())
    known = set(core) | {entry.name for entry in entries()} | {"use_sim_time"}
    unknown = sorted(set(given) - known)
    if unknown:
        near = get_close_matches(unknown[0], sorted(known), n=1)
        hint = f"did you mean {near[0]!r}?" if near else "see docs/parameters.md"
        raise InvalidConfig(f"{path}: unknown setting {unknown[0]!r}; {hint}")
    try:
        return config_from({name: value for name, value in given.items() if name in core})
    except InvalidConfig as error:
        raise InvalidConfig(f"{path}: {error}") from error


def _settings(values: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Nested settings as 'section.name', value; the levels of node names are left out."""
    for key, value in values.items():
        if isinstance(value, Mapping) and "ros__parameters" in value:
            yield from _settings(_section(value["ros__parameters"]))
        elif key == "ros__parameters":
            yield from _settings(_section(value))
        elif value is None and not prefix and key in SECTIONS:
            continue  # nothing is set in it
        elif isinstance(value, Mapping):
            yield from _settings(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _section(value: Any) -> Mapping[Any, Any]:
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise InvalidConfig(f"ros__parameters: expected settings, name: value; got {value!r}")
    return value


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not math.isfinite(value) or int(value) != value or value < 0:
        raise ValueError(f"{value!r}, expected a whole number")
    return int(value)


def _pixel(values: Any) -> tuple[int, int]:
    row, col = values
    return _whole(row), _whole(col)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
