"""Which parameters of ``impedance_setpoint`` may change, and when: some at once, some between pulls, some never."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from modcal_core.errors import BadCommand

_AT_CONFIGURE = (
    "base", "tip", "calibrated", "tool_mass", "tool_centre", "wrench_frame", "wrench_by_tool", "cutoff_hz", "timeout_s",
    "rate_hz",
)  # fmt: skip
WHILE_PULLING = {
    "speed_m_s", "exploration_speed_m_s", "slowdown_force_n", "slowdown_moment_nm", "stop_force_n", "stop_moment_nm",
    "max_force_n", "max_moment_nm", "max_speed_m_s", "max_acceleration_m_s2", "max_angular_speed_rad_s",
    "max_angular_acceleration_rad_s2", "max_displacement_m", "max_rotation_rad", "joint_speed_rad_s", "joint_speed_m_s",
    "joint_acceleration_rad_s2", "joint_acceleration_m_s2", "min_gain", "contact_stiffness_n_m",
    "arm_stiffness_n_m",
}  # fmt: skip


def require_changeable(new: Mapping[str, Any], now: Mapping[str, Any], configured: bool, pulls: bool) -> None:
    """Raises BadCommand for a parameter among the new ones that would have no effect if it changed now.

    now: the present ones. configured, pulls: the state of the node.
    """
    changed = [name for name, value in new.items() if value != now[name]]
    fixed = [name for name in changed if name not in WHILE_PULLING]
    if fixed and pulls:
        raise BadCommand(f"parameter {fixed[0]}", "cannot change while it pulls", "call ~/stop first")
    for name in changed:
        if name in _AT_CONFIGURE and configured:
            raise BadCommand(f"parameter {name}", "is read when the node is configured", "clean it up first")
