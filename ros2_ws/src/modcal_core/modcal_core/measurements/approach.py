"""Which way each joint last went: backlash and friction depend on it, long after the joint has stopped."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from modcal_core.geometry.so3 import Array

TRAVEL = 5e-4  # rad or m; a joint that is this far from where it was has come from there


@dataclass
class Approach:
    """Remembers which way each joint of an arm last went. Fed with every posture, in order of time."""

    direction: Array = field(default_factory=lambda: np.empty(0))
    _anchor: Array = field(default_factory=lambda: np.empty(0))

    def update(self, q: Array) -> Array:
        """The directions (n,), −1, 0 (unknown) or 1, now that the joints are at q (n,)."""
        if self._anchor.shape != q.shape:
            self._anchor, self.direction = q.copy(), np.zeros(len(q))
        way = q - self._anchor
        moved = np.abs(way) > TRAVEL
        self.direction = np.where(moved, np.sign(way), self.direction)
        # while a joint goes on the same way its anchor goes with it, so that turning back is noticed at once
        onward = moved | (way * self.direction > 0.0)
        self._anchor = np.where(onward, q, self._anchor)
        return self.direction
