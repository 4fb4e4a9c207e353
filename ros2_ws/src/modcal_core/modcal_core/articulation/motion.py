"""A joint while it is being fitted: what every type of joint must answer, and what all of them share.

A motion has minimal parameters, and a latent configuration for each sample. What was seen at configuration a is
*unwound* to configuration 0 and compared with the start there, so that play and bias of handle and tracker look alike
wherever on the path they occur.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from modcal_core.articulation.joints import PlacedJoint
from modcal_core.articulation.track import Track
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import HAT, Array

EYE = np.eye(3)
_SINE_AND_TRACE = np.concatenate([0.5 * HAT, EYE.reshape(1, 9)]).T


class Motion(ABC):
    """moves: whether it has a configuration. turns: whether that is an angle. uniform:
    whether the direction along its path is the same for all samples, once unwound. flat: whether its path is a line or
    a circle.

    R: rotation (3, 3) of the start or of the grasp, None where only positions were seen.
    """

    R: Array | None
    moves: ClassVar[bool] = True
    turns: ClassVar[bool] = False
    uniform: ClassVar[bool] = False
    flat: ClassVar[bool] = False

    @property
    @abstractmethod
    def kind(self) -> str:
        """Name of the joint type."""

    @property
    @abstractmethod
    def size(self) -> int:
        """How many parameters it has."""

    @property
    @abstractmethod
    def start_turn(self) -> int:
        """Which parameter is the first of the three by which the start is turned; with rotations only."""

    @abstractmethod
    def moved(self, z: Array) -> Motion:
        """Motion with its parameters changed by z (size,), limited to plausible values."""

    @abstractmethod
    def configurations(self, track: Track, sigma: tuple[float, float] = (1.0, 1.0)) -> Array:
        """Latent configurations (n,) that are most likely where noise is sigma, (m, rad)."""

    @abstractmethod
    def expanded(self, track: Track, a: Array, derivatives: bool = True) -> tuple[Array, Array]:
        """Residuals and, beside them, their derivatives by the parameters (n, m, 1 + size); derivatives by a (n, m)."""

    @abstractmethod
    def prior_terms(self) -> tuple[float, Array, Array]:
        """Half the squared distance from the prior, its gradient (size,) and its curvature (size,), diagonal."""

    @abstractmethod
    def log_prior(self) -> float:
        """What the prior's density has beside its exponent, in the coordinates of the motion."""

    @abstractmethod
    def joint(self, a: float = 0.0) -> PlacedJoint:
        """The joint, with its configuration 0 where this motion has a."""

    @abstractmethod
    def covariance(self, parameters: Array) -> dict[str, Array]:
        """Covariances of the joint's named quantities, from the covariance of the parameters (size, size)."""

    def zero(self, a: Array) -> float:
        """Which configuration is called 0, of those of all samples (n,)."""
        return 0.0

    def counted(self, a: Array, sound: np.ndarray) -> Array:
        """Configurations (n,) counted beyond a full turn for a joint that turns on. sound: samples that are not
        outliers.
        """
        return a

    def sound(self) -> bool:
        """Whether all parameters are finite."""
        return True

    def rarity(self) -> float:
        """What to add to a guess's cost, so that ties go to what is built more often."""
        return 0.0

    def residuals(self, track: Track, a: Array) -> Array:
        """Residuals (n, 3) [m], or (n, 6) [m, rad] with rotations, unwound, at configurations a (n,)."""
        return self.linearise(track, a, derivatives=False)[0]

    def linearise(self, track: Track, a: Array, derivatives: bool = True) -> tuple[Array, Array, Array]:
        """Residuals (n, m), their derivatives by a (n, m) and by the parameters (n, m, size); m is 3 or 6."""
        both, by_a = self.expanded(track, a, derivatives)
        return both[:, :, 0], by_a, both[:, :, 1:]


def quick_log(R: Array) -> tuple[Array, Array, Array]:
    """Rotation vectors (n, 3) of rotations (n, 3, 3); sines and cosines (n,) of their angles.

    By the sine where no angle is large, which is quicker than by quaternions.
    """
    found = R.reshape(-1, 9) @ _SINE_AND_TRACE
    v, cosine = found[:, :3], 0.5 * (found[:, 3] - 1.0)
    sine = np.sqrt((v * v).sum(axis=1))
    if cosine.min() < -0.8:
        return so3.log(R), sine, cosine
    return v * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-300))[:, None], sine, cosine


def log_and_jacobian(R: Array) -> tuple[Array, Array]:
    """Rotation vectors φ (n, 3) of rotations (n, 3, 3), and so3.left_jacobian_inverse(−φ) (n, 3, 3).

    I + ½ [φ] + k [φ]² with k = (1 − ½ θ cot ½θ) / θ², and cot ½θ = (1 + cos θ) / sin θ is at hand.
    """
    phi, sine, cosine = quick_log(R)
    square = (phi * phi).sum(axis=1)
    if sine.min() < 1e-3:  # the quotient would lose digits
        return phi, so3.left_jacobian_inverse(-phi)
    k = (1.0 - 0.5 * np.sqrt(square) * (1.0 + cosine) / sine) / square
    W = (phi @ HAT).reshape(-1, 3, 3)
    return phi, 0.5 * W + k[:, None, None] * (W @ W) + EYE


def scaled(size: float, by: float, limits: tuple[float, float]) -> float:
    """A size times exp(by), by a factor of e at most, and within limits."""
    return min(max(size * math.exp(min(max(float(by), -1.0), 1.0)), limits[0]), limits[1])
