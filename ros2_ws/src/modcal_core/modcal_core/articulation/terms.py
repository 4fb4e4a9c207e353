"""How well a motion explains the nodes of a scene: squares of what is left, and what of them the parameters can lower.

Where the direction along the path is the same for all nodes, as of every motion about one axis, what shares noise is
whitened together; :mod:`.varying_terms` has the others.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg.lapack import dposv

from modcal_core.articulation.models.axis import AxisMotion
from modcal_core.articulation.motion import Motion
from modcal_core.articulation.scene import HELD, LOG_2PI, SWAYS, NodeScene, whitener
from modcal_core.geometry.so3 import Array

_HOLDS = 0.3  # the longest step of any parameter; the expansion holds no farther


@dataclass(frozen=True)
class Terms(ABC):
    """Residuals and derivatives of all nodes. oriented: whether rotations are among them."""

    motion: Motion
    oriented: bool

    @classmethod
    @abstractmethod
    def of(cls, scene: NodeScene, motion: Motion, play: float) -> Self:
        """Terms of all nodes for a play [m]."""

    @abstractmethod
    def system(self, scene: NodeScene, play: float, column: int) -> tuple[float, Array, Array, float]:
        """(squares, gradient, curvature, log determinant), with the prior in the first three."""

    def with_prior(self, total: Array, log_det: float) -> tuple[float, Array, Array, float]:
        """What ``system`` returns, of squares and products of columns (1 + size, 1 + size)."""
        cost, gradient, curvature = self.motion.prior_terms()
        total.ravel()[len(total) + 1 :: len(total) + 1] += curvature
        return 0.5 * float(total[0, 0]) + cost, total[0, 1:] + gradient, total[1:, 1:], log_det

    def cost(self, scene: NodeScene, play: float, column: int) -> float:
        """Objective that a step must lower."""
        squares, _, _, log_det = self.system(scene, play, column)
        return squares + log_det

    def step(self, scene: NodeScene, play: float, column: int) -> tuple[Array, float]:
        """Gauss–Newton step, and what it promises."""
        _, g, H, _ = self.system(scene, play, column)
        step = _solved(_lifted(H, 1e-10), g)[0]
        return step, float(-0.5 * g @ step)

    def weighed(self, scene: NodeScene, play: float, column: int) -> tuple[float, Array]:
        """Log evidence at one sway, with the step that is left taken on the quadratic; and that step."""
        squares, g, H, log_det = self.system(scene, play, column)
        step, half = _solved(_lifted(H, 1e-12), g)
        held = believed(step)
        gain = -0.5 * float(g @ step) * held * (2.0 - held)
        volume = 0.5 * len(g) * LOG_2PI - half
        return gain - squares - log_det + volume + self.motion.log_prior(), step

    def evidence(self, scene: NodeScene, play: float) -> Array:
        """Log evidence for each sway."""
        columns = range(len(SWAYS)) if self.oriented else range(1)
        return np.array([self.weighed(scene, play, c)[0] for c in columns])


@dataclass(frozen=True)
class UniformTerms(Terms):
    """Terms of a motion about one axis: split by the noise they share, whitened as far as play alone determines."""

    across: Array  # (1 + size, 1 + size) squares of what lies across the path, whitened
    log_det: float
    turn: Array | None  # (k, 2 or 3, 1 + size) rotation that no position tells of
    mixed: Array | None  # (k, 1, 1 + size) rotation about the axis against the angle of the position
    per: float  # path [m] per radian, squared

    @classmethod
    def of(cls, scene: NodeScene, motion: Motion, play: float) -> Self:
        """Terms of all nodes for a play [m]."""
        assert isinstance(motion, AxisMotion)
        both, by_a = motion.expanded(scene.track, motion.configurations(scene.track, (1.0, 1e9)))
        position = motion.apart(both, by_a)
        W, half = scene.by_play(play)
        turn, mixed = motion.turns_apart(both) if scene.track.oriented else (None, None)
        per = motion.r**2 + motion.h**2
        return cls(motion, scene.track.oriented, _squares(W, position), position.shape[1] * half, turn, mixed, per)

    def system(self, scene: NodeScene, play: float, column: int) -> tuple[float, Array, Array, float]:
        """(squares, gradient, curvature, log determinant), with the prior in the first three."""
        total, log_det = self.across.copy(), self.log_det
        if self.turn is not None:
            W, half = scene.by_sway(float(SWAYS[column]))
            if HELD[column]:
                squares, weight = about_mean(W, scene.turned)
                total[0, 0] += squares
                j = len(total) - self.motion.size + self.motion.start_turn
                total[[j, j + 1, j + 2], [j, j + 1, j + 2]] += weight
                return self.with_prior(total, log_det + 3 * half)
            total += _squares(W, self.turn)
            log_det += self.turn.shape[1] * half
            if self.mixed is not None:
                both = SWAYS[column] ** 2 + play**2 / self.per
                W, half = whitener(both * scene.kernel + scene.rotation + scene.position / self.per)
                total += _squares(W, self.mixed)
                log_det += half
        return self.with_prior(total, log_det)


def believed(step: Array) -> float:
    """The share of a step that is believed: what a quadratic promises holds up to a third of a radian."""
    return min(1.0, _HOLDS / max(float(np.abs(step).max()), 1e-12))


def about_mean(W: Array, held: Array) -> tuple[float, float]:
    """Squares of rotations (3, k) about their most probable mean, and the information [1/rad²] on each of its axes.

    A hand that keeps its orientation explains its rotations as well as a drawer does, whatever the object does; the
    mean is unknown in both.
    """
    both, one = W @ held.T, W.sum(axis=1)
    weight, along = float(one @ one), one @ both
    return float((both * both).sum() - along @ along / weight), weight


def _solved(H: Array, g: Array) -> tuple[Array, float]:
    """−H⁻¹ g, and half the log determinant of H."""
    L, step, failed = dposv(H, g, lower=1)
    assert not failed, "no minimum"
    return -step, float(np.log(L.diagonal()).sum())


def _lifted(H: Array, share: float) -> Array:
    """H, its diagonal raised by a share of its trace."""
    H = np.array(H)
    H.ravel()[:: len(H) + 1] += share * float(H.trace())
    return H


def _squares(W: Array, blocks: Array) -> Array:
    """Products of the columns of (k, d, c), summed over nodes that share noise (c, c)."""
    k, d, c = blocks.shape
    white = (W @ blocks.reshape(k, d * c)).reshape(k * d, c)
    return white.T @ white
