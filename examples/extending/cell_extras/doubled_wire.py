"""A measurement kind: a draw wire that runs around a pulley at the tool and back to its box, and so pays out twice.

The reading is 2 |p − a| + z, with p the pulley, a the box and z the zero of its scale. All else is a draw wire's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modcal_core.measurements.kinds import DistanceKind, Scene, Sight

Array = NDArray[np.float64]


class DoubledWire(DistanceKind):
    """Twice the distance from a fixed box to the tool. Residuals and zero are those of the distance [m]."""

    name = "doubled_wire"
    topic = "tracker/doubled_wire"
    message = "sensor_msgs/msg/Range"

    def see(self, scene: Scene, values: Array, reading: Array) -> Sight:
        """As a wire with half the reading sees it."""
        return super().see(scene, values, 0.5 * reading)

    def predict(self, scene: Scene, values: Array) -> Array:
        """Twice the length of a wire."""
        return 2.0 * super().predict(scene, values)

    def place(self, T_base_tool: Array, reading: Array, known: Array | None = None) -> tuple[Array, Array]:
        """Where a wire with half the readings stands."""
        return super().place(T_base_tool, 0.5 * reading, known)


KIND = DoubledWire()
