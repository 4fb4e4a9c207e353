"""What a calibrator needs before it can work: topics that have not come yet, and a policy that there is."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from modcal_core.errors import BadTable
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.online.supervisor import ASKED, BETTER, Policy
from modcal_nodes.calibrating.arm import KnownArm
from modcal_nodes.ros.subscriptions import MonitoredSubscription

_NO_DESCRIPTION = "robot_description: not received yet: publish it (latched), or set the parameter"
_NO_JOINTS = "joint_states: not received yet: start the robot's driver, or remap the topic"
_NO_TRACKER = "tracker/pose, tracker/point and other readings: none received yet: start the tracker, or remap its topic"
_NO_CORNERS = "corners: not received yet: start board_detector, or remap its topic"


def lacking(arm: KnownArm, inputs: Iterable[MonitoredSubscription], by_camera: bool) -> str:
    """What must come before stations can be cut, or images be kept; empty: nothing."""
    if arm.chain is None:
        if not arm.description and arm.delta is None:
            return _NO_DESCRIPTION
        return arm.trouble or _NO_JOINTS
    topics = ("corners",) if by_camera else tuple(kind.topic for kind in kinds().values())
    if any(subscription.count for subscription in inputs if subscription.topic.endswith(topics)):
        return ""
    return _NO_CORNERS if by_camera else _NO_TRACKER


def require_policy(chosen: dict[str, Any]) -> None:
    """Raises BadTable for a policy that there is none of."""
    if chosen["accept"] not in (ASKED, BETTER):
        raise BadTable(f"accept '{chosen['accept']}'", f"{BETTER} and {ASKED} are known", "set one of them")


def policy(chosen: dict[str, Any]) -> Policy:
    """When results are trusted, and when a solve starts by itself."""
    return Policy(chosen["accept"], chosen["first_solve"], chosen["after_change"])
