"""The node with its settings, and RViz if wanted.

ros2 launch vflatten_ros vflatten.launch.py calibration:=/path/calibration.yaml rviz:=true
Two rigs: launch twice, with namespace:=left and namespace:=right.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, SetParameter
from launch_ros.substitutions import FindPackageShare

SHOWN = ["rig/points", *(f"vflatten/{name}" for name in ("points", "markers", "contour", "image"))]
FLAT = "--x 0.9 --z 1.3 --roll 3.141593 --child-frame-id garment_flat"  # beside the item, v up


def generate_launch_description() -> LaunchDescription:
    config = PathJoinSubstitution([FindPackageShare("vflatten_ros"), "config"])
    layout = PathJoinSubstitution([config, "vflatten.rviz"])
    given = LaunchConfiguration
    arguments = {
        "params_file": (PathJoinSubstitution([config, "vflatten.yaml"]), "settings of the node"),
        "calibration": ("", "calibration.yaml of rig and gripper; wins over the settings' own"),
        "namespace": ("", "of the node and of its topics"),
        "use_sim_time": ("false", "take the time from /clock"),
        "rviz": ("false", "start RViz with all outputs"),
        "frame": ("rig_optical", "frame of the clouds, for RViz"),
    }
    with_rviz = IfCondition(given("rviz"))
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=value, description=text)
                for name, (value, text) in arguments.items()
            ),
            SetParameter("use_sim_time", True, condition=IfCondition(given("use_sim_time"))),
            Node(
                package="vflatten_ros",
                executable="vflatten_node",
                name="vflatten",
                namespace=given("namespace"),
                arguments=[["--calibration=", given("calibration")]],
                parameters=[given("params_file")],
                output="screen",
                respawn=True,
                respawn_delay=2.0,
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                namespace=given("namespace"),
                # the layout's topics are those of a node without a namespace
                remappings=[(f"/{topic}", topic) for topic in SHOWN],
                arguments=["-d", layout, "-f", given("frame")],
                condition=with_rviz,
            ),
            Node(  # where RViz draws the flat contour
                package="tf2_ros",
                executable="static_transform_publisher",
                arguments=[*FLAT.split(), "--frame-id", given("frame")],
                condition=with_rviz,
            ),
        ]
    )
