"""Recorder and calibrator beside a running cell: ``ros2 launch modcal_nodes calibrate.launch.py tip:=tool0``."""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Both nodes, with their config files; base and tip may be given."""
    share = get_package_share_directory("modcal_nodes")
    # without a stated type, an empty or numeric name would not arrive as text
    arm = {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in ("base", "tip")}
    return LaunchDescription(
        [
            DeclareLaunchArgument("base", default_value=""),
            DeclareLaunchArgument("tip", default_value=""),
            Node(package="modcal_nodes", executable="recorder", parameters=[f"{share}/config/recorder.yaml"]),
            Node(package="modcal_nodes", executable="calibrator", parameters=[f"{share}/config/calibrator.yaml", arm]),
        ]
    )
