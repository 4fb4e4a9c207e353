"""Processes beside modcal's own: a relay that spoils messages, nodes whose callbacks raise at times, bare nodes.

python parts.py relay LOG SEED       # /raw/... → /...; LOG: what was published, and what was done to it
python parts.py node NAME LOG SEED [--ros-args ...]
python parts.py bare spin FILE       # rclpy's executor, a callback a message; FILE: what was taken, and how late
python parts.py bare hear FILE       # the same of what nodes answer, with how many stamps are those of a joint state
python parts.py bare rest FILE       # all that waits is taken at once, and then a rest, as nodes of modcal do
"""

from __future__ import annotations

import contextlib
import hashlib
import heapq
import json
import math
import signal
import struct
import sys
import time
from collections import Counter, defaultdict, deque
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np

KEY = 8  # bytes of a message's digest
RECORD = struct.Struct(f"<dB{KEY}s")  # when it was published (monotonic), which topic, digest
DROP, DOUBLE, DELAY, CORRUPT = 0.005, 0.005, 0.01, 0.002  # shares of messages
LATEST = 0.08  # s that a message is held back
GAP_EVERY, GAP = 5.0, 0.2  # s
ORDER_EVERY, ORDER_FOR = 20.0, 3.0  # s
RESTART_EVERY = 15.0  # s
CLOCK_EVERY, CLOCK_FOR, CLOCK_STEP = 45.0, 4.0, 5  # s
FAULTS_A_SECOND = 0.5
REST, SOON = 0.003, 0.0005  # s, of a bare node, and of one that is to be late by less than what it hears


def digest(cdr: bytes) -> bytes:
    return hashlib.blake2b(cdr, digest_size=KEY).digest()


class Relay:
    """Takes /raw/joint_states and /raw/tracker/pose as bytes and publishes them, spoiled, without the prefix."""

    def __init__(self, log: Path, seed: int) -> None:
        import rclpy
        from geometry_msgs.msg import PoseStamped
        from nodes.talking import LATCHED, RELIABLE
        from rclpy.serialization import deserialize_message, serialize_message
        from sensor_msgs.msg import JointState
        from std_msgs.msg import String

        self.types = {"joint_states": JointState, "tracker/pose": PoseStamped}
        self.read = lambda topic, cdr: deserialize_message(cdr, self.types[topic])
        self.written = lambda message: bytes(serialize_message(message))
        self.qos = RELIABLE
        self.node = rclpy.create_node("chaos_relay")
        self.rng = np.random.default_rng(seed)
        self.done: Counter[str] = Counter()
        self.held: list[tuple[float, int, str, bytes]] = []
        self.begun, self.restarted, self.gap_until = time.monotonic(), 0.0, 0.0
        self.log, self.totals, self.restarts = log.open("wb"), log.with_suffix(".txt"), log.with_name("restarts.txt")
        self.publishers: dict[str, Any] = {}
        description = self.node.create_publisher(String, "robot_description", LATCHED)
        self.node.create_subscription(String, "raw/robot_description", description.publish, LATCHED)
        self.sources: dict[str, Any] = {}
        for topic, kind in self.types.items():
            hear = lambda cdr, topic=topic: self._hear(topic, cdr)  # noqa: E731
            self.sources[topic] = self.node.create_subscription(kind, f"raw/{topic}", hear, RELIABLE, raw=True)
        self._open()
        self.node.create_timer(0.01, self._look)

    def _hear(self, topic: str, cdr: bytes) -> None:
        from modcal_nodes.ros.guarded import waiting

        self._take(topic, cdr)
        for more, _ in waiting(self.sources[topic], 200, raw=True):
            self._take(topic, more)

    def _open(self) -> None:
        for publisher in self.publishers.values():
            self.node.destroy_publisher(publisher)
        self.publishers = {
            topic: self.node.create_publisher(kind, topic, self.qos) for topic, kind in self.types.items()
        }

    def _take(self, topic: str, cdr: bytes) -> None:
        since = time.monotonic() - self.begun
        if time.monotonic() < self.gap_until or self.rng.random() < DROP:
            self.done["dropped"] += 1
            return
        if since % CLOCK_EVERY > CLOCK_EVERY - CLOCK_FOR:  # the stamp of a header comes first, behind 4 bytes of CDR
            cdr = cdr[:4] + struct.pack("<i", struct.unpack_from("<i", cdr, 4)[0] + CLOCK_STEP) + cdr[8:]
            self.done["stamped by a clock that was moved"] += 1
        if topic == "joint_states" and since % ORDER_EVERY > ORDER_EVERY - ORDER_FOR:
            cdr = self._reordered(cdr)
            self.done["with another order of joints"] += 1
        if self.rng.random() < CORRUPT:
            cdr = self._corrupted(topic, cdr)
            self.done["corrupted"] += 1
        copies = 1 + (self.rng.random() < DOUBLE)
        self.done["doubled"] += copies - 1
        for _ in range(copies):
            if self.rng.random() < DELAY:
                due = time.monotonic() + LATEST * self.rng.random()
                heapq.heappush(self.held, (due, self.done["delayed"], topic, cdr))
                self.done["delayed"] += 1
            else:
                self._publish(topic, cdr)

    def _publish(self, topic: str, cdr: bytes) -> None:
        self.log.write(RECORD.pack(time.monotonic(), list(self.types).index(topic), digest(cdr)))
        self.publishers[topic].publish(cdr)
        self.done["published"] += 1

    def _look(self) -> None:
        now = time.monotonic()
        while self.held and self.held[0][0] <= now:
            _, _, topic, cdr = heapq.heappop(self.held)
            self._publish(topic, cdr)
        if now - self.begun - self.restarted > RESTART_EVERY:
            self.restarted = now - self.begun
            with self.restarts.open("a") as stream:
                stream.write(f"{now}\n")
            self._open()
            self.done["restarts of the publishers"] += 1
        if self.rng.random() < 0.01 / GAP_EVERY:
            self.gap_until = now + GAP * self.rng.random()

    def _reordered(self, cdr: bytes) -> bytes:
        message = self.read("joint_states", cdr)
        order = self.rng.permutation(len(message.name))
        for field in ("name", "position", "velocity", "effort"):
            values = getattr(message, field)
            if len(values) == len(order):
                setattr(message, field, [values[k] for k in order])
        return self.written(message)

    def _corrupted(self, topic: str, cdr: bytes) -> bytes:
        """A value that is none, a sequence of another length, a quaternion of no rotation, or one bit of a number."""
        message, how = self.read(topic, cdr), int(self.rng.integers(4))
        if topic == "joint_states":
            k = int(self.rng.integers(len(message.position)))
            if how == 0:
                message.position[k] = math.nan
            elif how == 1:
                message.position = message.position[:k]
            elif how == 2:
                message.name = [message.name[0]] * len(message.name)
            else:
                message.position[k] = self._flipped(message.position[k])
        elif how == 0:
            message.pose.position.x = math.inf
        elif how == 1:
            message.pose.orientation.w = message.pose.orientation.z = 0.0
        elif how == 2:
            message.header.stamp.sec = 0
        else:
            message.pose.position.y = self._flipped(message.pose.position.y)
        return self.written(message)

    def _flipped(self, value: float) -> float:
        (number,) = struct.unpack("<Q", struct.pack("<d", value))
        return float(struct.unpack("<d", struct.pack("<Q", number ^ (1 << int(self.rng.integers(64)))))[0])

    def close(self) -> None:
        self.log.close()
        self.totals.write_text("\n".join(f"{count} {what}" for what, count in self.done.items()))


def relay(log: str, seed: str) -> None:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    ended: list[int] = []
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, lambda *_: ended.append(1))
    made, executor = Relay(Path(log), int(seed)), SingleThreadedExecutor()
    executor.add_node(made.node)
    while not ended:
        executor.spin_once()
    made.close()
    made.node.destroy_node()
    rclpy.shutdown()


class Injected(Exception):
    """Thrown by the bench."""


def _boom(*_: Any) -> Any:
    raise Injected("by the bench")


def node(name: str, log: str, seed: str) -> None:
    """Run a node; some of its callbacks raise, in place of what they do. Each is a line of LOG."""
    from modcal_nodes.ros.guarded import Guarded

    rng, plain, due = np.random.default_rng(int(seed)), Guarded.__call__, [np.inf]

    def called(self: Guarded, *args: Any) -> Any:
        if due[0] == np.inf and self.place.startswith("timer"):  # it spins: what fails while it starts ends it
            due[0] = time.monotonic() + 1.0
        if time.monotonic() < due[0]:
            return plain(self, *args)
        due[0] = time.monotonic() + rng.exponential(1.0 / FAULTS_A_SECOND)
        before, self.callback = self.callback, _boom
        with Path(log).open("a") as stream:
            stream.write(f"{time.monotonic()} {name} {self.place}\n")
        try:
            return plain(self, *args)
        finally:
            self.callback = before

    Guarded.__call__ = called  # type: ignore[method-assign]
    sys.argv = [name, *sys.argv[5:]]
    (executable,) = entry_points(group="console_scripts", name=name)
    executable.load()()


def bare(way: str, out: str) -> None:
    """Take and discard until told to stop; then write how old poses were when they were taken, or what was heard."""
    import rclpy
    from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    rclpy.init()
    node, taken = rclpy.create_node("bare"), Counter[str]()
    told = defaultdict[str, deque[tuple[int, int]]](lambda: deque(maxlen=20_000))  # stamps and ages [ns]

    def take(topic: str, message: Any) -> None:
        taken[topic] += 1
        if topic == "tracker/pose" or way == "hear":
            ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            told[topic].append((ns, time.time_ns() - ns))

    kinds = {"joint_states": JointState, "tracker/pose": PoseStamped}
    if way == "hear":
        kinds = {"joint_states": JointState, "corrector/pose": PoseWithCovarianceStamped}
        kinds["acceleration_limits/upper"] = JointTrajectory
    heard = {topic: node.create_subscription(kind, topic, partial(take, topic), 1000) for topic, kind in kinds.items()}
    with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        try:
            if way == "spin":
                rclpy.spin(node)
            while True:
                rclpy.spin_once(node)
                for topic, subscription in heard.items():
                    with subscription.handle:
                        while (waits := subscription.handle.take_message(subscription.msg_type, False)) is not None:
                            take(topic, waits[0])
                time.sleep(REST if way == "rest" else SOON)
        finally:  # a context that ends in the middle of a wait is an error of its own kind
            ms = {t: np.percentile([1e-6 * age for _, age in d], [50.0, 99.0]).tolist() for t, d in told.items()}
            known = {ns for ns, _ in told["joint_states"]}
            of = {
                t: [ns for ns, _ in d if min(known, default=0) <= ns <= max(known, default=0)] for t, d in told.items()
            }
            exact = {t: [sum(ns in known for ns in stamps), len(stamps)] for t, stamps in of.items()}
            late = ms.get("tracker/pose", [math.nan, math.nan])
            data = {"taken": [taken[topic] for topic in kinds], "late_ms": late, "all_ms": ms, "exact": exact}
            Path(out).write_text(json.dumps(data))


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
    what, *words = sys.argv[1:]
    {"relay": relay, "node": node, "bare": bare}[what](*words[: 3 if what == "node" else 2])
