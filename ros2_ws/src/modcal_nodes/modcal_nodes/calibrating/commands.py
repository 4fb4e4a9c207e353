"""Commanded joints, whichever of two types of messages they come as: heard once somebody publishes them."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from modcal_msgs_py.topics import JOINT_COMMANDS
from modcal_nodes.ros.guarded import GuardedNode
from modcal_nodes.ros.running import SENSOR
from modcal_nodes.ros.subscriptions import MonitoredSubscription

_KINDS = {"sensor_msgs/msg/JointState": JointState, "trajectory_msgs/msg/JointTrajectory": JointTrajectory}
_LOOK = 1.0  # s between looks at who publishes


class CommandSubscription:
    """Subscribes to ``joint_commands`` with the type that its publisher has."""

    def __init__(self, node: GuardedNode, hear: Callable[[str, Any], None]) -> None:
        """hear: called with the type's name and the message."""
        self._node, self._hear = node, hear
        self._topic = node.resolve_topic_name(JOINT_COMMANDS)
        self._next = 0.0
        self._found = False

    def look(self) -> MonitoredSubscription | None:
        """The subscription, once, when somebody has begun to publish."""
        if self._found or time.monotonic() < self._next:
            return None
        self._next = time.monotonic() + _LOOK
        for info in self._node.get_publishers_info_by_topic(self._topic):
            if info.topic_type in _KINDS:
                self._found = True
                hear = partial(self._hear, info.topic_type)
                return MonitoredSubscription(self._node, _KINDS[info.topic_type], JOINT_COMMANDS, hear, SENSOR)
        return None
