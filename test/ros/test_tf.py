"""A calibration from TF; tf2_ros is not on PyPI, so a stand-in answers."""

from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
import slow_work
from rclpy.parameter import Parameter

from vflatten_ros import frames
from vflatten_ros.core.geometry import transform_points
from vflatten_ros.flatten_node import FlattenNode

INACTIVE, ACTIVE = 2, 3


class Buffer:
    """Knows nothing until told; then one transform."""

    known = False

    def __init__(self, node):
        self.node = node

    def can_transform(self, target, source, time):
        return Buffer.known

    def lookup_transform(self, target, source, time):
        if not Buffer.known:
            raise LookupError(f"{source} is not connected to {target}")
        assert (target, source) == ("rig_optical", "tool0")
        # a quarter turn about x: z of the tool is -y of the rig, upwards in an optical frame
        half = np.sqrt(0.5)
        rotation = SimpleNamespace(x=half, y=0.0, z=0.0, w=half)
        translation = SimpleNamespace(x=0.1, y=-0.5, z=1.3)
        return SimpleNamespace(
            transform=SimpleNamespace(rotation=rotation, translation=translation)
        )


@pytest.fixture
def node(ros, monkeypatch):
    monkeypatch.setattr(Buffer, "known", False)
    monkeypatch.setattr(
        frames,
        "tf2_ros",
        SimpleNamespace(
            Buffer=Buffer,
            TransformListener=lambda buffer, node: None,
            TransformException=LookupError,
        ),
    )
    node = FlattenNode("with_tf", loader=lambda folder: slow_work.load)
    values = {"frame": "rig_optical", "joint": "wrist_roll", "tf_frame": "tool0"}
    node.set_parameters([Parameter(f"calibration.{k}", value=v) for k, v in values.items()])
    yield node
    node.destroy_node()


def spin(node, seconds=5.0, until=lambda: False):
    end = node.get_clock().now().nanoseconds + seconds * 1e9
    while node.get_clock().now().nanoseconds < end and not until():
        rclpy.spin_once(node, timeout_sec=0.1)


def test_autostart_waits_for_the_transform_and_then_activates(node):
    node.autostart()
    assert node.lifecycle_state()[0] == INACTIVE
    assert node.trouble == (
        "calibration.tf_frame: waiting for a transform from 'tool0' to 'rig_optical'"
    )
    spin(node, 1.5)
    assert node.lifecycle_state()[0] == INACTIVE
    Buffer.known = True
    spin(node, until=lambda: node.lifecycle_state()[0] == ACTIVE)
    assert node.lifecycle_state()[0] == ACTIVE and not node.trouble
    calibration = node.session.calibration
    assert np.allclose(calibration.axis_direction, [0, -1, 0])
    above = transform_points(calibration.T_rig_hanger(0.3), np.array([0.0, 0.0, 0.2]))
    assert np.allclose(above, [0.1, -0.7, 1.3])


def test_a_node_that_was_stopped_meanwhile_stays_so(node):
    node.autostart()
    node.trigger_cleanup()
    Buffer.known = True
    spin(node, 1.5)
    assert node.lifecycle_state()[0] == 1
    node.trigger_configure()
    spin(node, 1.5)
    assert node.lifecycle_state()[0] == INACTIVE


def test_activation_by_hand_without_the_transform_says_which_is_missing(node):
    node.trigger_configure()
    node.trigger_activate()
    assert node.lifecycle_state()[0] == INACTIVE
    assert node.trouble == (
        "calibration.tf_frame: no transform from 'tool0' to 'rig_optical': "
        "tool0 is not connected to rig_optical"
    )
