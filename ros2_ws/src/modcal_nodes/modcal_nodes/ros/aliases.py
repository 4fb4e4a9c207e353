"""Names that parameters had in release 0.1: still read from files and command lines, with a line that says the new one.

They go with release 0.3. A value under a new name comes before one under the old.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

# new name: old name
_ALL = {"timeout_s": "stale_s"}
_IMPEDANCE = {
    "exploration_speed_m_s": "exploring_m_s",
    "max_exploration_m": "explore_m",
    "slowdown_force_n": "slow_force_n",
    "slowdown_moment_nm": "slow_moment_nm",
    "stop_force_n": "stand_force_n",
    "stop_moment_nm": "stand_moment_nm",
    "max_force_n": "most_force_n",
    "max_moment_nm": "most_moment_nm",
    "max_speed_m_s": "most_speed_m_s",
    "max_acceleration_m_s2": "most_acceleration_m_s2",
    "max_angular_speed_rad_s": "most_turning_rad_s",
    "max_angular_acceleration_rad_s2": "most_turning_rad_s2",
    "max_displacement_m": "most_displacement_m",
    "max_rotation_rad": "most_turn_rad",
    "min_gain": "least_gain",
    "contact_stiffness_n_m": "hand_n_m",
}
_CALIBRATOR = {
    "process_noise_places": "wandering",
    "process_noise_m": "wander_m",
    "process_noise_rad": "wander_rad",
    "buffer_s": "memory_s",
    "max_stations": "most_stations",
    "silence_timeout_s": "silent_s",
}
_OTHERS = {"min_free_mb": "least_free_mb", "goal_timeout_s": "goal_stale_s", "lookahead_m": "ahead_m"}
OLD_NAMES: Mapping[str, str] = {**_ALL, **_IMPEDANCE, **_CALIBRATOR, **_OTHERS}


def said_under_old_name(node: Node, name: str) -> Any:
    """The value that somebody gives the parameter under its old name, and a warning; None where nobody does."""
    old = OLD_NAMES.get(name)
    if old is None:
        return None
    # declared for a moment only: that is how rclpy tells what files and command line say of a name
    value = node.declare_parameter(old, None, ParameterDescriptor(dynamic_typing=True)).value
    node.undeclare_parameter(old)
    if value is not None:
        node.get_logger().warning(f"parameter {old} is called {name} now; the old name will be removed in release 0.3")
    return value
