"""What bags of an arm that stops hold: joint states a second at each posture and a second to the next."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_msgs_py.layout import message_class

START = 1_700_000_000.0
JOINT_STATE = "sensor_msgs/msg/JointState"
_A_SECOND = 20  # joint states


def header(stamp: float, frame: str = "") -> Any:
    time = message_class("builtin_interfaces/msg/Time")(sec=int(stamp), nanosec=round(1e9 * (stamp % 1.0)))
    return message_class("std_msgs/msg/Header")(stamp=time, frame_id=frame)


def stops(names: Sequence[str], q: Array) -> Iterator[tuple[float, Any, int, float]]:
    """(stamp, joint state, number of the stop, share of the stay at it that has passed; below 0 on the way to it)."""
    state, nothing, t = message_class(JOINT_STATE), np.empty(0), START
    for k, at in enumerate(q):
        before = q[max(k - 1, 0)]
        for j in range(-_A_SECOND if k else 0, _A_SECOND):
            share = j / _A_SECOND
            way = min(1.0 + share, 1.0)
            now = before + way * way * (3.0 - 2.0 * way) * (at - before)
            yield t, state(header(t), list(names), now, nothing, nothing), k, share
            t += 1.0 / _A_SECOND
