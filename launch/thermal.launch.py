"""Correction, rectification and stereo odometry for cameras that publish left|right/image_raw.

ros2 launch thermal_stereo_vo thermal.launch.py params:=my.yaml namespace:=front
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PACKAGE = "thermal_stereo_vo"
CORRECTED = [(f"{eye}/image_raw", f"{eye}/image_corrected") for eye in ("left", "right")]


def generate_launch_description() -> LaunchDescription:
    params = Path(get_package_share_directory(PACKAGE)) / "config" / "flight.yaml"
    arguments = [
        DeclareLaunchArgument("params", default_value=str(params), description="Settings file."),
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of the rig."),
        DeclareLaunchArgument(
            "use_sim_time", default_value="false", description="Follow /clock of a recording."
        ),
    ]
    common = {
        "package": PACKAGE,
        "namespace": LaunchConfiguration("namespace"),
        "output": "screen",
    }
    time = {"use_sim_time": LaunchConfiguration("use_sim_time")}
    correction = Node(
        executable="thermal_correction_node",
        parameters=[LaunchConfiguration("params"), time],
        **common,
    )
    followers = [
        Node(
            executable=executable,
            parameters=[LaunchConfiguration("params"), time, {"gated": True}],
            remappings=remappings,
            **common,
        )
        for executable, remappings in (
            ("rectification_node", CORRECTED),
            ("stereo_odometry_node", []),
        )
    ]
    return LaunchDescription([*arguments, correction, *followers])
