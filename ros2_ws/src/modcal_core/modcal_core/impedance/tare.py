"""The tare before a pull: what the force sensor says while the arm stands still and nothing is touched.

Its mean is the sensor's offset; the weight of what hangs on it is stated (:class:`~modcal_core.impedance.wrench.Load`).
"""

from __future__ import annotations

import math

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array
from modcal_core.impedance.speed_governor import NO_STATUS
from modcal_core.impedance.task import JointPositions
from modcal_core.impedance.wrench import DOWN, Load, WrenchSensor

PATIENCE = 10.0  # s
_REST = 0.01  # rad/s or m/s of a joint that still counts as standing
_LEAST = 25  # readings
_NOISE = 2.0, 0.2  # N, N m: largest standard deviation of readings
_MIN_SPAN = 0.02  # s between two joint states, at least, over which that is measured


class Tare:
    """The offset of the sensor, as a mean while the arm stands still."""

    def __init__(self, seconds: float = 0.5) -> None:
        """Average readings for some seconds, at least 25 of them."""
        self._seconds = seconds
        self._readings: list[Array] = []
        self._begun = math.nan

    def add(self, wrench: Array, stamp: float, at_rest: bool) -> bool:
        """Take one reading (6,) of a time [s]; whether there are enough. An arm that moves starts the tare again."""
        if not at_rest or not self._readings:
            self._readings, self._begun = [], stamp
        self._readings.append(np.array(wrench, dtype=float))
        return len(self._readings) >= _LEAST and stamp - self._begun >= self._seconds

    def load(self, R_base_sensor: Array, known: Load, down: Array = DOWN) -> Load:
        """The known load with the offset that was found. Raises BadCommand where the readings scatter too much."""
        readings = np.array(self._readings)
        scatter = readings.std(axis=0)
        for what, worst, most, unit in (
            ("force", float(scatter[:3].max()), _NOISE[0], "N"),
            ("moment", float(scatter[3:].max()), _NOISE[1], "N m"),
        ):
            if not worst <= most:
                raise BadCommand(
                    f"tare of the {what}",
                    f"readings scatter by {worst:.3g} {unit}, {most:g} is the limit",
                    "keep the arm still and its surroundings quiet, or check the sensor",
                )
        weight = Load(known.mass, known.centre).wrench(R_base_sensor, down)
        return Load(known.mass, known.centre, readings.mean(axis=0) - weight)


class TarePhase:
    """The phase of a pull that comes before anything moves: tick it until it is done."""

    def __init__(self, seconds: float, down: Array = DOWN, sensor: bool = True) -> None:
        """Tare for some seconds at rest. down (3,): gravity in the base [m/s²]. sensor: whether one has to be tared."""
        self._tare, self._down, self._has_sensor = Tare(seconds), down, sensor
        self._since = math.nan  # s
        self._before: tuple[float, Array] | None = None

    def step(
        self, now: float, T: Array, sensor: WrenchSensor, joints: JointPositions, silent: bool
    ) -> tuple[bool, str]:
        """Whether it is over, and why it waits or failed; nothing to say once the sensor's load is known.

        silent: whether no status of the object was received: nothing moves that no estimator follows. Raises
        BadCommand where the readings scatter too much.
        """
        if math.isnan(self._since):
            self._since = now
        late = now - self._since > PATIENCE
        at_rest = True
        if self._before is not None and now > self._before[0]:
            span = max(now - self._before[0], _MIN_SPAN)
            at_rest = bool(np.abs(joints.q - self._before[1]).max() <= _REST * span)
        self._before = now, joints.q
        reading = (sensor.raw, sensor.stamp) if self._has_sensor else (np.zeros(6), joints.stamp)
        if not self._tare.add(*reading, at_rest):
            if late:
                return True, "tare: the arm is moving: hold it still before the pull"
            return False, "taring the wrench: the arm stands still for a moment"
        if silent:
            return late, NO_STATUS
        if not self._has_sensor:
            return True, ""
        sensor.load = self._tare.load(sensor.rotation(T), sensor.load, self._down)
        sensor.reset_past()
        return True, ""
