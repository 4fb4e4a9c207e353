"""What all kinds of joint must explain: nodes of a track, how they are off together, and the sizes that are tried.

Of a motion about one axis the direction along the path is the same for all nodes, once unwound (``UniformTerms``). The
path of a parametric model may bend in the frame that it moves along, so the direction t along it [unit vector], and the
turn ω [rad] per metre, differ from node to node (``VaryingTerms``). The latent place on the path, flat in metres, is
integrated out by what no place on the path can change: of each node's residuals e, φ and two directions U across t,

    x = Uᵀe,   y = φ − ω tᵀe

With covariances P and Q of positions and rotations between nodes, those of x and y are

    x_i x_j: P_ij U_iᵀU_j,   x_i y_j: −P_ij (U_iᵀt_j) ω_jᵀ,   y_i y_j: Q_ij I + P_ij (t_iᵀt_j) ω_i ω_jᵀ

A node beyond an end of the path pays for how far it is beyond.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv, dpotrf, dtrtri

from modcal_core.articulation import furniture
from modcal_core.articulation.joint_motion import Motion
from modcal_core.articulation.models.axis import AxisMotion
from modcal_core.articulation.models.parametric import ParametricMotion
from modcal_core.articulation.track import Track
from modcal_core.geometry import Array, so3

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
# distortion in units of the usual, play [m], log-probability of both: those of neighbours are alike
SIZES = [(f, f * float(np.exp(furniture.PLAY[0])), math.log(furniture.FINE[1] / len(furniture.FINE[0])))
         for f in furniture.FINE[0]]  # fmt: skip
SIZES += [
    (float(d), float(PLAYS[i]), float(LOG_DISTORTIONS[k] + LOG_PLAYS[i]) + math.log1p(-furniture.FINE[1]))
    for k, d in enumerate(DISTORTIONS)
    for i in (range(len(PLAYS)) if k % 2 == 0 else reversed(range(len(PLAYS))))
]
# how far rotations sway [rad], and log-probability: of hands that follow, that are loose, and that keep theirs
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

    @cached_property
    def turned(self) -> Array:
        """Rotations of nodes from their mean (3, k) [rad]."""
        assert self.track.rotations is not None
        return so3.log(so3.mean(self.track.rotations).T @ self.track.rotations).T

    @classmethod
    def of(
        cls, track: Track, apart: Array, counts: Array, sigma: tuple[float, float], distorted: float = 1.0
    ) -> NodeScene:
        """Nodes with counts (k,), distances (k, k) [m], noise sigma of a sample, distortion times the usual one."""
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
    H = np.array(H)
    H.ravel()[:: len(H) + 1] += share * float(H.trace())
    return H


def _squares(W: Array, blocks: Array) -> Array:
    """Products of the columns of (k, d, c), summed over nodes that share noise (c, c)."""
    k, d, c = blocks.shape
    white = (W @ blocks.reshape(k, d * c)).reshape(k * d, c)
    return white.T @ white


_AT_END = 1e-9  # of the range of configurations


@dataclass(frozen=True)
class VaryingTerms(Terms):
    """position (2 k, 1 + size), rotation (3 k, 1 + size): x and y of all nodes, and derivatives by the parameters.

    beyond: (k, 1 + size) how far nodes lie beyond an end [m], zero for those that do not. U (k, 2, 3), t (k, 3), w
    (k, 3): directions across and along the path, and the turn per metre. turn: the rotations by node, None without.
    """

    position: Array
    rotation: Array
    beyond: Array
    U: Array
    t: Array
    w: Array
    turn: Array | None

    @classmethod
    def of(cls, scene: NodeScene, motion: Motion, play: float) -> Self:
        """Terms of all nodes. The play enters the linear system only."""
        assert isinstance(motion, ParametricMotion)
        track = scene.track
        a = motion.configurations(track, (1.0, 1e9))
        both, by_a = motion.expanded(track, a)
        speed = np.maximum(np.linalg.norm(by_a[:, :3], axis=1, keepdims=True), 1e-12)
        t, w = by_a[:, :3] / speed, by_a[:, 3:] / speed
        U = np.linalg.svd(t[:, None])[2][:, 1:]
        along = t[:, None] @ both[:, :3]
        model = motion.model
        inside = np.minimum(a - model.lower, model.upper - a) > _AT_END * (model.upper - model.lower)
        beyond = np.where(inside[:, None], 0.0, along[:, 0])
        width = both.shape[2]
        position = (U @ both[:, :3]).reshape(-1, width)
        turn = both[:, 3:] - w[:, :, None] * along if track.oriented else None
        rotation = np.empty((0, width)) if turn is None else turn.reshape(-1, width)
        return cls(motion, track.oriented, position, rotation, beyond, U, t, w, turn)

    def system(self, scene: NodeScene, play: float, column: int) -> tuple[float, Array, Array, float]:
        """(squares, gradient, curvature, log determinant), with the prior in the first three."""
        P = play**2 * scene.kernel + scene.position
        k = len(P)
        xx = np.einsum("ij,iac,jbc->iajb", P, self.U, self.U).reshape(2 * k, 2 * k)
        seen, S = self.position, xx
        held = self.turn is not None and bool(HELD[column])
        if self.turn is not None and not held:
            Q = float(SWAYS[column]) ** 2 * scene.kernel + scene.rotation
            xy = -np.einsum("ij,iac,jc,jb->iajb", P, self.U, self.t, self.w).reshape(2 * k, 3 * k)
            yy = np.einsum("ij,ia,jb->iajb", P * (self.t @ self.t.T), self.w, self.w).reshape(3 * k, 3 * k)
            S = np.block([[xx, xy], [xy.T, yy + np.kron(Q, np.eye(3))]])
            seen = np.concatenate([self.position, self.rotation])
        W, log_det = whitener(S)
        white = W @ seen
        over = self.beyond / np.sqrt(P.diagonal())[:, None]
        total = white.T @ white + over.T @ over
        if held:
            W, half = scene.by_sway(float(SWAYS[column]))
            squares, weight = about_mean(W, scene.turned)
            j = 1 + self.motion.start_turn
            total[0, 0] += squares
            total[[j, j + 1, j + 2], [j, j + 1, j + 2]] += weight
            log_det += 3 * half
        return self.with_prior(total, log_det)
