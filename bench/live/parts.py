"""The processes beside modcal's nodes: what sends, and a node that discards what it hears, which is what rclpy costs.

python parts.py source URDF FILE  # 1 kHz JointState, 200 Hz PoseStamped; FILE: made once it speaks
python parts.py spin FILE         # rclpy's executor, a callback a message; FILE: what was taken, and how late
python parts.py rest FILE         # the same with all that waits taken at once, and a rest, as nodes of modcal do
"""

from __future__ import annotations

import json
import struct
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String

DEPTH = 1000
REST = 0.003  # s
JOINT_RATE, EVERY = 1000, 5  # Hz; joint states to a pose
DWELL, TRAVEL = 0.8, 0.5  # s
TURN = 6  # postures until the first comes again
_STAMP, _HEADER = struct.Struct("<iI"), 4  # behind so many bytes of CDR


def bare(way: str, out: Path) -> None:
    """Take and discard until told to stop; then write how old poses were when they were taken."""
    node, taken, late = rclpy.create_node("bare"), [0, 0], deque[float](maxlen=20_000)

    def joints(_: Any) -> None:
        taken[0] += 1

    def pose(message: Any) -> None:
        taken[1] += 1
        stamp = message.header.stamp
        late.append(time.time() - stamp.sec - 1e-9 * stamp.nanosec)

    heard = [
        (node.create_subscription(kind, topic, take, QoSProfile(depth=DEPTH)), take)
        for kind, topic, take in ((JointState, "joint_states", joints), (PoseStamped, "tracker/pose", pose))
    ]
    try:
        if way == "spin":
            rclpy.spin(node)
        while True:
            rclpy.spin_once(node)
            for subscription, take in heard:
                with subscription.handle:
                    while (waits := subscription.handle.take_message(subscription.msg_type, False)) is not None:
                        take(waits[0])
            time.sleep(REST)
    finally:  # a context that ends in the middle of a wait is an error of its own kind
        figures = {"taken": taken, "late_ms": (1e3 * np.percentile(late or [np.nan], [50.0, 99.0])).tolist()}
        out.write_text(json.dumps(figures))


def motion(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (k, n) of one turn at the rate of joint states."""
    at = rng.uniform(-1.2, 1.2, (TURN, n)) + np.array([0.0, -1.2, 1.4, -0.8, 1.1, 0.2])[:n]
    moving, still = np.arange(round(TRAVEL * JOINT_RATE)) / round(TRAVEL * JOINT_RATE), round(DWELL * JOINT_RATE)
    blend = (10 * moving**3 - 15 * moving**4 + 6 * moving**5)[:, None]
    legs = []
    for a, b in zip(at, np.roll(at, -1, axis=0), strict=True):
        legs += [np.repeat(a[None], still, axis=0), a + blend * (b - a)]
    q = np.concatenate(legs) + 1e-6 * rng.standard_normal((TURN * (still + len(moving)), n))
    return q, np.gradient(q, axis=0) * JOINT_RATE


def source(file: Path, begun: Path) -> None:
    """Publish for ever. Messages are made before and only stamped when they are sent, so that it takes little."""
    from modcal_core.geometry import se3
    from modcal_core.robots.kinematics import forward
    from modcal_core.robots.urdf import read_chain

    urdf, rng, node = file.read_text(), np.random.default_rng(1), rclpy.create_node("source")
    chain = read_chain(urdf)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_publisher(String, "robot_description", latched).publish(String(data=urdf))
    joints = node.create_publisher(JointState, "joint_states", DEPTH)
    tracker = node.create_publisher(PoseStamped, "tracker/pose", DEPTH)
    q, v = motion(rng, chain.n)
    T = forward(chain, q[::EVERY]) @ se3.from_pose(np.array([0.03, 0.02, 0.1, 0.0, 0.0, 0.0, 1.0]))
    T[:, :3, 3] += 2e-5 * rng.standard_normal((len(T), 3))
    states, poses = [], []
    for a, b in zip(q, v, strict=True):
        state = JointState(name=list(chain.names), position=a.tolist(), velocity=b.tolist(), effort=(10.0 * a).tolist())
        states.append(bytearray(serialize_message(state)))
    for x, y, z, qx, qy, qz, qw in se3.to_pose(T).tolist():
        message = PoseStamped()
        message.header.frame_id = "tracker"
        p, o = message.pose.position, message.pose.orientation
        p.x, p.y, p.z, o.x, o.y, o.z, o.w = x, y, z, qx, qy, qz, qw
        poses.append(bytearray(serialize_message(message)))
    begun.touch()
    began, sent = time.monotonic(), 0
    while rclpy.ok():
        due = int((time.monotonic() - began) * JOINT_RATE)
        for k in range(sent, due):
            stamp = divmod(time.time_ns(), 1_000_000_000)
            said = [(joints, states[k % len(states)]), (tracker, poses[k // EVERY % len(poses)])]
            for publisher, cdr in said if k % EVERY == 0 else said[:1]:
                _STAMP.pack_into(cdr, _HEADER, *stamp)
                publisher.publish(bytes(cdr))
        sent = max(sent, due)
        time.sleep(max(0.0, began + (sent + 1) / JOINT_RATE - time.monotonic()))


if __name__ == "__main__":
    rclpy.init()
    try:
        if sys.argv[1] == "source":
            source(Path(sys.argv[2]), Path(sys.argv[3]))
        else:
            bare(sys.argv[1], Path(sys.argv[2]))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
