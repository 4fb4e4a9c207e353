"""From what a force sensor says to the force that the environment exerts on the tool.

F = (force, moment) [N, N m] is what the environment does to the tool, at the tool's origin and in its axes: positive
along z when something pushes the tool that way. Most wrist sensors say the same plus the weight of what hangs on them
and an offset that drifts,

    w = F_sensor + b + m (g, c × g),        g: gravity in the axes of the sensor, c: centre of mass,

of which b is found at rest, before anything is touched: a tare. m and c are stated; what is not, the tare takes for b.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array
from modcal_core.robots import STANDARD_GRAVITY

DOWN = np.array([0.0, 0.0, -STANDARD_GRAVITY])  # m/s², in a base that stands upright


@dataclass(frozen=True)
class Load:
    """What hangs on the sensor. mass [kg], centre (3,) [m] in the sensor's frame, bias (6,) [N, N m]."""

    mass: float = 0.0
    centre: Array = field(default_factory=lambda: np.zeros(3))
    bias: Array = field(default_factory=lambda: np.zeros(6))

    def wrench(self, R_base_sensor: Array, down: Array = DOWN) -> Array:
        """What the sensor says (6,) when nothing touches the tool."""
        g = self.mass * (R_base_sensor.T @ down)
        c = self.centre
        out = np.array(self.bias, dtype=float)
        out[:3] += g
        out[3:] += (c[1] * g[2] - c[2] * g[1], c[2] * g[0] - c[0] * g[2], c[0] * g[1] - c[1] * g[0])
        return out


class LowPass:
    """A first-order low-pass of a vector, that begins at what it first hears."""

    def __init__(self, cutoff_hz: float) -> None:
        self.lag = 1.0 / (2.0 * math.pi * cutoff_hz)  # s by which what rises steadily comes later
        self._last: tuple[float, Array] | None = None

    def take(self, value: Array, stamp: float) -> Array:
        """The value (m,), smoothed; one that is not newer than the last changes nothing."""
        if self._last is None:
            self._last = stamp, value
        elif (h := stamp - self._last[0]) > 0.0:
            self._last = stamp, self._last[1] + (value - self._last[1]) * (h / (self.lag + h))
        return self._last[1]

    def reset(self) -> None:
        """Start over."""
        self._last = None


_TURNED = 0.05  # rad between two readings that are kept: some ten while a wrist turns by 30°
_KEPT, _WORST = 200, 1.5  # readings; N by which they may depart from a weight: beyond that something else was touched
_ALIKE = 4.0  # neighbouring readings depart alike: so much fewer they count
_TELLS = 0.05  # standard deviation of a scale that is known


class SensorWeighing:
    """The scale of a force sensor by the weight of what hangs on it, while the wrist turns freely."""

    def __init__(self) -> None:
        self._kept: deque[Array] = deque(maxlen=_KEPT)  # (4, 3): means of R_sensor_base and, last, of the force
        self._sum, self._count, self._at = np.zeros((4, 3)), 0, np.eye(3)

    def take(self, raw: Array, R_base_sensor: Array) -> None:
        """Note a reading (6,) of a sensor that stands this way in the base (3, 3)."""
        if not self._count:
            self._at = R_base_sensor
        self._sum, self._count = self._sum + np.vstack([R_base_sensor.T, raw[:3]]), self._count + 1
        if np.abs(R_base_sensor - self._at).max() >= _TURNED:
            self._kept.append(self._sum / self._count)
            self._sum, self._count = np.zeros((4, 3)), 0

    def scale(self, mass: float, down: Array = DOWN) -> tuple[float, float] | None:
        """What the sensor tells of a force, as a share, and its standard deviation; None where that is not known.

        mass: that hangs on it [kg]; 0 where it is not stated.
        """
        if not mass > 0.0 or len(self._kept) < 2:
            return None
        kept = np.array(self._kept)
        weights, forces = mass * kept[:, :3] @ down, kept[:, 3]
        w, f = weights - weights.mean(axis=0), forces - forces.mean(axis=0)
        span = float((w * w).sum())
        if not span > 0.0 or f.size <= 4:
            return None
        share = float((w * f).sum()) / span
        variance = float(((f - share * w) ** 2).sum()) / (f.size - 4)
        deviation = math.sqrt(_ALIKE * variance / span)
        return (share, deviation) if deviation <= _TELLS and variance <= _WORST**2 else None


_LARGEST = 1000.0, 200.0  # N, N m, which no reading of a sound sensor exceeds


class WrenchSensor:
    """Readings of one sensor turned into forces on the tool; says no to those that cannot be trusted.

    raw (6,): the last reading, as the sensor sees it. lag: by how much smoothing makes a force come later [s].
    """

    def __init__(
        self,
        frames: Sequence[tuple[str, Array]],
        load: Load | None = None,
        cutoff_hz: float = 30.0,
        sign: float = 1.0,
    ) -> None:
        """frames: names that readings may carry, with T_tool_frame (4, 4) of each. load: what is known of the tool.

        sign: −1 for a sensor that says what the tool does to the environment.
        """
        self._adjoints = {name: (np.asarray(T)[:3, :3], np.asarray(T)[:3, 3]) for name, T in frames}
        self.load = load or Load()
        self._filter, self._sign = LowPass(cutoff_hz), sign
        self.lag = self._filter.lag
        self.stamp = -math.inf
        self._frame = ""
        self.raw, self.force = np.zeros(6), np.zeros(6)

    def receive(self, frame: str, wrench: ArrayLike, stamp: float, now: float, stale: float) -> None:
        """Take a reading (6,) in a frame, made at ``stamp`` and heard ``now`` [s]. Raises BadCommand for a bad one."""
        w = np.array(wrench, dtype=float)
        if frame not in self._adjoints:
            known = ", ".join(self._adjoints)
            raise BadCommand(f"wrench in frame '{frame}'", f"it must be in one of {known}", "set the sensor's frame_id")
        if w.shape != (6,) or not np.isfinite(w).all():
            raise BadCommand("wrench", "is not finite", "check the sensor")
        if not (np.abs(w[:3]).max() <= _LARGEST[0] and np.abs(w[3:]).max() <= _LARGEST[1]):
            raise BadCommand(
                "wrench",
                f"{np.abs(w[:3]).max():.4g} N, {np.abs(w[3:]).max():.4g} N m is not a plausible reading",
                "check the sensor and its unit",
            )
        if not abs(now - stamp) <= stale:
            raise BadCommand("wrench", f"is {abs(now - stamp):.3g} s off, {stale:g} s is the limit", "check its clock")
        if stamp < self.stamp:
            raise BadCommand("wrench", "came after a newer one", "use one publisher that sends in order")
        if frame != self._frame:
            self._filter.reset()
        self._frame, self.stamp, self.raw = frame, stamp, self._sign * w

    def rotation(self, T_base_tool: Array) -> Array:
        """R_base_sensor (3, 3)."""
        return T_base_tool[:3, :3] @ self._adjoints[self._frame][0]

    def on_tool(self, T_base_tool: Array, down: Array = DOWN) -> Array:
        """F (6,): what the environment exerts on the tool, at its origin, in its axes, smoothed."""
        R, p = self._adjoints[self._frame]
        w = self._filter.take(self.raw - self.load.wrench(self.rotation(T_base_tool), down), self.stamp)
        f = R @ w[:3]
        m = R @ w[3:]
        self.force = np.array(
            [*f, m[0] + p[1] * f[2] - p[2] * f[1], m[1] + p[2] * f[0] - p[0] * f[2], m[2] + p[0] * f[1] - p[1] * f[0]]
        )
        return self.force

    def reset_past(self) -> None:
        """Smooth from now on only: what was known of the tool before has changed."""
        self._filter.reset()

    def reset(self) -> None:
        """Start over, at whatever time it is now; what is known of the tool stays."""
        self.stamp, self._frame = -math.inf, ""
        self._filter.reset()
