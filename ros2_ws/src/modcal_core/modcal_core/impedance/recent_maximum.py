"""Running maximum over a time window, in constant time per value."""

from __future__ import annotations

from collections import deque


class RecentMaximum:
    """The largest of the values of the last ``seconds``; 0 before the first. Times must not go back."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._falling: deque[tuple[float, float]] = deque()  # those that no later one exceeds: the first is the largest

    def add(self, now: float, value: float) -> None:
        """Note a value at time ``now`` [s], and forget what is too old."""
        values = self._falling
        while values and values[-1][1] <= value:
            values.pop()
        values.append((now, value))
        while values[0][0] < now - self._seconds:
            values.popleft()

    @property
    def largest(self) -> float:
        """Maximum over the last ``seconds``; 0 where there is none."""
        return self._falling[0][1] if self._falling else 0.0
