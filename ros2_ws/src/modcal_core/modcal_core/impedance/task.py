"""What an operation is asked to do, what it is told at every tick, and what it may answer."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from modcal_core.articulation import JointModel
from modcal_core.geometry import Array
from modcal_core.impedance.impedance import Gains, axes_along
from modcal_core.impedance.speed_governor import GovernorSettings
from modcal_core.impedance.wrench import DOWN

Mode = Literal["expected", "admittance"]


class ObjectModel(Protocol):
    """The estimate of the object: the state of an articulation Tracker, or the like."""

    @property
    def model(self) -> JointModel | None:
        """How the tool moves, in the base."""

    @property
    def trusted(self) -> bool:
        """Whether it has predicted."""

    @property
    def event(self) -> str | None:
        """What has happened to it."""

    @property
    def late(self) -> bool:
        """Whether the next status is overdue, so that the hand is not led on."""

    @property
    def silent(self) -> bool:
        """Whether no recent status of it was received."""


@dataclass(frozen=True)
class JointPositions:
    """Positions q (n,) of the chain's joints, in its order, and when they were so [s].

    effort (n,): what the joints gave then, as reported [N m; N]; None where that is not known of all.
    """

    q: Array
    stamp: float
    effort: Array | None = None


@dataclass(frozen=True)
class Wait:
    """Nothing may be sent now. why: reason as text."""

    why: str


@dataclass(frozen=True)
class Stop:
    """The end. done: whether the goal was reached. why: reason as text. opened: how far [rad or m]."""

    done: bool
    why: str
    opened: float = 0.0


@dataclass(frozen=True)
class ImpedanceTask:
    """What to do and how gently.

    direction (3,): of the pull, seen from the tool. goal_rad, goal_m: how far something that turns, or slides, is to
    be opened. mode: ``admittance`` where the stack that follows is stiff, ``expected`` where it is compliant itself:
    never both. exploration_speed, speed: of the tool while the way is unknown, and once it is known [m/s].
    max_exploration: longest way that is gone unknown [m]. mass, damping, stiffness: of the impedance, each along the
    pull, across it, and turning.
    stack: stiffness that is asked of a stiff stack, way and turning. blend: how long new gains take to come in [s].
    servo_lag: how far ahead of the arm a setpoint is that moves steadily [s], and so how late the arm stops.
    gravity (3,): gravity in the base [m/s²]. input_timeout_s: longest silence of an input before it is the end [s].
    arm_stiffness: of a stiff stack in its stiffest posture, by which a force that is not felt is judged [N/m].
    """

    direction: Array = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))
    goal_rad: float = math.radians(60.0)
    goal_m: float = 0.3
    mode: Mode = "admittance"
    exploration_speed: float = 0.03
    speed: float = 0.06
    max_exploration: float = 0.25
    mass: tuple[float, float, float] = (10.0, 10.0, 1.0)
    damping: tuple[float, float, float] = (1000.0, 1000.0, 80.0)
    stiffness: tuple[float, float, float] = (1000.0, 300.0, 20.0)
    stack: tuple[float, float] = (3000.0, 200.0)
    blend: float = 0.5
    tare_s: float = 0.5
    servo_lag: float = 0.03
    gravity: Array = field(default_factory=lambda: DOWN.copy())
    governor: GovernorSettings = field(default_factory=GovernorSettings)
    input_timeout_s: float = 1.0
    arm_stiffness: float = 100e3

    def gains(self, along: Array) -> Gains:
        """The impedance's gains with their first axis along a direction (3,), seen from the tool."""

        def six(values: tuple[float, float, float]) -> Array:
            return np.array([values[0], values[1], values[1], values[2], values[2], values[2]])

        return Gains.of(six(self.mass), six(self.damping), six(self.stiffness), axes_along(along))
