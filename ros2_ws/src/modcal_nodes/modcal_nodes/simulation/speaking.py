"""How simulated machines speak: their time, their beat, and what falls due.

rclpy's executor spends more on a timer than the machine does.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping

from rosgraph_msgs.msg import Clock as ClockMessage

from modcal_core.errors import BadTable
from modcal_msgs_py import set_nanoseconds
from modcal_nodes.ros import OK, WARN, HealthyNode, Status
from modcal_nodes.simulation.plant import Grid

_NANO = 1_000_000_000
_LATE = 0.1  # s of wall time that the machine may lag behind its own clock
_MIN_PERIOD = 1e-3  # s between beats; what falls due in between is sent together
_DEPTH = 2000  # messages that a publisher of the time keeps for a subscriber that is behind


class SpeakingNode(HealthyNode):
    """A simulated machine that says at its own rates what it is doing, in a thread of its own, until close().

    Its time is that of the node's clock, or a simulated one; it speaks from zero on. A subclass makes what it
    publishes, and then calls :meth:`_begin`. ``lock`` is held while it speaks.
    """

    _at_once, _lost = 0.2, 10.0  # s that one beat makes up for; s that are not made up for: the node's clock was set

    def _begin(
        self, speakers: Mapping[str, tuple[Grid, Callable[[float], None]]], first: float, factor: float, delay: float
    ) -> None:
        """Begin to speak. speakers: by name, when each speaks, and what does it at a time [s]. first: what a simulated
        time reads in the beginning [s]. factor: its seconds in one of the wall's. delay: before the first word [s].
        """
        self._simulated = self._chosen["publish_clock"]
        if self._simulated and self.get_parameter("use_sim_time").value:
            raise BadTable("publish_clock with use_sim_time", "it would wait for itself", "leave one of them out")
        self._delay, self._factor = delay, factor if self._simulated else 1.0
        self._base, self._wall = round((first + delay) * _NANO), time.monotonic()
        self._begun, self._done = False, -delay
        self._grids = {name: grid for name, (grid, _) in speakers.items()}
        self._speakers = list(speakers.values())
        self._since, self._lag, self._counts = time.monotonic(), 0.0, dict.fromkeys(speakers, 0)
        self._period = max(_MIN_PERIOD, 1.0 / (max(grid.rate for grid in self._grids.values()) * self._factor))
        if self._simulated:
            grid = Grid(self._chosen["clock_rate_hz"])
            grid.start(self._done)
            self._clock_topic = self.create_publisher(ClockMessage, "/clock", _DEPTH)
            self._speakers.insert(0, (grid, self._say_time))
        self.lock, self._ended = threading.Lock(), threading.Event()
        self._beat = self.guarded("beat", self._speak)
        self._thread = threading.Thread(target=self._run, name="beat", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Fall silent."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._ended.is_set():
            try:
                with self.lock:
                    self._beat()
            except Exception:
                if self.context.ok():
                    raise
                return
            # a beat that was missed is not made up for: the next one says all that is due
            due = max(due + self._period, time.monotonic() - self._period)
            time.sleep(max(due - time.monotonic(), 0.0))

    def _ready(self) -> bool:
        """Whether it may begin to speak."""
        return True

    def _start_time(self) -> bool:
        """Start to count at ``-delay``; False while the node's clock has no time yet."""
        self._wall = time.monotonic()
        if not self._simulated:
            now = int(self.get_clock().now().nanoseconds)
            self._base = now + round(self._delay * _NANO)
            return now != 0
        return True

    def _own_time(self) -> float:
        """Seconds, below zero while it is still silent."""
        if self._simulated:
            return (time.monotonic() - self._wall) * self._factor - self._delay
        return 1e-9 * (self.get_clock().now().nanoseconds - self._base)

    def _stamp(self, t: float) -> int:
        """Stamp of a time [ns]."""
        return self._base + round(t * _NANO)

    def _advance(self, until: float) -> None:
        """Called before what falls due until a time [s] is said."""

    def _jump(self, now: float) -> None:
        """Go on at another time."""
        for grid, _ in self._speakers:
            grid.start(now)
        self._done = now

    def _speak(self) -> None:
        """Say what has fallen due; what a busy machine held up as well, with the stamps that it should have had."""
        if not self._begun:
            self._begun = self._ready() and self._start_time()
            return
        now = self._own_time()
        if not 0.0 <= now - self._done <= self._lost * self._factor:
            self.get_logger().warning(f"the clock jumped by {now - self._done:.3f} s: continuing from there")
            self._jump(now)
        self._lag = max(self._lag, (now - self._done) / self._factor)
        until = min(now, self._done + self._factor * max(self._at_once, 2.0 * self._period))
        self._advance(until)
        due = [(t, speak) for grid, speak in self._speakers for t in grid.take(until)]
        for t, speak in sorted(due, key=lambda one: one[0]):
            speak(t)
        self._done = until

    def _say_time(self, t: float) -> None:
        message = ClockMessage()
        set_nanoseconds(message.clock, self._stamp(t))
        self._clock_topic.publish(message)

    def _report(self) -> list[Status]:
        """Messages a second since the last report, and how far it is behind."""
        now, counts = time.monotonic(), {name: grid.count for name, grid in self._grids.items()}
        span, lag = max(now - self._since, 1e-3), self._lag
        facts: dict[str, object] = {
            f"{name} [Hz]": f"{(n - self._counts[name]) / span:.1f}" for name, n in counts.items()
        }
        facts["lag [s]"] = f"{lag:.4f}"
        self._since, self._counts, self._lag = now, counts, 0.0
        if lag > _LATE:
            return [Status("rates", WARN, "behind its own clock: lower the rates or time_factor", facts)]
        return [Status("rates", OK, "publishes in time", facts)]
