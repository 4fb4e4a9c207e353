"""Frames to /tf and /tf_static, where tf2_msgs is installed, which it is not from wheels: not run live by the tests."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.qos import QoSProfile

from modcal_core.errors import BadTable
from modcal_nodes.ros.guarded import GuardedNode
from modcal_nodes.ros.running import LATCHED
from modcal_nodes.ros.tf_frames import Frame, Parents


class Broadcaster:
    """Publishes frames, unless they belong to somebody else already. trouble: why they are not published."""

    def __init__(self, node: GuardedNode, static: bool) -> None:
        """static: whether to /tf_static."""
        self.trouble = ""
        self._node, self._parents = node, Parents()
        try:
            message = import_module("tf2_msgs.msg").TFMessage
        except ImportError:
            self._message = None
            self.trouble = "publish_tf: tf2_msgs is not installed, no frame is published: install it with ROS"
            node.get_logger().error(self.trouble)
            return
        self._message = message
        self._publisher = node.create_publisher(message, "/tf_static" if static else "/tf", LATCHED if static else 100)
        node.heard_by_executor = True  # a part of what /tf says shows who speaks there
        node.create_subscription(message, "/tf", self._hear, 100)
        node.create_subscription(
            message, "/tf_static", self._hear, QoSProfile(depth=100, durability=LATCHED.durability)
        )

    def _hear(self, message: Any) -> None:
        self._parents.receive((t.header.frame_id, t.child_frame_id) for t in message.transforms)

    def publish(self, frames: Iterable[Frame], stamp: Any) -> None:
        """Publish these frames at a time (builtin_interfaces/Time)."""
        if self._message is None:
            return
        try:
            out = []
            for frame in frames:
                self._parents.require_free(frame)
                out.append(filled(TransformStamped(), frame, stamp))
            self._publisher.publish(self._message(transforms=out))
            self.trouble = ""
        except BadTable as error:
            self.trouble = str(error)
            self._node.get_logger().error(self.trouble, throttle_duration_sec=5.0)


def filled(message: TransformStamped, frame: Frame, stamp: Any) -> TransformStamped:
    """The message, saying this frame at this time."""
    message.header.frame_id, message.child_frame_id, message.header.stamp = frame.parent, frame.child, stamp
    p, o = message.transform.translation, message.transform.rotation
    p.x, p.y, p.z, o.x, o.y, o.z, o.w = frame.numbers()
    return message
