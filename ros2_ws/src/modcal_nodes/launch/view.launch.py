"""The live view beside a cell: ``ros2 launch modcal_nodes view.launch.py arrow_scale:=300.0``.

Then ``rviz2 -d $(ros2 pkg prefix --share modcal_nodes)/config/modcal.rviz``, or modcal_foxglove.json in Foxglove.
"""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """The node with its config file; it hears the calibrator of the same namespace."""
    share = get_package_share_directory("modcal_nodes")
    # without a stated type, a whole number would not arrive as a float
    chosen = {"arrow_scale": ParameterValue(LaunchConfiguration("arrow_scale"), value_type=float)}
    return LaunchDescription(
        [
            DeclareLaunchArgument("arrow_scale", default_value="100.0"),
            Node(
                package="modcal_nodes",
                executable="viewer",
                parameters=[f"{share}/config/viewer.yaml", chosen],
            ),
        ]
    )
