"""What all kinds of joint must explain: nodes of a track, how they are off together, and the sizes that are tried."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dtrtri

from modcal_core.articulation import furniture
from modcal_core.articulation.track import Track
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array

_MIN_NOISE = (1e-5, 1e-4)  # m, rad: of a node, so that exact data can be fitted
_JITTER = 9.0  # three deviations, squared: what noise alone makes of the farthest of some nodes
LOG_2PI = math.log(2.0 * math.pi)  # of a normal density
_STEPS = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])  # of the prior's standard deviation
# What furniture.py says, on a grid: values, and their log-probabilities
PLAYS = np.exp(furniture.PLAY[0] + furniture.PLAY[1] * _STEPS)
LOG_PLAYS = -0.5 * _STEPS**2 - float(np.logaddexp.reduce(-0.5 * _STEPS**2))
_LOOSE_STEPS = np.array([-0.5, 0.5])
_LARGER = np.array([-1.0, 0.0, 1.0])
DISTORTIONS = np.exp(furniture.DISTORTED * _LARGER)  # times what is usual
LOG_DISTORTIONS = -0.5 * _LARGER**2 - float(np.logaddexp.reduce(-0.5 * _LARGER**2))
_FOLLOWS = np.exp(furniture.SWAY[0] + furniture.SWAY[1] * _STEPS)
SWAYS = np.concatenate([
    _FOLLOWS, np.exp(furniture.LOOSE[0] + furniture.LOOSE[1] * _LOOSE_STEPS), _FOLLOWS
])  # fmt: skip
LOG_SWAYS = np.concatenate([
    LOG_PLAYS + np.log1p(-furniture.LOOSE[2] - furniture.HELD), np.full(2, np.log(0.5 * furniture.LOOSE[2])),
    LOG_PLAYS + np.log(furniture.HELD)
])  # fmt: skip
LOOSE = np.arange(len(SWAYS)) >= len(_STEPS)  # rotations say nothing of the object ...
HELD = np.arange(len(SWAYS)) >= len(_STEPS) + len(_LOOSE_STEPS)  # ... since the hand keeps them as they are
FIRST = 2  # where to begin when nothing is known
FIRST_OF_HELD = len(SWAYS) - len(_STEPS)


@dataclass(frozen=True)
class NodeScene:
    """The nodes that all kinds must explain, and covariances (k, k) of what they do not share with the ideal path.

    kernel: of a play of 1. position [m²], rotation [rad²]: noise of nodes, and distortion of what measures. moved: how
    far apart nodes lie [m], beyond what noise does.
    """

    track: Track
    kernel: Array
    position: Array
    rotation: Array
    moved: float
    _roots: dict[float, tuple[Array, float]] = field(default_factory=dict, repr=False, compare=False)

    def by_play(self, play: float) -> tuple[Array, float]:
        """What whitens positions (k, k), and half the log determinant of their covariance with the Gaussian's 2π."""
        return self._root(play, self.position)

    def by_sway(self, sway: float) -> tuple[Array, float]:
        """The same of rotations."""
        return self._root(-sway, self.rotation)

    def _root(self, key: float, rest: Array) -> tuple[Array, float]:
        if key not in self._roots:
            self._roots[key] = whitener(key**2 * self.kernel + rest)
        return self._roots[key]

    def prepare(self, plays: list[float], sway: float) -> None:
        """Have at hand what is asked for these."""
        for play in plays:
            self.by_play(play)
        if self.track.oriented:
            self.by_sway(sway)
            _ = self.turned

    @cached_property
    def turned(self) -> Array:
        """Rotations of nodes from their mean (3, k) [rad]."""
        assert self.track.rotations is not None
        return so3.log(so3.mean(self.track.rotations).T @ self.track.rotations).T

    @classmethod
    def of(
        cls, track: Track, apart: Array, counts: Array, sigma: tuple[float, float], distorted: float = 1.0
    ) -> NodeScene:
        """Nodes with counts (k,), distances (k, k) [m], noise of one sample sigma [m, rad].

        distorted: how many times the usual distortion is taken.
        """
        smooth = np.exp((-0.5 / furniture.DISTORTION_REACH**2) * apart * apart)
        both, per = [], 1.0 / counts
        for s, least, d in zip(sigma, _MIN_NOISE, furniture.DISTORTION, strict=True):
            both.append((distorted * d) ** 2 * smooth)
            both[-1].ravel()[:: len(counts) + 1] += s**2 * per + least**2
        jitter = _JITTER * float(per.sum()) / len(per) * (sigma[0] ** 2 + (0.1 * sigma[1]) ** 2)
        moved = math.sqrt(max(float(apart.max()) ** 2 - 2.0 * jitter, 1e-8))
        return cls(track, np.exp((-1.0 / furniture.REACH) * apart), both[0], both[1], moved)


def whitener(C: NDArray[Any]) -> tuple[Array, float]:
    """The inverse of a covariance's Cholesky factor (k, k), and half its log determinant with the Gaussian's 2π."""
    L, failed = dpotrf(C, lower=1)
    assert not failed, "no covariance"
    return dtrtri(L, lower=1)[0], float(np.log(L.diagonal()).sum()) + 0.5 * len(L) * LOG_2PI
