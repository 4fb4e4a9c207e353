"""How well a kind of joint explains what was seen, with every size that nobody knows averaged out.

Nodes of a track depart from the ideal path by a play that is alike nearby and by noise that is not:

    covariance between nodes i, j = s² exp(−d_ij / reach) + D² exp(−d_ij² / 2 far²) + δ_ij σ_w² / n_i

for positions with s the play, for rotations with s the sway, both unknown (priors in furniture), D the distortion of
what measures, and σ_w the noise of one sample. A textbook criterion
takes residuals as independent, so that a drawer's bow of two millimetres, seen a hundred times, proves a circle twelve
metres wide. Here it was seen about five times, and such a circle is furniture that nobody builds.

The evidence of a kind is the integral of likelihood × prior over configurations, parameters, play and sway.
* Configurations: exactly, flat in metres of path, which is the same for all kinds that move. What is left of a position
  is across the path. What is left of a rotation is compared with the angle that the position tells, whose own play then
  counts too. Where the grasp is a ball, rotations are the hand's: anything, or, as arms like to do, kept as they are.
* Parameters: Laplace's method at the most probable ones for each play, in the coordinates of ``motion``. Of those, the
  direction of the path is common to sliding and turning; what turning must pay for is where the axis lies.
* Play and sway: a sum over a grid in units of their prior's standard deviation.
See MacKay, Information Theory, Inference, and Learning Algorithms (2003), chapters 27 and 28.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtrs

from modcal_core.articulation import furniture
from modcal_core.articulation.fit import prior_terms
from modcal_core.articulation.joints import KINDS, Kind
from modcal_core.articulation.motion import Motion
from modcal_core.articulation.track import Track
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array

_STEPS = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])  # of the prior's standard deviation
PLAYS = np.exp(furniture.PLAY[0] + furniture.PLAY[1] * _STEPS)
_LOG_PLAYS = -0.5 * _STEPS**2 - float(np.logaddexp.reduce(-0.5 * _STEPS**2))
_LOOSE_STEPS = np.array([-0.5, 0.5])
_FOLLOWS = np.exp(furniture.SWAY[0] + furniture.SWAY[1] * _STEPS)
SWAYS = np.concatenate([
    _FOLLOWS, np.exp(furniture.LOOSE[0] + furniture.LOOSE[1] * _LOOSE_STEPS), _FOLLOWS
])  # fmt: skip
_LOG_SWAYS = np.concatenate([
    _LOG_PLAYS + np.log1p(-furniture.LOOSE[2] - furniture.HELD), np.full(2, np.log(0.5 * furniture.LOOSE[2])),
    _LOG_PLAYS + np.log(furniture.HELD)
])  # fmt: skip
_HOLDS = 0.3
LOOSE = np.arange(len(SWAYS)) >= len(_STEPS)  # rotations say nothing of the object ...
HELD = np.arange(len(SWAYS)) >= len(_STEPS) + len(_LOOSE_STEPS)  # ... since the hand keeps them as they are
FIRST, FIRST_HELD = 2, len(SWAYS) - 3  # where to begin when nothing is known


@dataclass(frozen=True)
class Scene:
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
        """Cholesky factor (k, k) of the positions' covariance, and half its log determinant with the Gaussian's 2π."""
        return self._root(play, self.position)

    def by_sway(self, sway: float) -> tuple[Array, float]:
        """The same of the rotations' covariance."""
        return self._root(-sway, self.rotation)

    def _root(self, key: float, rest: Array) -> tuple[Array, float]:
        if key not in self._roots:
            self._roots[key] = _root(key**2 * self.kernel + rest)
        return self._roots[key]

    @cached_property
    def turned(self) -> Array:
        """Rotations of nodes from their mean (3, k) [rad]."""
        assert self.track.rotations is not None
        return so3.log(so3.mean(self.track.rotations).T @ self.track.rotations).T

    @classmethod
    def of(cls, track: Track, apart: Array, counts: Array, sigma: tuple[float, float]) -> Scene:
        """Nodes with counts (k,), distances (k, k) [m], noise of one sample sigma [m, rad]."""
        smooth = np.exp(-0.5 * (apart / furniture.DISTORTION_REACH) ** 2)
        least, distortion = (1e-5, 1e-4), furniture.DISTORTION
        both = [d**2 * smooth + np.diag(s**2 / counts + m**2)
                for s, m, d in zip(sigma, least, distortion, strict=True)]  # fmt: skip
        jitter = 9.0 * float(np.mean(1.0 / counts)) * (sigma[0] ** 2 + (0.1 * sigma[1]) ** 2)
        moved = float(np.sqrt(max(float(apart.max()) ** 2 - 2.0 * jitter, 1e-8)))
        return cls(track, np.exp(-apart / furniture.REACH), both[0], both[1], moved)


@dataclass(frozen=True)
class Row:
    """One kind at one play: its most probable motion, log evidence for each sway (1,) or (7,), which is the best."""

    motion: Motion
    evidence: Array
    column: int


def row(scene: Scene, motion: Motion, play: float, steps: int = 8, column: int = 2, again: bool = True) -> Row:
    """Climb to the most probable motion at this play (and this of the sways, or the best if again), and weigh it."""
    oriented = scene.track.oriented
    column = column if oriented else 0
    terms = _Terms.of(scene, motion, play)
    for _ in range(steps):
        step, gain = terms.step(scene, play, column)
        before = terms.cost(scene, play, column)
        shrink = min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12))
        for _ in range(6):
            moved = motion.moved(shrink * step)
            tried = _Terms.of(scene, moved, play)
            if tried.cost(scene, play, column) < before + 1e-9:
                break
            shrink *= 0.3
        else:
            break
        motion, terms = moved, tried
        if gain < 1e-2:
            break
    logs = terms.evidence(scene, play)
    best = int(np.argmax(logs + _LOG_SWAYS)) if oriented else 0
    if best != column and again:
        return row(scene, motion, play, steps, best, again=False)
    return Row(motion, logs, best)


def glance(scene: Scene, before: Row, play: float, turn: int) -> Row:
    """The same row a little later, when nodes have changed a little: one step, and evidence at the best sway and one
    more.

    turn: chooses the other sway, so that all of them get their turn, neighbours more often; below 0: a hand that keeps
    its orientation.
    """
    terms = _Terms.of(scene, before.motion, play)
    columns = {0}
    logs = before.evidence.copy()
    if scene.track.oriented:
        # all others move along with the best, until they are looked at again
        near = (before.column - 1, before.column + 1, turn // 3)[turn % 3] % len(SWAYS)
        columns = {before.column, near if turn >= 0 else FIRST_HELD}
    step = np.zeros(before.motion.size)
    shift, most = 0.0, -np.inf
    for c in columns:
        value, towards = terms.weighed(scene, play, c)
        if c == before.column:
            shift = value - logs[c]
        if (worth := value + (float(_LOG_SWAYS[c]) if scene.track.oriented else 0.0)) > most:
            step, most = towards, worth
        logs[c] = value
    if scene.track.oriented:
        rest = np.delete(np.arange(len(SWAYS)), list(columns))
        logs[rest] += shift
    best = int(np.argmax(logs + _LOG_SWAYS)) if scene.track.oriented else 0
    shrink = min(1.0, _HOLDS / max(float(np.abs(step).max()), 1e-12))
    return Row(before.motion.moved(shrink * step), logs, best)


@dataclass(frozen=True)
class _Terms:
    """Residuals and derivatives of all nodes, split by what noise they share, whitened as far as play alone decides."""

    motion: Motion
    across: Array  # (2 or 3, k, 1 + size) across the path, whitened
    log_det: float
    turn: Array | None  # (2 or 3, k, 1 + size) rotation that no position tells of
    mixed: Array | None  # (k, 1 + size) rotation about the axis against the angle of the position

    @classmethod
    def of(cls, scene: Scene, motion: Motion, play: float) -> _Terms:
        track = scene.track
        a = motion.configurations(track, (1.0, 1e9))
        e, by_a, J = motion.linearise(track, a)
        both = np.concatenate([e[:, :, None], J], axis=2)
        if motion.kind != "rigid":
            t = by_a[:, :3] / (by_a[:, :3] ** 2).sum(axis=1, keepdims=True)
            along = np.einsum("nm,nmk->nk", t, both[:, :3])
            both = both - by_a[:, :, None] * along[:, None, :]
        N = motion.across
        position = np.einsum("nmk,md->dnk", both[:, :3], N)
        L, half = scene.by_play(play)
        white = _whiten(L, position)
        log_det = len(position) * half
        turn = mixed = None
        if track.oriented:
            turned = np.moveaxis(both[:, 3:], 1, 0)
            turn, mixed = (turned[:2], turned[2]) if motion.turns else (turned, None)
        return cls(motion, white, float(log_det), turn, mixed)

    def _system(self, scene: Scene, play: float, column: int) -> tuple[float, Array, Array, float]:
        """(squares, gradient, curvature, log determinant), with the prior in the first three."""
        flat = self.across.reshape(-1, self.across.shape[-1])
        total = flat.T @ flat
        log_det = self.log_det
        if self.turn is not None:
            L, half = scene.by_sway(float(SWAYS[column]))
            if HELD[column]:
                squares, weight = _about_mean(L, scene.turned)
                total[0, 0] += squares
                j = total.shape[0] - self.motion.size + self.motion.start_turn
                total[[j, j + 1, j + 2], [j, j + 1, j + 2]] += weight
                return self._with_prior(total, log_det + 3 * half)
            white = _whiten(L, self.turn).reshape(-1, total.shape[0])
            total = total + white.T @ white
            log_det += len(self.turn) * half
            if self.mixed is not None:
                per = self.motion.r**2 + self.motion.h**2
                both = SWAYS[column] ** 2 + play**2 / per
                L, half = _root(both * scene.kernel + scene.rotation + scene.position / per)
                white = _whiten(L, self.mixed[None])[0]
                total = total + white.T @ white
                log_det += half
        return self._with_prior(total, log_det)

    def _with_prior(self, total: Array, log_det: float) -> tuple[float, Array, Array, float]:
        cost, gradient, curvature = prior_terms(self.motion)
        return (float(0.5 * total[0, 0] + cost), total[0, 1:] + gradient, total[1:, 1:] + np.diag(curvature),
                float(log_det))  # fmt: skip

    def cost(self, scene: Scene, play: float, column: int) -> float:
        squares, _, _, log_det = self._system(scene, play, column)
        return squares + log_det

    def step(self, scene: Scene, play: float, column: int) -> tuple[Array, float]:
        """Gauss–Newton step, and what it promises."""
        _, g, H, _ = self._system(scene, play, column)
        step = -np.linalg.solve(H + 1e-10 * np.trace(H) * np.eye(len(H)), g)
        return step, float(-0.5 * g @ step)

    def weighed(self, scene: Scene, play: float, column: int) -> tuple[float, Array]:
        """Log evidence at one sway, with the step that is left taken on the quadratic; and that step."""
        squares, g, H, log_det = self._system(scene, play, column)
        L = np.linalg.cholesky(H + 1e-12 * np.trace(H) * np.eye(len(H)))
        left = dtrtrs(L, g, lower=1)[0]
        step = -dtrtrs(L, left, lower=1, trans=1)[0]
        # What a quadratic promises is believed as far as it holds: to where a frame turns by a third of a radian.
        held = min(1.0, _HOLDS / max(float(np.abs(step).max()), 1e-12))
        gain = 0.5 * float(left @ left) * held * (2.0 - held)
        volume = 0.5 * len(g) * np.log(2.0 * np.pi) - np.log(np.diag(L)).sum()
        return float(gain - squares - log_det + volume + _log_prior(self.motion)), step

    def evidence(self, scene: Scene, play: float) -> Array:
        """Log evidence for each sway."""
        columns = range(len(SWAYS)) if self.turn is not None else range(1)
        return np.array([self.weighed(scene, play, c)[0] for c in columns])


def _log_prior(motion: Motion) -> float:
    """What the prior's density has beside its exponent, in the coordinates of the motion."""
    log = -np.log(4.0 * np.pi)
    if motion.turns:
        log += -np.log(2.0 * np.pi) - np.log(furniture.RADIUS[1] * np.sqrt(2.0 * np.pi))
    if motion.kind == "screw":
        log += -np.log(furniture.PITCH[1] * np.sqrt(2.0 * np.pi)) - np.log(2.0)
    return float(log)


def _about_mean(L: NDArray[Any], held: Array) -> tuple[float, float]:
    """Squares of rotations (3, k) about their most probable mean, and the information [1/rad²] on each of its axes.

    A hand that keeps its orientation explains its rotations as well as a drawer does, whatever the object does; the
    mean is unknown in both.
    """
    both = _whiten(L, np.concatenate([held, np.ones((1, held.shape[1]))])[:, :, None])[:, :, 0]
    one = both[3]
    weight = float(one @ one)
    return float((both[:3] ** 2).sum() - ((both[:3] @ one) ** 2).sum() / weight), weight


def _root(C: NDArray[Any]) -> tuple[Array, float]:
    """Cholesky factor of a covariance (k, k), and half its log determinant with the Gaussian's 2π."""
    L = np.asarray(np.linalg.cholesky(C), dtype=float)
    return L, float(np.log(L.diagonal()).sum() + 0.5 * len(L) * np.log(2.0 * np.pi))


def _whiten(L: NDArray[Any], blocks: Array) -> Array:
    """L⁻¹ on each of (d, k, c)."""
    d, k, c = blocks.shape
    side = blocks.transpose(1, 0, 2).reshape(k, d * c)
    return dtrtrs(L, side, lower=1)[0].reshape(k, d, c).transpose(1, 0, 2)


def still(moved: float) -> float:
    """Probability that nothing but play moved, where the handle came so far [m].

    Play lets it come about twice its size: a log-normal density of distances, against one that is flat over the span of
    handles. Both are equally likely beforehand.
    """
    mean, std = furniture.PLAY[0] + np.log(2.0), furniture.PLAY[1]
    z = (np.log(max(moved, 1e-6)) - mean) / std
    if z < 0.0:
        z, moved = 0.0, float(np.exp(mean))  # that it moved even less speaks for nothing else
    rigid = np.exp(-0.5 * z * z) / (moved * std * np.sqrt(2.0 * np.pi))
    return float(rigid / (rigid + 1.0 / furniture.SPAN))


def weigh(
    rows: dict[Kind, list[Row]], moved: float, plays: tuple[int, ...] = tuple(range(len(PLAYS)))
) -> tuple[dict[Kind, float], Kind, int, int]:
    """Probabilities of all kinds; of those that move the best one, its best play and its best sway.

    moved: how far the handle came [m]. plays: which of PLAYS the rows are of.
    """
    logs: dict[Kind, float] = {}
    best: tuple[float, Kind, int, int] | None = None
    for kind, at in rows.items():
        table = np.array([r.evidence for r in at]) + _LOG_PLAYS[list(plays), None]
        if table.shape[1] > 1:
            table = table + _LOG_SWAYS
        logs[kind] = float(np.logaddexp.reduce(table, axis=None)) + np.log(furniture.SHARE[kind])
        i, j = np.unravel_index(int(np.argmax(table)), table.shape)
        if best is None or logs[kind] > best[0]:
            best = logs[kind], kind, int(i), int(j)
    assert best is not None
    total, rigid = float(np.logaddexp.reduce(list(logs.values()))), still(moved)
    shares: dict[Kind, float] = {"rigid": rigid}
    for kind in KINDS[1:]:
        shares[kind] = (1.0 - rigid) * float(np.exp(logs[kind] - total)) if kind in logs else 0.0
    return shares, best[1], best[2], best[3]
