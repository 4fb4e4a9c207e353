"""``recorder``: what is published goes into a bag, as it comes, byte for byte."""

from __future__ import annotations

import time
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from modcal_core.errors import ModcalError
from modcal_msgs_py.bag_metadata import qos_profile
from modcal_msgs_py.mcap_write import BagWriter
from modcal_msgs_py.types import jazzy
from modcal_nodes.parameters import RECORDER, declare, values
from modcal_nodes.running import run

_LOOK_SECONDS = 0.25


class Recorder(Node):
    """Subscribes to topics as they appear, with the QoS that their publishers offer."""

    def __init__(self) -> None:
        super().__init__("recorder")
        declare(self, RECORDER)
        chosen = values(self, RECORDER)
        folder = Path(chosen["out"] or time.strftime("modcal_%Y_%m_%d-%H_%M_%S"))
        self._wanted = {self.resolve_topic_name(name) for name in chosen["topics"] if name}
        self._bag = BagWriter(folder)
        self._heard: set[str] = set()
        self._refused: set[str] = set()
        self.create_timer(_LOOK_SECONDS, self._look)
        self.create_timer(_LOOK_SECONDS, self._bag.flush_if_due)
        self.get_logger().info(f"recording into {folder}")
        self._look()

    def _look(self) -> None:
        """Subscribe to what is wanted and now published."""
        for topic, types in self.get_topic_names_and_types():
            if topic in self._wanted - self._heard - self._refused:
                self._subscribe(topic, types)

    def _subscribe(self, topic: str, types: list[str]) -> None:
        publishers = self.get_publishers_info_by_topic(topic)
        if not publishers:
            return
        if len(types) != 1 or types[0] not in jazzy().types:
            self.get_logger().error(f"{topic}: type {', '.join(types)} cannot be recorded")
            self._refused.add(topic)
            return
        self._heard.add(topic)
        reliable = all(p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
        latched = all(p.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
        qos = QoSProfile(
            depth=1000,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        self._bag.add_topic(topic, types[0], [qos_profile(latched, reliable)])
        self.create_subscription(_message_type(types[0]), topic, partial(self._write, topic), qos, raw=True)
        self.get_logger().info(f"recording {topic} ({types[0]})")

    def _write(self, topic: str, cdr: bytes) -> None:
        try:
            self._bag.write_raw(topic, cdr, self.get_clock().now().nanoseconds)
        except ModcalError as error:
            self.get_logger().fatal(str(error))
            raise

    def close(self) -> None:
        """Write the bag's index and metadata."""
        self._bag.close()
        self.get_logger().info(f"closed {self._bag.folder} with {self._bag.count} messages")


def _message_type(name: str) -> Any:
    package, _, message = name.partition("/msg/")
    return getattr(import_module(f"{package}.msg"), message)


def main() -> None:
    """Entry point of the executable."""
    run(Recorder)
