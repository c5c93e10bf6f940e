"""A recording through the chain of nodes, every frame of it.

ros2 launch thermal_stereo_vo replay.launch.py source:=/data/flight rate:=0
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PACKAGE = "thermal_stereo_vo"


def generate_launch_description() -> LaunchDescription:
    params = Path(get_package_share_directory(PACKAGE)) / "config" / "recording.yaml"
    arguments = [
        DeclareLaunchArgument("source", description="Recording to play."),
        DeclareLaunchArgument("calibration", default_value="", description="Calibration file."),
        DeclareLaunchArgument(
            "rate", default_value="1.0", description="Speed; 0 is as fast as the odometry answers."
        ),
        DeclareLaunchArgument("params", default_value=str(params), description="Settings file."),
    ]
    chain = [
        Node(
            package=PACKAGE,
            executable=executable,
            parameters=[LaunchConfiguration("params"), {"use_sim_time": True}],
            output="screen",
        )
        for executable in ("rectification_node", "stereo_odometry_node")
    ]
    replay = Node(
        package=PACKAGE,
        executable="replay_node",
        parameters=[
            LaunchConfiguration("params"),
            {
                "source": ParameterValue(LaunchConfiguration("source"), value_type=str),
                "calibration": ParameterValue(LaunchConfiguration("calibration"), value_type=str),
                "rate": ParameterValue(LaunchConfiguration("rate"), value_type=float),
            },
        ],
        output="screen",
    )
    end = RegisterEventHandler(
        OnProcessExit(target_action=replay, on_exit=[EmitEvent(event=Shutdown())])
    )
    return LaunchDescription([*arguments, *chain, replay, end])
