"""What the calibrator subscribes to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from sensor_msgs.msg import JointState, PointCloud2, Temperature
from std_msgs.msg import String

from modcal_core.measurements.kinds.registry import kinds
from modcal_nodes.calibrating.intake import READING_MESSAGES, Intake
from modcal_nodes.ros.guarded import GuardedNode
from modcal_nodes.ros.running import LATCHED, SENSOR
from modcal_nodes.ros.subscriptions import MonitoredSubscription


def listen(
    node: GuardedNode,
    intake: Intake,
    describe: Callable[[String], None],
    patience: float,
    described: bool,
    corners: Sequence[str],
) -> list[MonitoredSubscription]:
    """The subscriptions. patience: seconds of silence that are accepted. described: whether the arm is known without
    robot_description. corners: topics with those of a target, none where none are taken.
    """
    hear = partial(MonitoredSubscription, node, patience=patience, single=True)
    inputs = [hear(JointState, "joint_states", intake.joint_state, SENSOR, needed=True)]
    for kind in kinds().values():
        take = partial(intake.reading, kind.topic, kind.name)
        inputs.append(hear(READING_MESSAGES[kind.message], kind.topic, take, SENSOR, single=False))
    inputs.append(hear(Temperature, "temperature", partial(intake.remember, "temperature"), SENSOR, single=False))
    for camera, topic in enumerate(corners):
        inputs.append(hear(PointCloud2, topic, partial(intake.corners, camera), SENSOR))
    return [*inputs, hear(String, "robot_description", describe, LATCHED, needed=not described)]
