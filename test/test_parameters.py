"""Parameters are the settings: names, defaults, ranges and the reference come from one place."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from vflatten_ros import parameters
from vflatten_ros.core.config import Config, flatten_config
from vflatten_ros.core.errors import InvalidConfig
from vflatten_ros.parameters import Settings, entries

ROOT = Path(__file__).parents[1]


def test_every_setting_of_the_method_is_a_parameter_with_its_default():
    defaults = {entry.name: entry.default for entry in entries()}
    method = flatten_config(Config())
    assert {name: defaults[name] for name in method} == method


def test_names_are_unique_and_described():
    names = [entry.name for entry in entries()]
    assert len(names) == len(set(names))
    assert all(entry.doc.endswith((".", ".'")) for entry in entries())


def test_changes_give_new_settings_and_leave_the_old():
    old = Settings()
    new = old.changed({"geodesics.nodes": 40, "clouds.depth": 3, "auto_flatten": False})
    assert (new.core.geodesics.nodes, new.node.clouds.depth) == (40, 3)
    assert not new.node.node.auto_flatten
    assert old == Settings()


@pytest.mark.parametrize(
    "values, reason",
    [
        ({"geodesics.nodes": 2}, "^geodesics.nodes: expected 3 to 500"),
        (
            {"clouds.reliability": "sometimes"},
            "^clouds.reliability: .* one of best_effort, reliable",
        ),
        ({"max_queued_goals": True}, "^max_queued_goals: expected int"),
        ({"calibration.joint_sign": 0.5}, r"^calibration.joint_sign: expected \+1 or -1, got 0.5"),
        ({"method": "magic"}, "^method: expected one of rotation, kita2019"),
    ],
)
def test_a_wrong_value_is_refused_with_the_reason(values, reason):
    with pytest.raises(InvalidConfig, match=reason):
        Settings().changed(values)


def test_the_reference_is_up_to_date():
    written = (ROOT / "docs" / "parameters.md").read_text(encoding="utf-8")
    assert written == parameters.reference(), (
        "run: python3 -m vflatten_ros.parameters > docs/parameters.md"
    )


def test_the_shipped_file_names_parameters_that_exist_with_their_defaults():
    text = (ROOT / "config" / "vflatten.yaml").read_text(encoding="utf-8")
    given = yaml.safe_load(text)["/**"]["ros__parameters"]
    defaults = {entry.name: entry.default for entry in entries()}
    assert {name: defaults.get(name) for name in given} == given
