"""What every test run needs: a ROS domain of its own, and the marker of the tests under ros/."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import pytest

from vflatten_ros import threads

threads.use_one()  # as the commands do, before numpy is imported

ROS_TESTS = Path(__file__).parent / "ros"
HAS_ROS = importlib.util.find_spec("rclpy") is not None

# Without ROS its tests are left out. `make test` has built it and says so: there they must run.
collect_ignore = [] if HAS_ROS or os.environ.get("VFLATTEN_REQUIRE_ROS") else ["ros"]


def pytest_configure() -> None:
    # Neither another process of the tests, another run, nor a robot on the network hears this one.
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


def pytest_report_header(config: pytest.Config) -> str:
    if not HAS_ROS:
        return "ROS: none, the tests under test/ros are left out"
    if config.getoption("numprocesses", None):
        return "ROS: a domain for each process"
    return f"ROS: domain {os.environ['ROS_DOMAIN_ID']}"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if ROS_TESTS in item.path.parents:
            item.add_marker(pytest.mark.ros)
    # files that take long first: of two processes none has much to do when the other is through
    long = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path not in long, ROS_TESTS not in item.path.parents))
