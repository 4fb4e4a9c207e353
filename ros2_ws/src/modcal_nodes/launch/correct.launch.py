"""A corrector before a controller: ``ros2 launch modcal_nodes correct.launch.py calibration:=modcal_calibration``.

Without a calibration it takes the one that a calibrator in the same namespace publishes.
"""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """The node with its config file; what it commands goes to the topic ``command``, if one is named."""
    share = get_package_share_directory("modcal_nodes")
    # without a stated type, an empty or numeric text would not arrive as text, nor "true" as a boolean
    chosen = {
        "calibration": ParameterValue(LaunchConfiguration("calibration"), value_type=str),
        "target": ParameterValue(LaunchConfiguration("target"), value_type=str),
        "stream": ParameterValue(LaunchConfiguration("stream"), value_type=bool),
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument("calibration", default_value=""),
            DeclareLaunchArgument("target", default_value="tip"),
            DeclareLaunchArgument("stream", default_value="false"),
            # on purpose not the controller's own topic: an arm moves only where somebody has said so
            DeclareLaunchArgument("command", default_value="corrector/joint_trajectory"),
            Node(
                package="modcal_nodes",
                executable="corrector",
                parameters=[f"{share}/config/corrector.yaml", chosen],
                remappings=[
                    ("calibration", "calibrator/calibration"),
                    ("~/joint_trajectory", LaunchConfiguration("command")),
                ],
            ),
        ]
    )
