"""Subscriptions that are looked at now and then: by way of an executor each message costs ten times as much."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from modcal_nodes.ros.guarded import waiting


class Polled:
    """Subscriptions on a node of their own, which nothing spins."""

    def __init__(self, node: Node, period: float | None = 0.02) -> None:
        """node: whose context is shared, and whose timer looks. period: [s]; None where look() is called by hand."""
        self._quiet = rclpy.create_node("test_polled", context=node.context)
        self._all: list[tuple[Subscription, Callable[[Any], None], int]] = []
        if period is not None:
            node.create_timer(period, self.look)

    def subscribe(self, kind: type, topic: str, take: Callable[[Any], None], depth: int = 1000) -> None:
        """Hand each message of a topic to ``take``, at the next look."""
        self._all.append((self._quiet.create_subscription(kind, topic, take, QoSProfile(depth=depth)), take, depth))

    def look(self) -> None:
        """Take what has arrived."""
        for subscription, take, depth in self._all:
            for message, _ in waiting(subscription, depth):
                take(message)
