"""Bounds of accelerations beside a running arm: ``ros2 launch modcal_nodes limits.launch.py payload_kg:=3.0``."""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """The node with its config file, the arm's ends and its payload."""
    share = get_package_share_directory("modcal_nodes")
    # without a stated type, an empty or numeric name would not arrive as text, nor "3" as a float
    chosen = {
        "base": ParameterValue(LaunchConfiguration("base"), value_type=str),
        "tip": ParameterValue(LaunchConfiguration("tip"), value_type=str),
        "payload_kg": ParameterValue(LaunchConfiguration("payload_kg"), value_type=float),
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument("base", default_value=""),
            DeclareLaunchArgument("tip", default_value=""),
            DeclareLaunchArgument("payload_kg", default_value="0.0"),
            Node(
                package="modcal_nodes",
                executable="acceleration_limits",
                parameters=[f"{share}/config/acceleration_limits.yaml", chosen],
            ),
        ]
    )
