"""The processes of bench/chaos.py: a relay that spoils what it passes on, and nodes whose callbacks raise now and then.

python bench/chaos_parts.py relay LOG SEED       # /raw/... → /...; LOG: what was published, and what was done to it
python bench/chaos_parts.py node NAME LOG SEED [--ros-args ...]
"""

from __future__ import annotations

import faulthandler
import hashlib
import heapq
import math
import signal
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable
from importlib import import_module
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
CLOCK_EVERY, CLOCK_FOR, CLOCK_STEP = 45.0, 4.0, 5.0  # s
FAULTS_A_SECOND = 0.5


def digest(cdr: bytes) -> bytes:
    """What a message is known by."""
    return hashlib.blake2b(cdr, digest_size=KEY).digest()


class Relay:
    """Takes /raw/joint_states and /raw/tracker/pose as bytes and publishes them, spoiled, without the prefix."""

    def __init__(self, log: Path, seed: int) -> None:
        import rclpy
        from geometry_msgs.msg import PoseStamped
        from nodes.talking import LATCHED, RELIABLE
        from sensor_msgs.msg import JointState
        from std_msgs.msg import String

        self.types = {"joint_states": JointState, "tracker/pose": PoseStamped}
        self.qos = RELIABLE
        self.node = rclpy.create_node("chaos_relay")
        self.rng = np.random.default_rng(seed)
        self.done: Counter[str] = Counter()
        self.held: list[tuple[float, int, str, bytes]] = []
        self.begun = time.monotonic()
        self.restarted, self.gap_until = 0.0, 0.0
        self.log, self.totals = log.open("wb"), log.with_suffix(".txt")
        self.restarts = log.with_name("restarts.txt")
        self.publishers: dict[str, Any] = {}
        self.description = self.node.create_publisher(String, "robot_description", LATCHED)
        self.node.create_subscription(String, "raw/robot_description", self.description.publish, LATCHED)
        self.sources = [
            self.node.create_subscription(kind, f"raw/{topic}", self._hearer(topic), RELIABLE, raw=True)
            for topic, kind in self.types.items()
        ]
        self._open()
        self.node.create_timer(0.01, self._look)

    def _hearer(self, topic: str) -> Callable[[bytes], None]:
        from modcal_nodes.ros.pending import waiting

        def hear(cdr: bytes) -> None:
            self._take(topic, cdr)
            source = next(s for s in self.sources if s.topic_name == f"/raw/{topic}")
            for more, _ in waiting(source, 200, raw=True):
                self._take(topic, more)

        return hear

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
        if since % CLOCK_EVERY > CLOCK_EVERY - CLOCK_FOR:
            cdr = _later(cdr, CLOCK_STEP)
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
        from rclpy.serialization import deserialize_message, serialize_message

        message = deserialize_message(cdr, self.types["joint_states"])
        order = self.rng.permutation(len(message.name))
        message.name = [message.name[k] for k in order]
        for field in ("position", "velocity", "effort"):
            values = getattr(message, field)
            if len(values) == len(order):
                setattr(message, field, [values[k] for k in order])
        return bytes(serialize_message(message))

    def _corrupted(self, topic: str, cdr: bytes) -> bytes:
        """A value that is none, a sequence of another length, a quaternion of no rotation, or one bit of a number."""
        from rclpy.serialization import deserialize_message, serialize_message

        message = deserialize_message(cdr, self.types[topic])
        how = int(self.rng.integers(4))
        if topic == "joint_states":
            k = int(self.rng.integers(len(message.position)))
            if how == 0:
                message.position[k] = math.nan
            elif how == 1:
                message.position = message.position[:k]
            elif how == 2:
                message.name = [message.name[0]] * len(message.name)
            else:
                message.position[k] = _flipped(message.position[k], int(self.rng.integers(64)))
        elif how == 0:
            message.pose.position.x = math.inf
        elif how == 1:
            message.pose.orientation.w = message.pose.orientation.z = 0.0
        elif how == 2:
            message.header.stamp.sec = 0
        else:
            message.pose.position.y = _flipped(message.pose.position.y, int(self.rng.integers(64)))
        return bytes(serialize_message(message))

    def close(self) -> None:
        """Write what was done."""
        self.log.close()
        self.totals.write_text("\n".join(f"{count} {what}" for what, count in self.done.items()))


def _flipped(value: float, bit: int) -> float:
    (number,) = struct.unpack("<Q", struct.pack("<d", value))
    (out,) = struct.unpack("<d", struct.pack("<Q", number ^ (1 << bit)))
    return float(out)


def _later(cdr: bytes, seconds: float) -> bytes:
    """The message with its stamp moved: the stamp of a header comes first, behind four bytes of CDR."""
    sec, rest = struct.unpack_from("<i", cdr, 4)[0], cdr[8:]
    return cdr[:4] + struct.pack("<i", sec + int(seconds)) + rest


def relay(log: str, seed: str) -> None:
    """Relay until stopped on request."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    ended: list[int] = []
    faulthandler.register(signal.SIGUSR1)  # where it stands, if it does not end
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, lambda *_: ended.append(1))
    made, executor = Relay(Path(log), int(seed)), SingleThreadedExecutor()
    executor.add_node(made.node)
    while not ended:
        executor.spin_once()
    made.close()
    for what, act in (("node", made.node.destroy_node), ("context", rclpy.shutdown)):
        print(f"relay: ending the {what}", flush=True)
        act()


class Injected(Exception):
    """Thrown by the bench."""


def node(name: str, log: str, seed: str) -> None:
    """Run a node; some of its callbacks raise, in place of what they do. Each is a line of LOG."""
    from modcal_nodes.ros.guarded import Guarded

    rng, plain = np.random.default_rng(int(seed)), Guarded.__call__
    state = {"next": np.inf}

    def called(self: Guarded, *args: Any) -> Any:
        if state["next"] == np.inf and self.place.startswith("timer"):  # it spins: what fails while it starts ends it
            state["next"] = time.monotonic() + 1.0
        if time.monotonic() < state["next"]:
            return plain(self, *args)
        state["next"] = time.monotonic() + rng.exponential(1.0 / FAULTS_A_SECOND)
        before, self.callback = self.callback, _boom
        with Path(log).open("a") as stream:
            stream.write(f"{time.monotonic()} {name} {self.place}\n")
        try:
            return plain(self, *args)
        finally:
            self.callback = before

    Guarded.__call__ = called  # type: ignore[method-assign]
    sys.argv = [name, *sys.argv[5:]]
    import_module(f"modcal_nodes.nodes.{name}").main()


def _boom(*_: Any) -> Any:
    raise Injected("by the bench")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
    if sys.argv[1] == "relay":
        relay(*sys.argv[2:4])
    else:
        node(*sys.argv[2:5])
