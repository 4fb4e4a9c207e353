"""When the simulated cell speaks: on a grid of times, whatever the machine does meanwhile."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # `modcal simulate` needs no ROS
    from rclpy.node import Node

NANO = 1_000_000_000


class Grid:
    """Times ``start + (k + phase) / rate`` [s], each of them handed out once."""

    def __init__(self, rate: float, phase: float = 0.0) -> None:
        self._rate, self._phase = rate, phase
        self.count = 0
        self.start(0.0)

    def start(self, at: float) -> None:
        """Start over at a time."""
        self._start, self._k = at, 0

    def take(self, until: float) -> Iterator[float]:
        """The times up to ``until`` that have not been handed out yet."""
        while (due := self._start + (self._k + self._phase) / self._rate) <= until:
            self._k += 1
            yield due
            self.count += 1  # once it has been dealt with


class CellTime:
    """Seconds of the cell's own time; it speaks from zero on.

    Either the time of the node's clock, or a simulated one that runs ``factor`` times as fast as the wall's and reads
    ``first`` [s] in the beginning.
    """

    def __init__(self, node: Node, delay: float, simulated: bool, first: float = 0.0, factor: float = 1.0) -> None:
        self._clock, self.delay, self.simulated, self._factor = node.get_clock(), delay, simulated, factor
        self._base = round((first + delay) * NANO)
        self._wall = time.monotonic()

    def begin(self) -> bool:
        """Start to count at ``-delay``; False while the node's clock has no time yet."""
        self._wall = time.monotonic()
        if not self.simulated:
            now = int(self._clock.now().nanoseconds)
            if now == 0:
                return False
            self._base = now + round(self.delay * NANO)
        return True

    def now(self) -> float:
        """Seconds, below zero while the cell is still silent."""
        if self.simulated:
            return (time.monotonic() - self._wall) * self._factor - self.delay
        return 1e-9 * (self._clock.now().nanoseconds - self._base)

    def stamp(self, seconds: float) -> tuple[int, int]:
        """Seconds and nanoseconds of the stamp of a time."""
        return divmod(self._base + round(seconds * NANO), NANO)


class Beat:
    """Calls a function at a rate from a thread of its own: rclpy's executor spends more on a timer than the cell does.

    The lock is held during each call.
    """

    def __init__(self, period: float, call: Callable[[], None], alive: Callable[[], bool] = lambda: True) -> None:
        """call: guarded, so that what it raises is told. alive: asked after a failure; whether to go on."""
        self._period, self._call, self._alive = period, call, alive
        self.lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="beat", daemon=True)

    def start(self) -> None:
        """Begin to call."""
        self._thread.start()

    def stop(self) -> None:
        """End it, and wait until it has ended."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._ended.is_set():
            try:
                with self.lock:
                    self._call()
            except Exception:
                if self._alive():
                    raise
                return
            # a beat that was missed is not made up for: the call sends all that is due
            due = max(due + self._period, time.monotonic() - self._period)
            time.sleep(max(due - time.monotonic(), 0.0))
