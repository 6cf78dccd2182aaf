"""The result of a flattening as one JSON object (docs/interfaces.md lists its keys).

It is made from message fields, so that a planner that received our messages writes the very same
numbers as `vflatten replay`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vflatten_ros.core.geometry import transform_points
from vflatten_ros.core.values import Calibration, FlatGarment, Float, View
from vflatten_ros.messages import (
    INFERRED,
    PROBABILITY,
    UNSEEN_NOTHING,
    UNSEEN_TURN,
    flattened_view_fields,
    garment_estimate_fields,
    stamp_ns,
)
from vflatten_ros.output_files import whole_file

Result = dict[str, Any]


def garment_result(garment: FlatGarment, views: Sequence[View]) -> Result:
    """The JSON object of a garment that was flattened from `views`."""
    return result_from_fields(
        flattened_view_fields(garment, views),
        garment_estimate_fields(garment, views),
        garment.calibration,
    )


def result_from_fields(
    flattened: Mapping[str, Any], estimate: Mapping[str, Any], calibration: Calibration
) -> Result:
    """The JSON object of a FlattenedView and its GarmentEstimate.

    Parameters
    ----------
    flattened, estimate : mapping
        Message fields, from `messages` or from `messages.read(message)`.
    calibration : Calibration
        Takes hanging points to the rig frame at item angle 0.

    Returns
    -------
    dict
        Plain Python values; metres, radians.
    """
    T_rig_hanger0 = calibration.T_rig_hanger(0.0)
    sizes = {m["name"]: m for m in estimate["measurements"]}
    return {
        "category": estimate["category"],
        "score_kind": "probability" if estimate["score_kind"] == PROBABILITY else "R",
        "scores": {h["category"]: h["score"] for h in estimate["hypotheses"]},
        "width_m": _size(sizes.get("width"), "value"),
        "width_sigma_m": _size(sizes.get("width"), "sigma"),
        "length_m": _size(sizes.get("length"), "value"),
        "length_sigma_m": _size(sizes.get("length"), "sigma"),
        "measurements": [_measurement(m) for m in estimate["measurements"]],
        "trusted": bool(estimate["trusted"]),
        "enough": bool(estimate["enough"]),
        "unseen": _unseen(estimate),
        "quality": float(estimate["quality"]),
        "coverage": float(estimate["coverage"]),
        "method": flattened["method"],
        "stamp_ns": stamp_ns(flattened["header"]["stamp"]),
        "frame": flattened["header"]["frame_id"],
        "views": _views(flattened),
        "warnings": list(estimate["notice_texts"]),
        "notices": [
            {"code": code, "text": text}
            for code, text in zip(estimate["notice_codes"], estimate["notice_texts"], strict=True)
        ],
        "landmarks": [_landmark(mark, T_rig_hanger0) for mark in estimate["landmarks"]],
        "contour_uv": np.c_[flattened["contour_u"], flattened["contour_v"]].tolist(),
        "contour_sigma_m": np.asarray(flattened["contour_sigma"]).tolist(),
        "contour_inferred": _inferred(flattened["contour_evidence"]),
        "stress_rms_m": float(flattened["stress_rms"]),
        "points": _points(flattened),
    }


def _views(flattened: Mapping[str, Any]) -> list[Result]:
    """Views used; their shares of what was seen are null where they are not known."""
    known = len(flattened["view_shows"]) == len(flattened["view_ids"])
    return [
        {
            "id": int(i),
            "angle_rad": float(flattened["view_angles"][k]),
            **{
                name: float(flattened[f"view_{name}"][k]) if known else None
                for name in ("shows", "only", "first")
            },
        }
        for k, i in enumerate(flattened["view_ids"])
    ]


def _unseen(estimate: Mapping[str, Any]) -> Result | None:
    kind = int(estimate["unseen"])
    if kind == UNSEEN_NOTHING:
        return None
    return {"turn_to_rad": float(estimate["turn_to"]) if kind == UNSEEN_TURN else None}


def _size(measurement: Mapping[str, Any] | None, key: str) -> float | None:
    return None if measurement is None else float(measurement[key])


def _measurement(fields: Mapping[str, Any]) -> Result:
    return {
        "name": fields["name"],
        "value_m": float(fields["value"]),
        "sigma_m": float(fields["sigma"]),
        "inferred": int(fields["evidence"]) == INFERRED,
    }


def _landmark(fields: Mapping[str, Any], T_rig_hanger0: Float) -> Result:
    hanging = np.array([fields["position"][axis] for axis in "xyz"], dtype=np.float64)
    sigma_m = float(fields["position_sigma"])
    placed = bool(np.isfinite(sigma_m))
    views = [int(i) for i in fields["views"]]
    return {
        "name": fields["name"],
        "uv": [float(fields["u"]), float(fields["v"])],
        "uv_sigma_m": float(fields["uv_sigma"]),
        "seen": bool(fields["seen"]),
        "xyz": transform_points(T_rig_hanger0, hanging).tolist() if placed else None,
        "xyz_sigma_m": sigma_m if placed else None,
        "view": views[0] if views else None,
        "views": views,
        "certainty": float(fields["certainty"]),
    }


def _points(flattened: Mapping[str, Any]) -> Result:
    """The points that are a pixel of a view; those that only a template places have none."""
    given = {k: np.asarray(flattened[k]) for k in ("view", "row", "col")}
    real = (given["view"] >= 0) & (given["row"] >= 0) & (given["col"] >= 0)
    chosen = {key: values[real].tolist() for key, values in given.items()}
    for key, name in (("u", "u"), ("v", "v"), ("sigma", "sigma_m"), ("stress", "stress_m")):
        chosen[name] = np.asarray(flattened[key])[real].tolist()
    chosen["inferred"] = _inferred(np.asarray(flattened["evidence"])[real])
    return chosen


def _inferred(evidence: Any) -> list[bool]:
    flags: list[bool] = (np.asarray(evidence) == INFERRED).tolist()
    return flags


def json_text(result: Mapping[str, Any]) -> str:
    """JSON with one top-level key a line; numbers in full, what is not finite as null."""
    lines = (
        f" {json.dumps(key)}: {json.dumps(_finite(value), allow_nan=False)}"
        for key, value in result.items()
    )
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return value


def write_json(path: Path, result: Mapping[str, Any]) -> None:
    """Write the object; raises OSError."""
    with whole_file(path) as partial:
        partial.write_text(json_text(result), encoding="utf-8")
