"""Everything for flight in one process.

ros2 launch thermal_stereo_vo onboard.launch.py params:=my.yaml namespace:=front
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PACKAGE = "thermal_stereo_vo"


def generate_launch_description() -> LaunchDescription:
    params = Path(get_package_share_directory(PACKAGE)) / "config" / "flight.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params", default_value=str(params), description="Settings file."
            ),
            DeclareLaunchArgument(
                "namespace", default_value="", description="Namespace of the rig."
            ),
            DeclareLaunchArgument(
                "use_sim_time", default_value="false", description="Follow /clock of a recording."
            ),
            Node(
                package=PACKAGE,
                executable="onboard_node",
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    LaunchConfiguration("params"),
                    {"use_sim_time": LaunchConfiguration("use_sim_time")},
                ],
                output="screen",
            ),
        ]
    )
