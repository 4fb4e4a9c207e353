"""A chain as a row of elementary motions, each a shift along or a turn about one axis of the frame it stands in.

The pose of a point is ``E_1 E_2 … E_m``, read from the measuring frame to the point. A motion is a constant transform,
a joint's, or a parameter's: zero for the nominal arm. In this form any number of arms, each with errors of its own, is
one sweep over vectors, and a derivative is the axis itself: with R the frame in front of a motion, o its origin and p
the point,

    ∂p/∂g = R e  (shift along e)        ∂p/∂g = (R e) × (p − o),  ∂rot/∂g = R e  (turn about e)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array

_BLOCK = 16_000  # arms times postures that are moved at once; more does not fit a processor's cache


@dataclass(frozen=True)
class ElementaryMotion:
    """direction: 0 … 5, shift along x y z or turn about x y z. joint, parameter: which of them makes it, else −1."""

    direction: int
    joint: int = -1
    parameter: int = -1


@dataclass(frozen=True)
class ElementaryChain:
    """A point at the end of a row of motions.

    steps: constants (4, 4) [m] and motions, from the measuring frame to the point. parameters: how many there are.
    """

    steps: tuple[Array | ElementaryMotion, ...]
    parameters: int = field(default=0)

    def positions(self, q: ArrayLike, errors: ArrayLike) -> Array:
        """The point [m] in the measuring frame, (S, N, 3), of S arms with errors (S, P) in postures q (N, n)."""
        q, x = np.atleast_2d(np.asarray(q, dtype=float)), np.atleast_2d(np.asarray(errors, dtype=float))
        assert x.shape[1] == self.parameters, x.shape
        rows = max(1, _BLOCK // max(len(q), 1))
        return np.concatenate([self._positions(q, x[i : i + rows]) for i in range(0, max(len(x), 1), rows)])

    def _positions(self, q: Array, x: Array) -> Array:
        p = np.zeros((3, len(x), len(q)))
        for step in reversed(self.steps):
            if not isinstance(step, ElementaryMotion):
                p = (step[:3, :3] @ p.reshape(3, -1)).reshape(p.shape) + step[:3, 3, None, None]
                continue
            size = q[None, :, step.joint] if step.joint >= 0 else x[:, step.parameter, None]
            if step.direction < 3:
                p[step.direction] += size
                continue
            b, c = (step.direction + 1) % 3, (step.direction + 2) % 3
            cos, sin = np.cos(size), np.sin(size)
            p[b], p[c] = cos * p[b] - sin * p[c], sin * p[b] + cos * p[c]
        return np.moveaxis(p, 0, -1)

    def jacobian(self, q: ArrayLike) -> Array:
        """Derivatives of the nominal arm's point and orientation, (N, 6, P) [m and rad per m or rad], at q (N, n)."""
        q = np.atleast_2d(np.asarray(q, dtype=float))
        N = len(q)
        T = np.tile(np.eye(4), (N, 1, 1))
        axes, origins, kinds = np.zeros((self.parameters, N, 3)), np.zeros((self.parameters, N, 3)), {}
        for step in self.steps:
            if not isinstance(step, ElementaryMotion):
                T = T @ step
            elif step.joint >= 0:
                xi = np.zeros((N, 6))
                xi[:, step.direction] = q[:, step.joint]
                T = T @ se3.exp(xi)
            else:
                axes[step.parameter] = T[:, :3, step.direction % 3]
                origins[step.parameter] = T[:, :3, 3]
                kinds[step.parameter] = step.direction >= 3
        turns = np.array([kinds[k] for k in range(self.parameters)], dtype=bool)
        J = np.zeros((N, 6, self.parameters))
        arm = np.cross(axes[turns], T[:, :3, 3] - origins[turns])
        J[:, :3, turns] = arm.transpose(1, 2, 0)
        J[:, 3:, turns] = axes[turns].transpose(1, 2, 0)
        J[:, :3, ~turns] = axes[~turns].transpose(1, 2, 0)
        return J


def elementary(steps: Sequence[Array | ElementaryMotion]) -> ElementaryChain:
    """The chain of these steps; its parameters are numbered 0, 1, … without a gap."""
    numbers = sorted(s.parameter for s in steps if isinstance(s, ElementaryMotion) and s.parameter >= 0)
    assert numbers == list(range(len(numbers))), numbers
    return ElementaryChain(tuple(steps), len(numbers))
