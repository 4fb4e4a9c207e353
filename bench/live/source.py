"""A driver and a tracker: 1 kHz JointState with velocities and efforts, 200 Hz PoseStamped, of an arm that works.

Messages are made before and only stamped when they are sent, so that the source takes little of the processor.
"""

from __future__ import annotations

import struct
import sys
import time
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from modcal_core.geometry import se3
from modcal_core.robots.kinematics import forward
from modcal_core.robots.urdf import read_chain

JOINT_RATE, EVERY = 1000, 5  # Hz; joint states to a pose
DWELL, TRAVEL = 0.8, 0.5  # s
TURN = 6  # postures until the first comes again
_STAMP = struct.Struct("<iI")
_HEADER = 4  # bytes of CDR before the stamp


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


def main() -> None:
    """Publish for ever; arguments: the arm's URDF, and a file that is made when it begins."""
    urdf = Path(sys.argv[1]).read_text()
    chain, rng = read_chain(urdf), np.random.default_rng(1)
    rclpy.init()
    node = Node("source")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_publisher(String, "robot_description", latched).publish(String(data=urdf))
    joints = node.create_publisher(JointState, "joint_states", 1000)
    tracker = node.create_publisher(PoseStamped, "tracker/pose", 1000)
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
    Path(sys.argv[2]).touch()
    began, sent = time.monotonic(), 0
    try:
        while rclpy.ok():
            due = int((time.monotonic() - began) * JOINT_RATE)
            for k in range(sent, due):
                now = time.time_ns()
                stamp = divmod(now, 1_000_000_000)
                state_bytes = states[k % len(states)]
                _STAMP.pack_into(state_bytes, _HEADER, *stamp)
                joints.publish(bytes(state_bytes))
                if k % EVERY == 0:
                    pose_bytes = poses[k // EVERY % len(poses)]
                    _STAMP.pack_into(pose_bytes, _HEADER, *stamp)
                    tracker.publish(bytes(pose_bytes))
            sent = max(sent, due)
            time.sleep(max(0.0, began + (sent + 1) / JOINT_RATE - time.monotonic()))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
