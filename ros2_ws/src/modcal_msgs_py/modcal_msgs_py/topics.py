"""What a topic is for, by the name the contract gives it."""

from __future__ import annotations

from modcal_core.measurements.recording import BEARING, POINT, POSE, RANGE

JOINT_STATES = "joint_states"
ROBOT_DESCRIPTION = "robot_description"
TEMPERATURE = "temperature"
WRENCH = "wrench"
NOTES = "modcal/notes"

READINGS = {
    "tracker/pose": POSE,
    "tracker/point": POINT,
    "tracker/range": RANGE,
    "tracker/bearing": BEARING,
}
TYPES = {
    JOINT_STATES: "sensor_msgs/msg/JointState",
    ROBOT_DESCRIPTION: "std_msgs/msg/String",
    "tracker/pose": "geometry_msgs/msg/PoseStamped",
    "tracker/point": "geometry_msgs/msg/PointStamped",
    "tracker/range": "sensor_msgs/msg/Range",
    "tracker/bearing": "geometry_msgs/msg/Vector3Stamped",
    TEMPERATURE: "sensor_msgs/msg/Temperature",
    WRENCH: "geometry_msgs/msg/WrenchStamped",
    NOTES: "std_msgs/msg/String",
}
LATCHED = (ROBOT_DESCRIPTION, NOTES)


def role_of(topic: str, type_name: str) -> str | None:
    """The contract's name for a topic, in whatever namespace it stands; None for a topic of no known role."""
    for role, expected in TYPES.items():
        if (topic == f"/{role}" or topic.endswith(f"/{role}")) and type_name == expected:
            return role
    return None
