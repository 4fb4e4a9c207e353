"""The pictures that a viewer publishes, as a test sees them."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from nodes.talking import LATCHED
from rclpy.node import Node
from visualization_msgs.msg import Marker, MarkerArray

from modcal_core.geometry.so3 import Array

TOPICS = {"residuals": LATCHED, "stations": LATCHED, "axes": 10, "uncertainty": 10}


def numbers(marker: Marker) -> Iterator[float]:
    """Every number that a viewer would draw with."""
    p, q, s, c = marker.pose.position, marker.pose.orientation, marker.scale, marker.color
    yield from (p.x, p.y, p.z, q.x, q.y, q.z, q.w, s.x, s.y, s.z, c.r, c.g, c.b, c.a)
    for point in marker.points:
        yield from (point.x, point.y, point.z)


class Pictures:
    """The newest picture of each topic. Each must be whole: it begins by taking away what was there."""

    def __init__(self, node: Node) -> None:
        self.last: dict[str, list[Marker]] = {}
        self.count = dict.fromkeys(TOPICS, 0)
        self.faults: list[str] = []
        for topic, qos in TOPICS.items():
            node.create_subscription(MarkerArray, f"viewer/{topic}", lambda m, t=topic: self._take(t, m), qos)

    def _take(self, topic: str, message: MarkerArray) -> None:
        first, *rest = message.markers
        if first.action != Marker.DELETEALL or any(m.action != Marker.ADD for m in rest):
            self.faults.append(f"{topic}: not a whole picture")
        if len({m.id for m in rest}) != len(rest):
            self.faults.append(f"{topic}: two markers of one number")
        if not all(map(math.isfinite, (x for m in rest for x in numbers(m)))):
            self.faults.append(f"{topic}: not finite")
        if any(min(m.scale.x, m.scale.y, m.scale.z) < 0.0 for m in rest):
            self.faults.append(f"{topic}: no extent")
        self.last[topic], self.count[topic] = rest, self.count[topic] + 1

    def of(self, topic: str, space: str) -> list[Marker]:
        return [m for m in self.last.get(topic, ()) if m.ns == space]

    def arrows(self, topic: str, space: str) -> tuple[Array, Array]:
        """Starts and vectors, (N, 3) each."""
        ends = [[(p.x, p.y, p.z) for p in m.points] for m in self.of(topic, space)]
        points = np.array(ends, dtype=float).reshape(-1, 2, 3)
        return points[:, 0], points[:, 1] - points[:, 0]

    def dots(self, space: str) -> int:
        return sum(len(m.points) for m in self.of("stations", space))

    def text(self) -> str:
        return "\n".join(m.text for m in self.of("residuals", "scale"))
