"""A cell that a test plays: messages of a recording made by MuJoCo, published by the test's own node."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from nodes.processes import SLOWER, Wait, meet
from nodes.talking import LATCHED, Diagnostics
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from modcal_core.measurements.recording import Recording

BUSY = "a solve is running already", "busy with check: ask again"
_ASK_AGAIN = 20.0  # s


class PlayedCell:
    """Publishers of one cell, in a namespace of its own if need be."""

    def __init__(
        self, node: Node, namespace: str = "", description: QoSProfile = LATCHED, tracker: QoSProfile | int = 100
    ) -> None:
        prefix = f"{namespace}/" if namespace else ""
        self._said = Diagnostics(node)
        self._sent = [0, 0]
        self._description = node.create_publisher(String, f"{prefix}robot_description", description)
        self.joints = node.create_publisher(JointState, f"{prefix}joint_states", 100)
        self.tracker = node.create_publisher(PoseStamped, f"{prefix}tracker/pose", tracker)

    def heard(self) -> bool:
        """Whether someone listens to joints and tracker, and has found who speaks."""
        topics = (self.joints.topic_name, self.tracker.topic_name)
        listening = all(p.get_subscription_count() > 0 for p in (self.joints, self.tracker))
        return listening and all(self._said.found(topic) for topic in topics)

    def taken(self) -> bool:
        """Whether all that was played has been taken in."""
        topics = (self.joints.topic_name, self.tracker.topic_name)
        return all(self._said.counted(topic) >= sent for topic, sent in zip(topics, self._sent, strict=True))

    def describe(self, urdf: str) -> None:
        """Publish the robot description."""
        self._description.publish(String(data=urdf))

    def play(self, recording: Recording, spoil: Callable[[int, Any], Any] = lambda _, message: message) -> None:
        """Publish all messages in the order of their stamps; ``spoil`` may change one, or return None for none."""
        track, reading = recording.joints[0], recording.readings[0]
        events = [(float(t), 0, i) for i, t in enumerate(track.stamps)]
        events += [(float(t), 1, i) for i, t in enumerate(reading.stamps)]
        for k, (_, which, i) in enumerate(sorted(events)):
            made = joint_state(recording, i) if which == 0 else pose_stamped(recording, i)
            message = spoil(i, made)
            if message is not None:
                (self.joints if which == 0 else self.tracker).publish(message)
                self._sent[which] += 1
            if k % 4 == 3:
                time.sleep(0.004)  # best effort has no second chance


def joint_state(recording: Recording, i: int) -> JointState:
    """One joint state of a recording as a message."""
    track = recording.joints[0]
    message = JointState(name=list(track.names), position=[float(x) for x in track.position[i]])
    _stamp(message, float(track.stamps[i]))
    return message


def pose_stamped(recording: Recording, i: int) -> PoseStamped:
    """One pose of a recording as a message."""
    reading = recording.readings[0]
    message = PoseStamped()
    _stamp(message, float(reading.stamps[i]))
    message.header.frame_id = reading.frame
    x, y, z, qx, qy, qz, qw = (float(v) for v in reading.values[i])
    at, turn = message.pose.position, message.pose.orientation
    at.x, at.y, at.z = x, y, z
    turn.x, turn.y, turn.z, turn.w = qx, qy, qz, qw
    return message


def _stamp(message: Any, stamp: float) -> None:
    ns = round(stamp * 1e6) * 1000
    message.header.stamp.sec, message.header.stamp.nanosec = ns // 10**9, ns % 10**9


def call(node: Node, wait: Wait, name: str, seconds: float = 120.0) -> Trigger.Response:
    """The answer of a Trigger service.

    On a busy machine the answer may be lost all the same, and it is asked again.
    """
    client = node.create_client(Trigger, name)
    meet(wait, client)
    answers = []
    asked = -_ASK_AGAIN
    end = time.monotonic() + SLOWER * seconds
    while time.monotonic() < end:
        if time.monotonic() > asked + _ASK_AGAIN:
            answers.append(client.call_async(Trigger.Request()))
            asked = time.monotonic()
        due = time.monotonic() + 0.2
        wait(lambda: time.monotonic() > due or any(a.done() for a in answers), 5.0)  # noqa: B023
        for answer in [a for a in answers if a.done()]:
            if answer.result().message not in BUSY or len(answers) == 1:
                node.destroy_client(client)
                return answer.result()
            answers.remove(answer)
    raise AssertionError(f"{name} did not answer in {SLOWER * seconds:g} s")
