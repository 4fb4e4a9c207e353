"""Messages of the simulated cell: each is made once and filled again, for making one costs more than filling it."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

from geometry_msgs.msg import PointStamped, PoseStamped, WrenchStamped
from sensor_msgs.msg import JointState, Temperature

from modcal_core.geometry import Array, se3


def stamp(
    message: JointState | PoseStamped | PointStamped | Temperature | WrenchStamped, when: tuple[int, int]
) -> None:
    """Put a time in seconds and nanoseconds on a message."""
    message.header.stamp.sec, message.header.stamp.nanosec = when


class States:
    """Joint states of one arm."""

    def __init__(self, names: Sequence[str]) -> None:
        self._message = JointState(name=list(names))

    def fill(self, when: tuple[int, int], position: Array, velocity: Array, effort: Array | None) -> JointState:
        """The message, to be published before it is filled again."""
        stamp(self._message, when)
        # array.array is what the field holds: handed over as it is, nothing is looked at one by one
        self._message.position = array("d", position.tobytes())
        self._message.velocity = array("d", velocity.tobytes())
        if effort is not None:
            self._message.effort = array("d", effort.tobytes())
        return self._message


class Poses:
    """Poses in one frame; points where only those are seen."""

    def __init__(self, frame: str, points: bool = False) -> None:
        self._message: PoseStamped | PointStamped = PointStamped() if points else PoseStamped()
        self._message.header.frame_id = frame

    def fill(self, when: tuple[int, int], T: Array) -> PoseStamped | PointStamped:
        """The message for T (4, 4), to be published before it is filled again."""
        stamp(self._message, when)
        numbers = se3.to_pose(T).tolist()
        if isinstance(self._message, PoseStamped):
            at, turn = self._message.pose.position, self._message.pose.orientation
            turn.x, turn.y, turn.z, turn.w = numbers[3:]
        else:
            at = self._message.point
        at.x, at.y, at.z = numbers[:3]
        return self._message
