"""What a topic is for, by the name the contract gives it."""

from __future__ import annotations

from functools import lru_cache

from modcal_core.errors import BadTable
from modcal_core.measurements.kinds.registry import kinds
from modcal_msgs_py import commanded
from modcal_msgs_py.added_topics import GROUP, added_topics
from modcal_msgs_py.commanded import JOINT_STATE, TRAJECTORY

JOINT_STATES = "joint_states"
JOINT_COMMANDS = "joint_commands"
CONTROLLER_STATE = "controller_state"
COMMANDS = (JOINT_COMMANDS, CONTROLLER_STATE)  # the first is preferred
ROBOT_DESCRIPTION = "robot_description"
TEMPERATURE = "temperature"
WRENCH = "wrench"
NOTES = "modcal/notes"

READINGS = {kind.topic: kind.name for kind in kinds().values()}
TYPES = {
    JOINT_STATES: JOINT_STATE,
    ROBOT_DESCRIPTION: "std_msgs/msg/String",
    JOINT_COMMANDS: JOINT_STATE,
    CONTROLLER_STATE: commanded.CONTROLLER_STATE,
    TEMPERATURE: "sensor_msgs/msg/Temperature",
    WRENCH: "geometry_msgs/msg/WrenchStamped",
    NOTES: "std_msgs/msg/String",
    **{kind.topic: kind.message for kind in kinds().values()},
}
ADDED = added_topics()
POSES = (  # types of messages that hold a pose
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TF, TF_STATIC = "/tf", "/tf_static"
LATCHED = (ROBOT_DESCRIPTION, NOTES)

for _topic, _added in ADDED.items():
    if _topic in TYPES:
        raise BadTable(f"topic {_topic} of {GROUP}", "is used by modcal itself", "choose another name")
    TYPES[_topic] = _added.message


def accepted(role: str) -> tuple[str, ...]:
    """The types of messages that a role may have; where positions are asked for, a pose will do.

    Commands are joint states of their own, or trajectories.
    """
    own = TYPES[role]
    if role == JOINT_COMMANDS:
        return (own, TRAJECTORY)
    if own == POSES[0]:
        return POSES
    return (own, *POSES) if own == "geometry_msgs/msg/PointStamped" else (own,)


_ACCEPTED = {role: accepted(role) for role in TYPES}


@lru_cache(maxsize=256)  # of a few topics, whose every message is asked for
def role_of(topic: str, type_name: str) -> str | None:
    """The contract's name for a topic, in whatever namespace it stands; None for a topic of no known role.

    The state of a controller of trajectories is told by its type, whatever its name.
    """
    for role, types in _ACCEPTED.items():
        if (topic == f"/{role}" or topic.endswith(f"/{role}")) and type_name in types:
            return role
    return CONTROLLER_STATE if type_name == commanded.CONTROLLER_STATE else None


def preferred(topics: set[str], role: str) -> set[str]:
    """The topic at the contract's own name, where it is among these; else all of them."""
    return {f"/{role}"} if f"/{role}" in topics else topics
