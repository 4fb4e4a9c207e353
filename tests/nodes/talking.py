"""Publishers that number what they say, and what of it is found on disk or told on /diagnostics."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from modcal_core.errors import BadRecording
from modcal_msgs_py.layout import jazzy
from modcal_msgs_py.mcap_walk import McapFile
from modcal_msgs_py.readings import seconds

# deep enough that a machine that is busy with other things makes no publisher forget what was not yet heard
RELIABLE = QoSProfile(depth=5000)
BEST_EFFORT = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def numbered(number: int) -> JointState:
    """A joint state that carries a number in its stamp."""
    message = JointState(name=["shoulder", "elbow"], position=[0.1, 0.2])
    message.header.stamp.sec, message.header.stamp.nanosec = 1 + number // 1000, number % 1000
    return message


class Talker:
    """Publishes numbered joint states from a thread. ``times[k]``: when number k was about to be published."""

    def __init__(self, node: Node, topic: str = "joint_states", rate: float = 200.0) -> None:
        """Begin to publish."""
        self.publisher = node.create_publisher(JointState, topic, RELIABLE)
        self.times: list[float] = []
        self._period = 1.0 / rate
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._talk, daemon=True)
        self._thread.start()

    def _talk(self) -> None:
        begun = time.monotonic()
        while not self._ended.is_set():
            while len(self.times) * self._period <= time.monotonic() - begun:
                self.times.append(time.monotonic())
                self.publisher.publish(numbered(len(self.times) - 1))
            time.sleep(0.2 * self._period)

    def __enter__(self) -> Talker:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def stop(self) -> int:
        """Publish no more; how many there were."""
        self._ended.set()
        self._thread.join()
        return len(self.times)

    def before(self, moment: float) -> int:
        """How many had been published some time before this moment."""
        return sum(1 for t in list(self.times) if t < moment)


def on_disk(bag: Path, topic: str) -> Iterator[Any]:
    """The messages of one topic in a bag, in the order of its files; none while there is no file to read."""
    for path in sorted(bag.glob("*.mcap")):
        with contextlib.suppress(BadRecording):
            for raw in McapFile(path).messages():
                if raw.topic == topic:
                    yield jazzy().deserialize_cdr(raw.cdr, raw.type_name)


def numbers_on_disk(bag: Path, topic: str = "/joint_states") -> list[int]:
    """Numbers of the joint states in a bag."""
    return [(m.header.stamp.sec - 1) * 1000 + m.header.stamp.nanosec for m in on_disk(bag, topic)]


def strings_on_disk(bag: Path, topic: str) -> list[str]:
    """Texts in a bag."""
    return [message.data for message in on_disk(bag, topic)]


class Diagnostics:
    """What nodes have said on /diagnostics, by the name of the status; of a part of the node ``who``: ``self[part]``.

    ``worst`` and ``texts`` over all time; ``at``: stamps of the last [s].
    """

    def __init__(self, node: Node, who: str = "") -> None:
        """Begin to listen."""
        self.who = who
        self.last: dict[str, DiagnosticStatus] = {}
        self.at: dict[str, float] = {}
        self.worst: dict[str, bytes] = {}
        self.texts: dict[str, set[str]] = {}
        node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 100)

    def _hear(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.last[status.name], self.at[status.name] = status, seconds(message.header.stamp)
            self.worst[status.name] = max(self.worst.get(status.name, b"\0"), status.level)
            self.texts.setdefault(status.name, set()).add(status.message)

    def __contains__(self, part: str) -> bool:
        return f"{self.who}: {part}" in self.last

    def __getitem__(self, part: str) -> DiagnosticStatus:
        """The last of this part; one that is stale before there is one."""
        return self.last.get(f"{self.who}: {part}", DiagnosticStatus(level=DiagnosticStatus.STALE))

    def level(self, name: str) -> int:
        """0 ok, 1 warning, 2 error; −1 while nothing was said."""
        return int.from_bytes(self.last[name].level, "little") if name in self.last else -1

    def text(self, name: str) -> str:
        """The last message of this name."""
        return self.last[name].message if name in self.last else ""

    def value(self, name: str, key: str) -> str:
        """A fact of the last status of this name; empty before there is one."""
        values = self.last[name].values if name in self.last else []
        return next((pair.value for pair in values if pair.key == key), "")

    def said(self, name: str, words: str) -> bool:
        """Whether a status of this name ever held these words."""
        return any(words in text for text in self.texts.get(name, ()))

    def found(self, topic: str) -> bool:
        """Whether some node says that it has found a publisher of this topic."""
        return any(self.value(name, f"publishers of {topic}") not in ("", "0") for name in self.last)

    def counted(self, topic: str) -> int:
        """How many messages of this topic some node says it has received."""
        return max((int(self.value(name, f"messages of {topic}") or 0) for name in self.last), default=0)
