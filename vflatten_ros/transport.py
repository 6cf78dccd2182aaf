"""Lets Fast DDS carry large clouds between processes of one machine; call before rclpy.init."""

from __future__ import annotations

import os

from vflatten_ros import resources

VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"


def use_profile() -> None:
    """Use the profile that comes with the package, unless the user has chosen one.

    Other middlewares (CycloneDDS, Zenoh) ignore the variable.
    """
    if not (os.environ.get(VARIABLE) or os.environ.get("FASTDDS_DEFAULT_PROFILES_FILE")):
        os.environ[VARIABLE] = str(resources.config_path("fastdds.xml"))
