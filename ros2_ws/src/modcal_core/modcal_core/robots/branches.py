"""Bodies that hang on an arm beside its chain, such as another arm on the same torso: where joints move them to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class CarryingJoint:
    """One joint on the way to a body. origin: (4, 4) [m]. axis: unit (3,); zero of a fixed one. turns: or slides.

    joint: whose position moves it, times a factor, plus an offset: of a joint that mimics, the one it mimics.
    """

    origin: Array
    axis: Array
    turns: bool
    joint: str
    factor: float = 1.0
    offset: float = 0.0

    def motion(self, position: Array) -> Array:
        """Its pose in the link before it, (N, 4, 4), where the joint that leads is at these positions (N,)."""
        along = (self.factor * np.asarray(position) + self.offset)[:, None] * self.axis
        zero = np.zeros_like(along)
        return np.asarray(self.origin @ se3.exp(np.concatenate([zero, along] if self.turns else [along, zero], axis=1)))


@dataclass(frozen=True)
class Hanging:
    """One body. carrier: number of the chain's joint on whose link it hangs. mass [kg], com (3,) [m]: in its link."""

    carrier: int
    steps: tuple[CarryingJoint, ...]
    mass: float
    com: Array

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that move it."""
        return tuple(dict.fromkeys(step.joint for step in self.steps if step.joint))

    def centre(self, positions: Mapping[str, Array], count: int) -> Array:
        """Its centre of mass seen from the carrier, (N, 3) [m]; a joint whose positions (N,) are unknown is at zero."""
        T = np.tile(np.eye(4), (count, 1, 1))
        for step in self.steps:
            T = T @ step.motion(positions.get(step.joint, np.zeros(count)))
        return np.asarray(T[:, :3, :3] @ self.com + T[:, :3, 3])


def moved_centres(bodies: Sequence[Hanging], mass: Array, positions: Mapping[str, Array], count: int) -> Array | None:
    """How far the lumped centres of mass of the chain's bodies are from where they are with all other joints at zero.

    (n, N, 3) [m], in the frame behind each joint; None where none moves. mass: of the lumped bodies, (n,) [kg].
    """
    moving = [body for body in bodies if any(name in positions for name in body.joints)]
    if not moving:
        return None
    out = np.zeros((len(mass), count, 3))
    for body in moving:
        out[body.carrier] += body.mass * (body.centre(positions, count) - body.centre({}, 1))
    return out / np.maximum(mass, 1e-12)[:, None, None]
