"""A calibration is checked key by key."""

import numpy as np
import pytest

from vflatten_ros.core.calibration import KEYS, calibration_from
from vflatten_ros.core.errors import InvalidCalibration

GOOD = {
    "frame": "rig_optical",
    "axis_point": [0.0, -0.5, 1.3],
    "axis_direction": [0.0, -2.0, 0.0],
    "gripper_tip": [0.01, -0.5, 1.3],
    "joint": "wrist_roll",
    "joint_sign": -1,
    "joint_zero": 0.25,
    "note": "other keys are ignored",
}


def test_a_good_calibration_is_taken_and_its_axis_normalised():
    calibration = calibration_from(GOOD)
    assert calibration.axis_direction == (0.0, -1.0, 0.0)
    assert calibration.gripper_tip == (0.01, -0.5, 1.3)
    assert calibration.item_angle_rad(0.75) == pytest.approx(-0.5)
    rotation = calibration.T_rig_hanger(0.3)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("key", KEYS)
def test_a_missing_key_is_named(key):
    with pytest.raises(InvalidCalibration, match=f"{key} is missing"):
        calibration_from({name: value for name, value in GOOD.items() if name != key})
    with pytest.raises(InvalidCalibration, match=f"{key} is missing"):
        calibration_from({**GOOD, key: None})


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("axis_direction", [0, 0, 0], "no length"),
        ("axis_direction", [0, 1], "three finite numbers"),
        ("axis_direction", [0, float("nan"), 1], "three finite numbers"),
        ("axis_direction", "up", "three finite numbers"),
        ("axis_direction", [0, -0.5, 1.3], "passes .* from the rig's origin"),
        ("axis_point", [0.0, 0.0, 0.01], "passes .* from the rig's origin"),
        ("axis_point", [0.0, -500.0, 1300.0], "metres"),
        ("axis_point", {"x": 1}, "three finite numbers"),
        ("gripper_tip", [0.9, -0.5, 1.3], "from the wrist axis"),
        ("joint_sign", 0, "1 or -1"),
        ("joint_sign", 2.0, "1 or -1"),
        ("joint_sign", True, "number"),
        ("joint_zero", float("inf"), "number"),
        ("joint_zero", "0.25", "number"),
        ("joint", "", "name"),
        ("joint", 3, "name"),
        ("frame", "  ", "name"),
    ],
)
def test_a_wrong_value_is_named_with_what_came(key, value, words):
    with pytest.raises(InvalidCalibration, match=words) as refusal:
        calibration_from({**GOOD, key: value})
    assert key.split("_", maxsplit=1)[0] in str(refusal.value)


def test_no_mapping_is_refused():
    with pytest.raises(InvalidCalibration, match="keys and values"):
        calibration_from([1, 2])
