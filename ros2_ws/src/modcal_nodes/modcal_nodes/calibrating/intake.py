"""Messages of the cell on their way into the buffer, and through the arm's stream to the supervisor."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from geometry_msgs.msg import PointStamped, PoseStamped, Vector3Stamped
from rclpy.node import Node
from sensor_msgs.msg import Range

from modcal_core.errors import ModcalError
from modcal_core.online.supervisor import Supervisor
from modcal_msgs_py.stamps import seconds
from modcal_msgs_py.topics import JOINT_COMMANDS, TYPES
from modcal_nodes.calibrating.arm import KnownArm
from modcal_nodes.calibrating.buffer import Buffer
from modcal_nodes.calibrating.corners import CornerIntake
from modcal_nodes.calibrating.diagnostics import Times

# of the instruments, by their names in ROS
READING_MESSAGES = {
    "geometry_msgs/msg/PoseStamped": PoseStamped, "geometry_msgs/msg/PointStamped": PointStamped,
    "geometry_msgs/msg/Vector3Stamped": Vector3Stamped, "sensor_msgs/msg/Range": Range,
}  # fmt: skip


class Intake:
    """times: how long messages took, and how late they came. refused: how many could not be used."""

    def __init__(
        self,
        node: Node,
        buffer: Buffer,
        arm: KnownArm,
        supervisor: Supervisor,
        recognise: Callable[[], None],
        camera: CornerIntake | None = None,
    ) -> None:
        """recognise: called with each joint state while the arm is not known. camera: takes corners, if any."""
        self._clock, self._log = node.get_clock(), node.get_logger()
        self._buffer, self._arm, self._supervisor, self._recognise = buffer, arm, supervisor, recognise
        self._camera = camera
        self.times = Times()
        self.refused = 0

    def joint_state(self, message: Any) -> None:
        """Take a joint state."""
        began = self.times.begin()
        if self.remember("joint_states", message):
            if self._arm.chain is None:
                self._recognise()
            self._feed(partial(self._arm.joint_state, message))
            if self._camera is not None and (q := self._arm.position(message)) is not None:
                self._camera.joint_state(seconds(message.header.stamp), q)
        self.times.end(began)

    def reading(self, topic: str, kind: str, message: Any) -> None:
        """Take a reading of this kind."""
        began = self.times.begin()
        if self.remember(topic, message):
            self._feed(partial(self._arm.reading, kind, message))
        self.times.end(began)
        self.times.late.append(1e-9 * self._clock.now().nanoseconds - seconds(message.header.stamp))

    def command(self, type_name: str, message: Any) -> None:
        """Take what the joints are told, in a message of this type."""
        if self.remember(JOINT_COMMANDS, message, type_name):
            received = 1e-9 * self._clock.now().nanoseconds
            self._feed(partial(self._arm.command, type_name, message, received))

    def corners(self, camera: int, message: Any) -> None:
        """Take the corners of an image of the first camera (0) or a further one."""
        assert self._camera is not None
        try:
            self._camera.every[camera].corners(message)
        except ModcalError as error:
            self._refuse(error)

    def remember(self, topic: str, message: Any, type_name: str | None = None) -> bool:
        """Put a message into the buffer; returns whether it could be used. type_name: None for the topic's own."""
        received = 1e-9 * self._clock.now().nanoseconds
        try:
            self._buffer.add(f"/{topic}", type_name or TYPES[topic], message, received)
        except ModcalError as error:
            self._refuse(error)
            return False
        return True

    def _feed(self, take: Callable[[], None]) -> None:
        try:
            take()
        except ModcalError as error:
            self._refuse(error)
        for sample in self._arm.stream.take() if self._arm.stream else ():
            self._supervisor.add(sample)

    def _refuse(self, error: ModcalError) -> None:
        self.refused += 1
        self._log.warning(str(error), throttle_duration_sec=5.0)
