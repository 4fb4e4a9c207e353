"""A node that takes and discards what every other node hears: what rclpy itself costs.

python bare.py spin FILE    # rclpy's executor, a callback a message; FILE: what was taken, and how late
python bare.py rest FILE    # all that waits is taken at once, and then a rest, as nodes of modcal do
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

DEPTH = 1000
REST = 0.003  # s


def main(way: str, out: Path) -> None:
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


if __name__ == "__main__":
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        main(sys.argv[1], Path(sys.argv[2]))
