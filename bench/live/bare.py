"""A node that takes and discards what every other node hears: what rclpy itself costs.

python bare.py spin     # rclpy's executor, a callback a message
python bare.py rest     # all that waits at once, and a rest, as nodes of modcal do
"""

from __future__ import annotations

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
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

DEPTH = 1000
REST = 0.003  # s


def main() -> None:
    """Spin until told to stop; then write how old poses were when they were taken into the file that is named."""
    rclpy.init()
    node, taken, late = Node("bare"), [0, 0], deque[float](maxlen=20_000)

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
        if sys.argv[1] == "spin":
            rclpy.spin(node)
        while True:
            rclpy.spin_once(node)
            for subscription, take in heard:
                with subscription.handle:
                    while (waits := subscription.handle.take_message(subscription.msg_type, False)) is not None:
                        take(waits[0])
            time.sleep(REST)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:  # a context that ends in the middle of a wait is an error of its own kind
        figures = {"taken": taken, "late_ms": [float(x) for x in 1e3 * np.percentile(late or [np.nan], [50.0, 99.0])]}
        Path(sys.argv[2]).write_text(json.dumps(figures))


if __name__ == "__main__":
    main()
