"""The frames that a calibration adds to a robot's tree, beside those that others publish.

    base → TRACKER_calibrated   where each tracker stands, static
    base → TIP_corrected        where the tip truly is, with every posture
    TIP_corrected → tool_corrected   what the tracker sees of it, static

A frame has one parent. One that somebody else publishes already, under another parent, is refused and not taken over.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.qos import QoSProfile

from modcal_core.calibration import Calibration
from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3
from modcal_nodes.ros.guarded import GuardedNode
from modcal_nodes.ros.running import LATCHED

CALIBRATED, CORRECTED = "_calibrated", "_corrected"
TOOL = f"tool{CORRECTED}"


@dataclass(frozen=True)
class Frame:
    """``T_parent_child`` (4, 4) [m]."""

    parent: str
    child: str
    T: Array


def static_frames(calibration: Calibration) -> tuple[Frame, ...]:
    """Where the trackers stand in the base link, and the tool behind the corrected tip."""
    model = calibration.calibrated
    base, tip = model.serial.base, model.serial.tip
    trackers = (
        Frame(base, f"{name or 'tracker'}{CALIBRATED}", se3.inverse(T))
        for name, T in zip(model.frames, model.T_frame_base, strict=True)
    )
    return (*trackers, Frame(f"{tip}{CORRECTED}", TOOL, np.array(model.T_tip_tool)))


def corrected_frame(base: str, tip: str, T_base_tip: Array) -> Frame:
    """Where the tip truly is."""
    return Frame(base, f"{tip}{CORRECTED}", T_base_tip)


class Parents:
    """Who is whose parent, by what others publish."""

    def __init__(self) -> None:
        self._of: dict[str, str] = {}

    def receive(self, pairs: Iterable[tuple[str, str]]) -> None:
        """Take (parent, child) of a message."""
        self._of.update({child.lstrip("/"): parent.lstrip("/") for parent, child in pairs})

    def require_free(self, frame: Frame) -> None:
        """Raises BadTable where the child has another parent, or its parent hangs below it."""
        parent = self._of.get(frame.child)
        if parent is not None and parent != frame.parent:
            said = f"has the parent {parent} already, which another node publishes"
            raise BadTable(f"frame {frame.child}", said, "stop that publisher, or set publish_tf: false")
        above, seen = frame.parent, set[str]()
        while above in self._of and above not in seen:
            seen.add(above)
            above = self._of[above]
            if above == frame.child:
                raise BadTable(f"frame {frame.child}", f"is above {frame.parent} already", "set publish_tf: false")


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
    p.x, p.y, p.z, o.x, o.y, o.z, o.w = se3.to_pose(frame.T).tolist()
    return message
