"""A node that only listens: to /diagnostics, and to what the nodes named there publish under their own names."""

from __future__ import annotations

import os
import time
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool, Float64, Float64MultiArray, String

from modcal_msgs_py import seconds
from modcal_nodes.ros import FRESH, LATCHED
from modcal_nodes.watching.snapshot import ESTIMATE, NUMBERS, POSE, TEXTS, Heard

_QUEUE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)
_TYPES: dict[str, tuple[type, QoSProfile]] = {
    **{topic: (Float64, LATCHED) for topic in NUMBERS},
    **{topic: (String, LATCHED) for topic in TEXTS},
    "trusted": (Bool, LATCHED),
    ESTIMATE: (Float64MultiArray, _QUEUE),
    POSE: (PoseWithCovarianceStamped, FRESH),
}


class Listener(Node):
    """Fills ``heard`` while it is spun."""

    def __init__(self, heard: Heard, context: Context) -> None:
        super().__init__(
            f"modcal_watch_{os.getpid()}", context=context, enable_rosout=False, start_parameter_services=False
        )
        self.heard = heard
        self._followed: set[str] = set()
        self.create_subscription(DiagnosticArray, "/diagnostics", self._take, _QUEUE)

    def _take(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        for s in message.status:
            facts = {pair.key: pair.value for pair in s.values}
            self.heard.status(s.name, s.hardware_id, int.from_bytes(s.level, "little"), s.message, facts, now)

    def follow(self) -> None:
        """Subscribe to what the nodes that were received publish beside /diagnostics, as soon as they do."""
        for node in self.heard.names:
            for what, (kind, qos) in _TYPES.items():
                topic = f"{node}/{what}"
                if topic not in self._followed and self.count_publishers(topic):
                    self._followed.add(topic)
                    self.create_subscription(kind, topic, partial(self._take_value, node, what), qos)

    def _take_value(self, node: str, what: str, message: Any) -> None:
        if what == POSE:
            variances = np.asarray(message.pose.covariance).reshape(6, 6).diagonal()[:3]
            now = 1e-9 * self.get_clock().now().nanoseconds
            deviation = float(np.sqrt(max(variances.max(), 0.0)))
            self.heard.pose(node, now - seconds(message.header.stamp), deviation)
        else:
            name = NUMBERS.get(what) or TEXTS.get(what) or what
            self.heard.value(node, name, message.data)
