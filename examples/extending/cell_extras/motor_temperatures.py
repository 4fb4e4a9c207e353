"""A bag topic: a controller says the temperatures of its motors in one array, by the order of its axes.

Each becomes the signal ``temperature:JOINT``, which thermal effects are looked for along.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from modcal_msgs_py import AddedTopic, Signal

AXES = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


def take(message: Any) -> Iterator[Signal]:
    """The temperatures [°C] of one std_msgs/Float64MultiArray."""
    for axis, celsius in zip(AXES, message.data, strict=True):
        yield Signal(f"temperature:{axis}_joint", celsius)


TOPIC = AddedTopic("motor_temperatures", "std_msgs/msg/Float64MultiArray", take)
