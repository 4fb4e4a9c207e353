"""What stands between a computed command and an arm: limits, speeds, and no jump when the calibration changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array
from modcal_core.robots import Mechanism

_MIN_SECONDS = 0.1  # even the shortest way to a goal gets this long
_STREAM_ENDS = 0.5  # s without a setpoint, and nothing is streamed any more


@dataclass(frozen=True)
class Bounds:
    """What the arm may be told. lower, upper: [rad or m], (n,). speed: [rad/s or m/s], (n,)."""

    names: tuple[str, ...]
    lower: Array
    upper: Array
    speed: Array

    @classmethod
    def of(cls, chains: Sequence[Mechanism], turning: float, sliding: float) -> Bounds:
        """The limits that all descriptions of one arm allow; speeds of its turning and its sliding joints."""
        first = chains[0]
        return cls(
            first.names,
            np.max([chain.lower for chain in chains], axis=0),
            np.min([chain.upper for chain in chains], axis=0),
            np.where(first.revolute, turning, sliding),
        )

    def require_within(self, q: Array) -> None:
        """Raises BadCommand unless these positions (n,) are finite and within the limits."""
        if not np.isfinite(q).all():
            raise BadCommand(
                "joint command", "is not finite", "this is a fault of modcal: report it with the calibration"
            )
        out = (q < self.lower) | (q > self.upper)
        if out.any():
            j = int(np.argmax(out))
            raise BadCommand(
                f"command {q[j]:.4f} of joint {self.names[j]}",
                f"its limits are {self.lower[j]:.4f} to {self.upper[j]:.4f}",
                "ask for a pose that the arm reaches within its limits",
            )

    def require_step(self, q: Array, now: Array, seconds: float) -> None:
        """Raises BadCommand unless the joints can get from ``now`` to q (n,) in this time [s]."""
        share = np.abs(q - now) / (self.speed * seconds)
        j = int(np.argmax(share))
        if not share[j] <= 1.0:
            raise BadCommand(
                f"step of joint {self.names[j]}",
                f"{abs(q[j] - now[j]):.4f} in {seconds:g} s is faster than {self.speed[j]:g} per second",
                "move the desired pose in smaller steps, or give more time (horizon_s)",
            )

    def seconds(self, q: Array, now: Array) -> float:
        """Time from ``now`` to q (n,) at full speed [s]."""
        return max(float((np.abs(q - now) / self.speed).max()), _MIN_SECONDS)


class SetpointStream:
    """The setpoints of one stream, kept free of jumps when the calibration behind them changes."""

    def __init__(self) -> None:
        self._last: tuple[float, Array] | None = None
        self._offset: tuple[float, float, Array] | None = None

    def running(self, now: float) -> bool:
        """Whether a setpoint was given lately, at time ``now`` [s]."""
        return self._last is not None and 0.0 <= now - self._last[0] < _STREAM_ENDS

    def take_over(self, q: Array, now: float, most: float, blend: float) -> None:
        """From now on come commands that begin at q (n,) instead of the last setpoint.

        The difference is faded out over ``blend`` [s].
        Raises BadCommand, and changes nothing, if any joint would have to make up for more than ``most`` [rad or m].
        """
        if not self.running(now) or self._last is None:
            self._offset = None
            return
        offset = self._last[1] - q
        largest = float(np.abs(offset).max())
        if not largest <= most:
            raise BadCommand(
                "new calibration in the middle of a stream",
                f"it moves a joint by {largest:.4f}, {most:g} is allowed",
                "it is applied when the stream pauses",
            )
        self._offset = (now, blend, offset)

    def setpoint(self, q: Array, now: float) -> Array:
        """The setpoint (n,) for a command q (n,) at time ``now`` [s]; :meth:`given` makes it the last one."""
        if not self.running(now):
            self._offset = None
        if self._offset is None:
            return q
        since, blend, offset = self._offset
        share = (now - since) / blend if blend > 0.0 else 1.0
        if not 0.0 <= share < 1.0:
            self._offset = None
            return q
        return q + offset * (1.0 - share**2 * (3.0 - 2.0 * share))

    def given(self, q: Array, now: float) -> None:
        """Note that this setpoint (n,) was sent."""
        self._last = (now, q)

    def reset(self) -> None:
        """Start over."""
        self._last = self._offset = None
