"""Learning how something opens, and opening it: ``ros2 launch modcal_nodes articulate.launch.py mode:=admittance``.

The setpoint node activates itself; it pulls when its service ~/pull is called, and sends nothing before.
"""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Both nodes with their config files; setpoints go to the topics that are named."""
    share = get_package_share_directory("modcal_nodes")
    # without a stated type, a numeric or bracketed text would not arrive as what it is
    chosen = {
        "mode": ParameterValue(LaunchConfiguration("mode"), value_type=str),
        "calibrated": ParameterValue(LaunchConfiguration("calibrated"), value_type=bool),
        "direction": ParameterValue(LaunchConfiguration("direction"), value_type=list[float]),
        "autostart": True,
    }
    told = {f"object_{what}": f"articulation_estimator/object_{what}" for what in ("description", "status")}
    return LaunchDescription(
        [
            DeclareLaunchArgument("mode", default_value="admittance"),
            DeclareLaunchArgument("calibrated", default_value="false"),
            DeclareLaunchArgument("direction", default_value="[0.0, 0.0, -1.0]"),
            # on purpose not a controller's own topics: an arm moves only where somebody has said so
            DeclareLaunchArgument("pose", default_value="impedance_setpoint/target_pose"),
            DeclareLaunchArgument("references", default_value="impedance_setpoint/joint_references"),
            DeclareLaunchArgument("trajectory", default_value="impedance_setpoint/joint_trajectory"),
            Node(
                package="modcal_nodes",
                executable="articulation_estimator",
                parameters=[f"{share}/config/articulation_estimator.yaml"],
            ),
            LifecycleNode(
                package="modcal_nodes",
                executable="impedance_setpoint",
                name="impedance_setpoint",
                namespace="",
                parameters=[f"{share}/config/impedance_setpoint.yaml", chosen],
                remappings=[
                    *told.items(),
                    ("tool_pose", "corrector/pose"),
                    ("~/target_pose", LaunchConfiguration("pose")),
                    ("~/joint_references", LaunchConfiguration("references")),
                    ("~/joint_trajectory", LaunchConfiguration("trajectory")),
                ],
            ),
        ]
    )
