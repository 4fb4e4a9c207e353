"""How well a kind of joint explains what was seen, with every size that nobody knows averaged out.

Nodes of a track depart from the ideal path by a play that is alike nearby and by noise that is not:

    covariance between nodes i, j = s² exp(−d_ij / reach) + D² exp(−d_ij² / 2 far²) + δ_ij σ_w² / n_i

for positions with s the play, for rotations with s the sway, D the distortion of what measures, all of unknown size
(priors in furniture), and σ_w the noise of one sample. A textbook criterion
takes residuals as independent, so that a drawer's bow of two millimetres, seen a hundred times, proves a circle twelve
metres wide. Here it was seen about five times, and such a circle is furniture that nobody builds.

The evidence of a kind is the integral of likelihood × prior over configurations, parameters, play and sway.
* Configurations: exactly, flat in metres of path, which is the same for all kinds that move. What is left of a position
  is across the path. What is left of a rotation is compared with the angle that the position tells, whose own play then
  counts too. Where the grasp is a ball, rotations are the hand's: anything, or, as arms like to do, kept as they are.
* Parameters: Laplace's method at the most probable ones for each play, in the coordinates of ``motion``. Of those, the
  direction of the path is common to sliding and turning; what turning must pay for is where the axis lies.
* Play, sway and the size of distortion: a sum over a grid in units of their prior's standard deviation.
See MacKay, Information Theory, Inference, and Learning Algorithms (2003), chapters 27 and 28.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from modcal_core.articulation import furniture
from modcal_core.articulation.added_motion import AddedMotion
from modcal_core.articulation.fit import prior_terms
from modcal_core.articulation.joints import KINDS, Kind
from modcal_core.articulation.motion import Motion
from modcal_core.articulation.scene import FIRST_HELD, HELD, LOG_2PI, LOG_SWAYS, SWAYS, Scene, whitener
from modcal_core.geometry.so3 import Array

_HOLDS = 0.3


@dataclass(frozen=True)
class Row:
    """One kind at one play: its most probable motion, log evidence for each sway (1,) or (7,), which is the best."""

    motion: Motion
    evidence: Array
    column: int


def row(scene: Scene, motion: Motion, play: float, steps: int = 8, column: int = 2, again: bool = True,
        look: Callable[[Scene, Motion, float], Terms] | None = None) -> Row:  # fmt: skip
    """Climb to the most probable motion at this play (and this of the sways, or the best if again), and weigh it.

    look: how such motions are looked at, where not as those of the house.
    """
    look = look or Terms.of
    oriented = scene.track.oriented
    column = column if oriented else 0
    terms = look(scene, motion, play)
    for _ in range(steps):
        step, gain = terms.step(scene, play, column)
        before = terms.cost(scene, play, column)
        shrink = min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12))
        for _ in range(6):
            moved = motion.moved(shrink * step)
            tried = look(scene, moved, play)
            if tried.cost(scene, play, column) < before + 1e-9:
                break
            shrink *= 0.3
        else:
            break
        motion, terms = moved, tried
        if gain < 1e-2:
            break
    logs = terms.evidence(scene, play)
    best = int(np.argmax(logs + LOG_SWAYS)) if oriented else 0
    if best != column and again:
        return row(scene, motion, play, steps, best, again=False, look=look)
    return Row(motion, logs, best)


def improved(scene: Scene, motion: Motion, play: float, column: int) -> Motion:
    """The motion after one step towards the most probable one at this play and this of the sways."""
    step, _ = Terms.of(scene, motion, play).step(scene, play, column if scene.track.oriented else 0)
    return motion.moved(_held(step) * step)


def glance(scene: Scene, before: Row, play: float, turn: int) -> Row:
    """The same row a little later, when nodes have changed a little: one step, and evidence at the best sway and one
    more.

    turn: chooses the other sway, so that all of them get their turn, neighbours more often; below 0: a hand that keeps
    its orientation.
    """
    terms = Terms.of(scene, before.motion, play)
    columns = {0}
    logs = before.evidence.copy()
    if scene.track.oriented:
        # all others move along with the best, until they are looked at again
        near = (before.column - 1, before.column + 1, turn // 3)[turn % 3] % len(SWAYS)
        columns = {before.column, near if turn >= 0 else FIRST_HELD}
    step = np.zeros(before.motion.size)
    shift, most = 0.0, -math.inf
    for c in columns:
        value, towards = terms.weighed(scene, play, c)
        if c == before.column:
            shift = value - logs[c]
        if (worth := value + (float(LOG_SWAYS[c]) if scene.track.oriented else 0.0)) > most:
            step, most = towards, worth
        logs[c] = value
    if scene.track.oriented:
        logs += [0.0 if c in columns else shift for c in range(len(SWAYS))]
    best = int((logs + LOG_SWAYS).argmax()) if scene.track.oriented else 0
    return Row(before.motion.moved(_held(step) * step), logs, best)


def _held(step: Array) -> float:
    """The share of a step that is believed: what a quadratic promises holds up to a third of a radian."""
    return min(1.0, _HOLDS / max(float(np.abs(step).max()), 1e-12))


@dataclass(frozen=True)
class Terms:
    """Residuals and derivatives of all nodes, split by what noise they share, whitened as far as play alone decides."""

    motion: Motion
    across: Array  # (1 + size, 1 + size) squares of what lies across the path, whitened
    log_det: float
    turn: Array | None  # (k, 2 or 3, 1 + size) rotation that no position tells of
    mixed: Array | None  # (k, 1, 1 + size) rotation about the axis against the angle of the position

    @classmethod
    def of(cls, scene: Scene, motion: Motion, play: float) -> Terms:
        """Of all nodes, where the play is that."""
        both, by_a = motion.expanded(scene.track, motion.configurations(scene.track, (1.0, 1e9)))
        if motion.kind != "rigid":
            t = by_a[:, :3]
            along = t[:, None] @ both[:, :3] / (t * t).sum(axis=1)[:, None, None]
            both -= by_a[:, :, None] * along
        position = both[:, 1:3] if motion.kind != "rigid" else both[:, :3]
        if motion.kind == "screw":
            position = motion.across.T @ both[:, :3]
        W, half = scene.by_play(play)
        turn = mixed = None
        if scene.track.oriented:
            turn, mixed = (both[:, 3:5], both[:, 5:]) if motion.turns else (both[:, 3:], None)
        return cls(motion, _squares(W, position), position.shape[1] * half, turn, mixed)

    def system(self, scene: Scene, play: float, column: int) -> tuple[float, Array, Array, float]:
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
                per = self.motion.r**2 + self.motion.h**2
                both = SWAYS[column] ** 2 + play**2 / per
                W, half = whitener(both * scene.kernel + scene.rotation + scene.position / per)
                total += _squares(W, self.mixed)
                log_det += half
        return self.with_prior(total, log_det)

    def with_prior(self, total: Array, log_det: float) -> tuple[float, Array, Array, float]:
        """What ``system`` returns, of squares and products of columns (1 + size, 1 + size)."""
        cost, gradient, curvature = prior_terms(self.motion)
        total.ravel()[len(total) + 1 :: len(total) + 1] += curvature
        return 0.5 * float(total[0, 0]) + cost, total[0, 1:] + gradient, total[1:, 1:], log_det

    def cost(self, scene: Scene, play: float, column: int) -> float:
        """What a step is to lower."""
        squares, _, _, log_det = self.system(scene, play, column)
        return squares + log_det

    def step(self, scene: Scene, play: float, column: int) -> tuple[Array, float]:
        """Gauss–Newton step, and what it promises."""
        _, g, H, _ = self.system(scene, play, column)
        step = _solved(_lifted(H, 1e-10), g)[0]
        return step, float(-0.5 * g @ step)

    def weighed(self, scene: Scene, play: float, column: int) -> tuple[float, Array]:
        """Log evidence at one sway, with the step that is left taken on the quadratic; and that step."""
        squares, g, H, log_det = self.system(scene, play, column)
        step, half = _solved(_lifted(H, 1e-12), g)
        held = _held(step)
        gain = -0.5 * float(g @ step) * held * (2.0 - held)
        volume = 0.5 * len(g) * LOG_2PI - half
        return gain - squares - log_det + volume + _log_prior(self.motion), step

    def evidence(self, scene: Scene, play: float) -> Array:
        """Log evidence for each sway."""
        columns = range(len(SWAYS)) if self.turn is not None else range(1)
        return np.array([self.weighed(scene, play, c)[0] for c in columns])


def _log_prior(motion: Motion) -> float:
    """What the prior's density has beside its exponent, in the coordinates of the motion."""
    if isinstance(motion, AddedMotion):
        return motion.log_prior()
    log = -math.log(4.0 * math.pi)
    if motion.turns:
        log += -LOG_2PI - math.log(furniture.RADIUS[1]) - 0.5 * LOG_2PI
    if motion.kind == "screw":
        log += -math.log(furniture.PITCH[1]) - 0.5 * LOG_2PI - math.log(2.0)
    return log


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


def weigh(rows: dict[Kind, list[Row]], moved: float, log_priors: Array,
          own: Mapping[Kind, float] | None = None) -> tuple[dict[Kind, float], Kind, int, int]:  # fmt: skip
    """Probabilities of all kinds; of those that move the best one, its best row and its best sway.

    moved: how far the handle came [m]. log_priors: of each kind's rows (n,). own: how often the kinds of packages are
    met; those of the house share what is left.
    """
    own = own or {}
    rest = math.log1p(-sum(own.values()))
    logs: dict[Kind, float] = {}
    best: tuple[float, Kind, int, int] | None = None
    for kind, at in rows.items():
        table = np.array([r.evidence for r in at]) + log_priors[:, None]
        if table.shape[1] > 1:
            table = table + LOG_SWAYS
        logs[kind] = float(np.logaddexp.reduce(table, axis=None))
        logs[kind] += np.log(own[kind]) if kind in own else np.log(furniture.SHARE[kind]) + rest
        i, j = np.unravel_index(int(np.argmax(table)), table.shape)
        if best is None or logs[kind] > best[0]:
            best = logs[kind], kind, int(i), int(j)
    assert best is not None
    total, rigid = float(np.logaddexp.reduce(list(logs.values()))), still(moved)
    shares: dict[Kind, float] = {"rigid": rigid}
    for kind in (*KINDS[1:], *own):
        shares[kind] = (1.0 - rigid) * float(np.exp(logs[kind] - total)) if kind in logs else 0.0
    return shares, best[1], best[2], best[3]
