"""Calibration and protocol files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from vflatten_ros.core.calibration import calibration_from
from vflatten_ros.core.errors import InvalidCalibration, InvalidCorrespondence
from vflatten_ros.core.values import Calibration, Correspondence

CALIBRATION_NAME = "calibration.yaml"


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


def _whole(value: Any) -> int:
    if isinstance(value, bool) or int(value) != value or value < 0:
        raise ValueError(f"{value!r}, expected a whole number")
    return int(value)


def _pixel(values: Any) -> tuple[int, int]:
    row, col = values
    return _whole(row), _whole(col)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
