"""Where drivers stop: what was recorded of them, beyond which a frozen effect is not continued.

Time goes on for as long again as the recording lasted, for a session rarely ends with it; from there it returns to the
recording's end, so that days later nothing is extrapolated. Temperatures go on for as far again as they were seen, for
arms go on warming, and stop there; signals, of which nothing is known, stop at the ends of what was seen. An effect
whose driver a recording lacks altogether is replaced by what it was on average.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class DriverLimits:
    """watched: first and last stamp [s] of the recording, None where unknown. clock: whether stamps are times; an order
    of rows stands still at its middle. ranges: smallest and largest value of temperatures and signals by name.
    """

    watched: tuple[float, float] | None = None
    clock: bool = True
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def time(self, stamps: Array) -> Array:
        """The time [s] that effects go by at these stamps (N,): continuous, and never outside what may be continued."""
        stamps = np.asarray(stamps, dtype=float)
        if self.watched is None:
            return stamps
        first, last = self.watched
        if not self.clock:
            return np.full(stamps.shape, 0.5 * (first + last))
        length = last - first
        later = stamps - last
        return np.where(later <= length, np.maximum(stamps, first), last + np.maximum(2.0 * length - later, 0.0))

    def value(self, name: str, x: Array) -> Array:
        """Values of a temperature or signal, no further than they may be continued."""
        if name not in self.ranges:
            return x
        low, high = self.ranges[name]
        beyond = high - low if name.startswith("temperature:") else 0.0
        return np.clip(x, low - beyond, high + beyond)
