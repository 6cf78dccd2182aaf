"""One ROS context for this process, and a node that most tests share."""

import pytest
import rclpy
from ros_rig import CALIBRATION, Rig

from vflatten_ros import transport


@pytest.fixture(scope="session", autouse=True)
def ros():
    transport.use_profile()
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture(scope="session")
def shared_rig(ros, tmp_path_factory):
    rig = Rig(tmp_path_factory.mktemp("rig"), arguments=["--calibration", str(CALIBRATION)])
    yield rig
    rig.close()


@pytest.fixture
def rig(shared_rig):
    """The shared node, with a new item and quick work."""
    shared_rig.set_parameter("geodesics.nodes", 30)
    shared_rig.set_parameter("auto_flatten", False)
    shared_rig.ask("new_item")
    return shared_rig
