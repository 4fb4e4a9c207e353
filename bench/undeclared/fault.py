"""A fault planted in an arm: what it is drawn from, what it does to the truth, and what would name it rightly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from arm import TURN, Arm, Array

ANY = "*"


@dataclass(frozen=True)
class Stations:
    """Postures q (m, n) [rad], times t (m,) since the session began [s], way each joint came (m, n): −1 or 1."""

    q: Array
    t: Array
    way: Array


class Deviation:
    """How the arm is when its joints are said to be at the stations' q. Faults add to it one after the other.

    x: coordinates (m, n, 4) before springs; linear, cubic: stiffness (n, 4); tool, tracker: twists (m, 6) that move
    them, linear part first, in the tool's frame and along the world's axes; scale: of the readings; payload: mass at
    the flange [kg].
    """

    def __init__(self, arm: Arm, stations: Stations) -> None:
        self.x = arm.coordinates(stations.q)
        self.linear, self.cubic = np.full((arm.n, 4), np.inf), np.zeros((arm.n, 4))
        self.tool, self.tracker = np.zeros((len(stations.t), 6)), np.zeros((len(stations.t), 6))
        self.scale, self.payload = 1.0, 0.0


Bend = Callable[[Arm, Stations, Deviation], None]


def _nothing(arm: Arm, stations: Stations, deviation: Deviation) -> None:
    """A fault of time or of readings, not of the arm."""


@dataclass(frozen=True)
class Fault:
    """One planted effect: the families, places and drivers that name it rightly, and what it does.

    latency: of the tracker's stamps [s]; lag: of each joint's reported positions [s]; outliers: readings that are off;
    sensor: a frame and its temperature over time; silent: cannot be identified, so naming anything is wrong.
    """

    family: tuple[str, ...]
    place: tuple[str, ...]
    driver: tuple[str, ...]
    size: str
    bend: Bend = _nothing
    latency: float = 0.0
    lag: dict[int, float] = field(default_factory=dict)
    outliers: int = 0
    sensor: tuple[str, Callable[[Array], Array]] | None = None
    silent: bool = False


@dataclass(frozen=True)
class Draw:
    """What a fault is drawn from: an arm, random postures of it, how long the first recording takes [s]."""

    rng: np.random.Generator
    arm: Arm
    q: Array
    duration: float

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def sign(self) -> float:
        return float(self.rng.choice([-1.0, 1.0]))

    def joint(self, among: Array | None = None) -> int:
        return int(self.rng.choice(np.arange(self.arm.n) if among is None else among))

    def torques(self) -> Array:
        """Gravity's torque (m, n, 4) over the random postures."""
        return self.arm.holding(self.arm.coordinates(self.q))

    def scaled(self, low: float, high: float, values: Array) -> float:
        """The factor that brings values to an RMS between low and high."""
        return self.uniform(low, high) / float(np.sqrt(np.mean(values**2)))

    def own(self, i: int, family: tuple[str, ...], size: str, error: Callable[[Array], Array]) -> Fault:
        """A joint that is off by a function of its own position."""
        name = self.arm.names[i]

        def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
            deviation.x[:, i, TURN] += error(stations.q[:, i])

        return Fault(family, (name,), (f"position:{name}",), size, bend)
