"""The node with its settings, and RViz if wanted.

ros2 launch vflatten_ros vflatten.launch.py calibration:=/path/calibration.yaml rviz:=true
Two rigs: launch twice, with namespace:=left and namespace:=right.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SHOWN = ["rig/points", *(f"vflatten/{name}" for name in ("points", "markers", "contour", "image"))]


def generate_launch_description() -> LaunchDescription:
    config = PathJoinSubstitution([FindPackageShare("vflatten_ros"), "config"])
    arguments = {
        "params_file": (PathJoinSubstitution([config, "vflatten.yaml"]), "settings of the node"),
        "calibration": ("", "calibration.yaml of rig and gripper"),
        "namespace": ("", "of the node and of its topics"),
        "use_sim_time": ("false", "take the time from /clock"),
        "rviz": ("false", "start RViz with all outputs"),
    }
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=value, description=text)
                for name, (value, text) in arguments.items()
            ),
            Node(
                package="vflatten_ros",
                executable="vflatten_node",
                name="vflatten",
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    {
                        "calibration.file": LaunchConfiguration("calibration"),
                        "use_sim_time": LaunchConfiguration("use_sim_time"),
                    },
                    LaunchConfiguration("params_file"),  # wins where both say something
                ],
                output="screen",
                respawn=True,
                respawn_delay=2.0,
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                namespace=LaunchConfiguration("namespace"),
                # the layout's topics are those of a node without a namespace
                remappings=[(f"/{topic}", topic) for topic in SHOWN],
                arguments=["-d", PathJoinSubstitution([config, "vflatten.rviz"])],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
            Node(  # where RViz draws the flat contour: beside the item, u right, v up
                package="tf2_ros",
                executable="static_transform_publisher",
                arguments=[
                    "--x",
                    "0.9",
                    "--z",
                    "1.3",
                    "--roll",
                    "3.141593",
                    "--frame-id",
                    "rig_optical",
                    "--child-frame-id",
                    "garment_flat",
                ],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
