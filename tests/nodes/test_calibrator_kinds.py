"""Live as from a bag: ranges, bearings and heights calibrate an arm, and a Delta is calibrated and corrected.

Some seconds each: real nodes over DDS, and a whole solve of four instruments or of a Delta.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.recordings import START, URDF
from deltas import FILE, record_delta
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped, Vector3Stamped
from instruments.worlds import gauge, postures, theodolite, wire, world
from modcal_interfaces.msg import Calibration
from nodes.beside_a_cell import HEARING, MODEL, latched
from nodes.cell import call
from nodes.processes import Process, beside, fresh_domain, listener, running
from nodes.talking import LATCHED, Diagnostics
from rclpy.node import Node
from sensor_msgs.msg import JointState, Range
from std_msgs.msg import String

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_msgs_py.readings import set_seconds
from modcal_nodes.io.inputs import calibration_of

pytestmark = pytest.mark.dds
Send = tuple[Any, Callable[[int], Any]]  # publisher, and its message at a station


def play(said: Diagnostics, wait: Any, joints: Any, names: tuple[str, ...], q: Array, readings: list[Send]) -> None:
    """Finished stations: a joint state and readings of the same stamp, two seconds apart."""
    everyone = {joints, *(publisher for publisher, _ in readings)}  # each is discovered by itself
    wait(lambda: all(p.get_subscription_count() > 0 and said.found(p.topic_name) for p in everyone), 60.0)
    for i in range(len(q)):
        for publisher, made in ((joints, JointState(name=list(names), position=q[i].tolist())), *(
            (publisher, read(i)) for publisher, read in readings
        )):  # fmt: skip
            set_seconds(made.header.stamp, START + 2.0 * i)
            publisher.publish(made)
        time.sleep(0.004)
    counts = {p.topic_name: sum(q.topic_name == p.topic_name for q, _ in readings) * len(q) for p, _ in readings}
    wait(lambda: all(said.counted(topic) >= count for topic, count in counts.items()), 60.0)


def length(node: Node, topic: str, frame: str, values: Array) -> Send:
    def made(i: int) -> Range:
        message = Range(range=float(values[i, 0]))
        message.header.frame_id = frame
        return message

    return node.create_publisher(Range, topic, 500), made


def direction(node: Node, frame: str, values: Array) -> Send:
    def made(i: int) -> Vector3Stamped:
        message = Vector3Stamped()
        message.header.frame_id = frame
        message.vector.x, message.vector.y, message.vector.z = values[i].tolist()
        return message

    return node.create_publisher(Vector3Stamped, "tracker/bearing", 500), made


def test_ranges_bearings_and_heights_calibrate_an_arm(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    truth = world(5)
    q = postures(truth.nominal, 45, rng)
    T = truth.tool_in_tracker(q)
    T = se3.inverse(truth.T_tracker_base) @ T
    with beside(tmp_path, "calibrator", effects=False) as (calibrator, node, wait):
        said = Diagnostics(node)
        joints = node.create_publisher(JointState, "joint_states", 500)
        node.create_publisher(String, "robot_description", LATCHED).publish(String(data=URDF.read_text()))
        noise = 2e-5 * rng.standard_normal((5, len(q), 3))
        wires = [np.array([wire(a)(x) for x in T]) for a in ([2.0, 1.0, 0.5], [-1.5, 2.0, 1.0])]
        readings = [
            length(node, "tracker/range", f"wire_{k}", w + noise[k, :, :1]) for k, w in enumerate(wires)
        ]  # fmt: skip
        station = theodolite(se3.exp([1.0, -3.0, 0.5, 0.1, 0.2, 1.0]))
        seen = np.array([station(x) for x in T]) + noise[2]
        readings.append(direction(node, "station", seen / np.linalg.norm(seen, axis=1, keepdims=True)))
        height = np.array([gauge([0.1, 0.2, 1.0], -1.0)(x) for x in T]) + noise[3, :, :1]
        readings.append(length(node, "tracker/plane", "table", height))
        models = latched(node, "calibrator/calibration", Calibration)
        play(said, wait, joints, truth.nominal.names, q, readings)
        assert call(node, wait, "calibrator/solve").success
        wait(lambda: models, 20.0)
        assert said.text(HEARING)
        assert calibrator.stop() == 0
    found = calibration_of(models[-1], "live")
    assert set(found.calibrated.frames) == {"wire_0", "wire_1", "station", "table"}
    assert {i.kind for i in found.calibrated.instruments} == {"range", "bearing", "touch"}


def test_a_delta_is_calibrated_and_corrected_live(tmp_path: Path) -> None:
    cell = record_delta(4, 80, "point", noise_m=1e-5)
    domain = fresh_domain()
    nodes = [Process(name, domain, tmp_path, delta=FILE) for name in ("calibrator", "corrector")]
    with running(*nodes), listener(domain) as (node, wait):
        said = Diagnostics(node)
        joints = node.create_publisher(JointState, "joint_states", 500)
        tracker = node.create_publisher(PointStamped, "tracker/point", 500)

        def point(i: int) -> PointStamped:
            message = PointStamped()
            message.header.frame_id = "tracker"
            message.point.x, message.point.y, message.point.z = cell.samples.reading[i].tolist()
            return message

        models = latched(node, "calibrator/calibration", Calibration)
        handed = node.create_publisher(Calibration, "calibration", LATCHED)
        poses: list[PoseWithCovarianceStamped] = []
        node.create_subscription(PoseWithCovarianceStamped, "corrector/pose", poses.append, 10)
        play(said, wait, joints, cell.nominal.names, cell.samples.q[:60], [(tracker, point)])
        assert call(node, wait, "calibrator/solve").success
        wait(lambda: said.value(MODEL, "state") == "trusted", 20.0)
        wait(lambda: models, 20.0)
        handed.publish(models[-1])
        q = cell.samples.q[70]

        def stand() -> bool:
            now = JointState(name=list(cell.nominal.names), position=q.tolist(), velocity=[0.0] * 4)
            set_seconds(now.header.stamp, 1e-9 * node.get_clock().now().nanoseconds)
            joints.publish(now)
            return bool(poses)

        wait(stand, 30.0)
        assert [process.stop() for process in nodes] == [0, 0]
    found = calibration_of(models[-1], "live")
    p = poses[-1].pose.pose.position
    in_tracker = se3.apply(found.calibrated.T_frame_base[0], np.array([p.x, p.y, p.z]))
    tool = found.calibrated.T_tip_tool[:3, 3]
    # the tip, level and turned by the shaft, and the tool on it
    turn = se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, cell.nominal.shaft_ratio * q[3]])[:3, :3]
    reached = in_tracker + found.calibrated.T_frame_base[0, :3, :3] @ turn @ tool
    assert np.linalg.norm(reached - cell.samples.reading[70]) < 1e-4
