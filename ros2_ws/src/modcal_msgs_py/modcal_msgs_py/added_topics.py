"""Topics that installed packages add: what a message of a maker's own says, in the words of a recording.

    [project.entry-points."modcal.topics"]
    motor_temperatures = "my_package.motor_temperatures:TOPIC"

names an :class:`AddedTopic`. From then on every bag is read with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

from modcal_core.errors import BadTable
from modcal_core.measurements.packages import added

GROUP = "modcal.topics"


@dataclass(frozen=True)
class Signal:
    """A number that an error may depend on, by the driver's name: ``temperature:LINK`` [°C], or one of your own."""

    name: str
    value: float


@dataclass(frozen=True)
class Reading:
    """What an instrument read. kind: one of measurements/kinds; values: as many numbers as it has [m, unit length]."""

    kind: str
    frame: str
    values: Sequence[float]


@dataclass(frozen=True)
class Joints:
    """Where the joints are [rad or m], and, where known, their velocities [per s] and efforts [N m or N]."""

    name: Sequence[str]
    position: Sequence[float]
    velocity: Sequence[float] = ()
    effort: Sequence[float] = ()


Said: TypeAlias = Signal | Reading | Joints


@dataclass(frozen=True)
class AddedTopic:
    """One topic of a package.

    topic: its name, or the end of it behind a namespace. message: its type, such as ``my_msgs/msg/Motors``; the bag
    says how it is laid out. take: what one message says; its attributes are those of rclpy. Its stamp is that of its
    header, or, where it has none, the time it was received.
    """

    topic: str
    message: str
    take: Callable[[Any], Iterable[Said]]


@cache
def added_topics() -> dict[str, AddedTopic]:
    """The topics of installed packages, by name. Raises BadTable for what is none, or that two packages claim."""
    out: dict[str, AddedTopic] = {}
    for offender, named in added(GROUP):
        if not isinstance(named, AddedTopic):
            raise BadTable(offender, f"names a {type(named).__name__}", "name an AddedTopic")
        topic = named.topic.strip("/")
        if topic in out:
            raise BadTable(offender, f"topic {topic} is already used", "choose another")
        out[topic] = named
    return out
