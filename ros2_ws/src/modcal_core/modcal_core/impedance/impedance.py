"""The impedance law M ẍ + B ẋ + K x = F: how far the tool yields, from where it is expected, under a force.

x = (way, rotation vector) is where the commanded tool is, seen from the expected one, ``T_cmd = T_expected · (exp(x_ω),
x_v)``; F is what the environment exerts on the tool. Both are seen from the tool, so gains stay with it as it turns.
One step of backward Euler,

    (M + h B + h² K) v⁺ = M v + h (F − K x),        x⁺ = x + h v⁺,

is stable for any step h and any gains that are not negative: with F = 0 the energy ½ vᵀM v + ½ xᵀK x can only fall.
What is integrated is a motion relative to the expected one, so that the expected motion itself meets no damping.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array, pose_error, relative, tool_from

_ALIGNED = math.cos(math.radians(5.0))  # of the way and the gains' axis: within it, 0.4 % of a force changes sides


def axes_along(direction: ArrayLike) -> Array:
    """A rotation (3, 3) whose first column is a direction (3,). Raises BadCommand for one without length."""
    x = np.asarray(direction, dtype=float)
    length = float(np.linalg.norm(x))
    if not (math.isfinite(length) and length > 1e-6):
        raise BadCommand(f"direction {x.tolist()}", "has no length", "give x y z of the pull")
    x = x / length
    y = np.eye(3)[int(np.argmin(np.abs(x)))]
    y = y - (y @ x) * x
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def _pair(what: str, value: ArrayLike, least: float) -> Array:
    out = np.array(value, dtype=float)
    if out.shape == (2,):  # one for the way, one for turning
        out = np.repeat(out, 3)
    if out.shape != (6,) or not np.isfinite(out).all() or (out < least).any():
        raise BadCommand(
            f"{what} {np.asarray(value).tolist()}", f"needs 2 or 6 numbers, at least {least:g}", "correct it"
        )
    out.flags.writeable = False
    return out


@dataclass(frozen=True)
class Gains:
    """mass [kg, kg m²], damping [N s/m, N m s/rad], stiffness [N/m, N m/rad], each (6,), or (2,): way and turning.

    Along and about the axes of ``task`` (3, 3), a rotation whose columns are seen from the tool: the first is the way
    something opens. Raises BadCommand for gains that are not finite, for masses and damping that are not positive and
    stiffness below zero.

    Against a stiff position servo that follows with a lag τ, what is damped is the servo's stiffness acting a lag late:
    damping below stiffness_of_servo · τ limit-cycles, whatever M and K say (hence defaults far above critical).
    """

    mass: Array
    damping: Array
    stiffness: Array
    task: Array

    @classmethod
    def of(
        cls,
        mass: ArrayLike = (10.0, 1.0),
        damping: ArrayLike = (1000.0, 80.0),
        stiffness: ArrayLike = (300.0, 20.0),
        task: ArrayLike | None = None,
    ) -> Gains:
        """Gains from numbers for way and turning, or for each of the six."""
        R = np.eye(3) if task is None else np.array(task, dtype=float)
        if R.shape != (3, 3) or not np.isfinite(R).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-6:
            raise BadCommand("axes of the gains", "are not a rotation", "give three orthogonal unit axes")
        R.flags.writeable = False
        least = 1e-3
        return cls(_pair("mass", mass, least), _pair("damping", damping, least), _pair("stiffness", stiffness, 0.0), R)

    def matrices(self) -> Array:
        """M, B and K in the axes of the tool, (3, 6, 6)."""
        out = np.zeros((3, 6, 6))
        for A, values in zip(out, (self.mass, self.damping, self.stiffness), strict=True):
            A[:3, :3] = (self.task * values[:3]) @ self.task.T
            A[3:, 3:] = (self.task * values[3:]) @ self.task.T
        return out


class Impedance:
    """Position x (6,) and speed v (6,) of the compliant motion, stepped in time."""

    def __init__(self, gains: Gains, blend: float = 0.5) -> None:
        """At rest where it is expected. blend: how long other gains take to come in [s]."""
        self.x, self.v = np.zeros(6), np.zeros(6)
        self.gains, self._blend = gains, blend
        self._now = self._from = self._to = gains.matrices()
        self._share = 1.0

    def change(self, gains: Gains) -> None:
        """Go over to other gains gradually: neither position nor speed jumps, nor the force that they stand for."""
        self.gains = gains
        self._from, self._to, self._share = self._now, gains.matrices(), 0.0

    def align(self, direction: Array) -> None:
        """Turn the gains until their first axis lies along a direction (3,), seen from the tool; gradually as well.

        A hand in a ball grasp does not turn with a door. It would else become stiff across the way and soft along it,
        and pull more and more beside the way.
        """
        if direction @ self.gains.task[:, 0] < _ALIGNED:
            self.change(replace(self.gains, task=axes_along(direction)))

    def step(self, F: Array, h: float, caution: float = 1.0) -> Array:
        """The new x (6,) after h seconds under a force and moment F (6,) on the tool [N, N m], seen from the tool.

        caution: how many times the damping is taken, where forces arrive late.
        """
        if self._share < 1.0:
            self._share = min(1.0, self._share + h / self._blend) if self._blend > 0.0 else 1.0
            # what lies between two matrices of gains is one too
            self._now = self._from + self._share * (self._to - self._from)
        M, B, K = self._now
        B = caution * B
        self.v = np.linalg.solve(M + h * B + h * h * K, M @ self.v + h * (F - K @ self.x))
        self.x = self.x + h * self.v
        return self.x

    def halt(self) -> None:
        """Stand still where it is."""
        self.v = np.zeros(6)

    def command(self, expected: Array) -> Array:
        """The commanded pose (4, 4) about an expected one (4, 4)."""
        return tool_from(expected, self.x)

    def expect(self, before: Array, expected: Array) -> None:
        """From now on another pose (4, 4) is expected than before, while the commanded one stays where it is.

        So a new model of what is pulled moves nothing at once: what it changes becomes x, and leaves as K and B say.
        """
        self.x = pose_error(expected, tool_from(before, self.x))
        self.v = np.concatenate([relative(expected, before, v) for v in (self.v[:3], self.v[3:])])
