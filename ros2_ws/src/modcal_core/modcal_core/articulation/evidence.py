"""How well a kind of joint explains what was seen, with every size that nobody knows averaged out.

Nodes of a track depart from the ideal path by a play that is alike nearby and by noise that is not:

    covariance between nodes i, j = s² exp(−d_ij / reach) + D² exp(−d_ij² / 2 far²) + δ_ij σ_w² / n_i

with s the play (of rotations the sway), D the distortion of what measures, all of unknown size (priors in furniture),
and σ_w the noise of one sample. With independent residuals, a drawer's bow of two millimetres, seen a hundred times,
would prove a circle twelve metres wide.

The evidence of a kind is the integral of likelihood × prior over configurations, parameters, play and sway.
* Configurations: exactly, flat in metres of path. What is left of a position is across the path; what is left of a
  rotation is compared with the angle that the position tells. In a ball grasp rotations are the hand's.
* Parameters: Laplace's method at the most probable ones for each play, in the coordinates of ``motion``.
* Play, sway and the size of distortion: a sum over a grid in units of their prior's standard deviation.
See MacKay, Information Theory, Inference, and Learning Algorithms (2003), chapters 27 and 28.

Hinges lie 10 cm to 1.6 m from the handle. Beyond, they are as rare as other curves (a pantograph, a sagging rail), so
the arc must be long enough that a curve whose bend changes along the way by its mean would have been noticed. Such a
curve leaves κ L² (2/5) / (48 √7), RMS, of its nearest arc, with κ the mean bend and L the length: a Legendre polynomial
of third degree. A line has to leave less than the arc of a usual hinge, 40 cm away, would: κ L² / (12 √5), RMS.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from modcal_core.articulation import furniture
from modcal_core.articulation.furniture import DISTORTION, PLAY, RADIUS
from modcal_core.articulation.joint_motion import Kind, Motion
from modcal_core.articulation.models.axis import AxisMotion
from modcal_core.articulation.models.registry import STILL
from modcal_core.articulation.scene import (
    FIRST_OF_HELD,
    LOG_2PI,
    LOG_PLAYS,
    LOG_SWAYS,
    SIZES,
    SWAYS,
    NodeScene,
    UniformTerms,
    VaryingTerms,
    about_mean,
    believed,
)
from modcal_core.geometry import Array

_LOG_FOLLOWS = np.log(SWAYS[FIRST_OF_HELD:])  # the same sizes for the handle and for a hand


@dataclass(frozen=True)
class EvidenceRow:
    """One kind at one play: its most probable motion, log evidence for each sway (1,) or (7,), which is the best."""

    motion: Motion
    evidence: Array
    column: int


def terms_of(scene: NodeScene, motion: Motion, play: float) -> UniformTerms | VaryingTerms:
    """How a motion explains the nodes of a scene, where the play is that [m]."""
    return (UniformTerms if motion.uniform else VaryingTerms).of(scene, motion, play)


def row(scene: NodeScene, motion: Motion, play: float, steps: int = 8, column: int = 2, again: bool = True
        ) -> EvidenceRow:  # fmt: skip
    """Climb to the most probable motion at this play (and this of the sways, or the best if again), and weigh it."""
    oriented = scene.track.oriented
    column = column if oriented else 0
    terms = terms_of(scene, motion, play)
    for _ in range(steps):
        step, gain = terms.step(scene, play, column)
        before = terms.cost(scene, play, column)
        shrink = min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12))
        for _ in range(6):
            moved = motion.moved(shrink * step)
            tried = terms_of(scene, moved, play)
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
        return row(scene, motion, play, steps, best, again=False)
    return EvidenceRow(motion, logs, best)


def improved(scene: NodeScene, motion: Motion, play: float, column: int) -> Motion:
    """The motion after one step towards the most probable one at this play and this of the sways."""
    step, _ = terms_of(scene, motion, play).step(scene, play, column if scene.track.oriented else 0)
    return motion.moved(believed(step) * step)


def glance(scene: NodeScene, before: EvidenceRow, play: float, turn: int) -> EvidenceRow:
    """The same row a little later, when nodes have changed a little: one step, and evidence at the best sway and one
    more.

    turn: chooses the other sway: what the rotations that are left look like, as the handle's or the hand's, or a
    neighbour, or any. Below 0: of a new guess, whose sway nobody knows, both of the first.
    """
    terms = terms_of(scene, before.motion, play)
    columns = {0}
    logs = before.evidence.copy()
    if scene.track.oriented:
        # all others move along with the best, until they are looked at again
        if turn < 0:
            columns = {before.column, *_looks(scene, terms)}
        else:
            near = (*_looks(scene, terms), before.column + (-1 if turn % 8 < 4 else 1), turn // 4)
            columns = {before.column, near[turn % 4] % len(SWAYS)}
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
    return EvidenceRow(before.motion.moved(believed(step) * step), logs, best)


def _looks(scene: NodeScene, terms: UniformTerms | VaryingTerms) -> tuple[int, int]:
    """Which sway the rotations look like: what is left of them as the handle's, all of them as a steady hand's."""
    assert terms.turn is not None
    left = terms.turn[:, :, 0]
    sizes = (float(left.ravel() @ left.ravel()) / left.size, float((scene.turned**2).mean()))
    return tuple(  # type: ignore[return-value]
        first + int(np.abs(_LOG_FOLLOWS - 0.5 * math.log(max(size, 1e-12))).argmin())
        for first, size in zip((0, FIRST_OF_HELD), sizes, strict=True)
    )


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


_PLACES = 4  # nodes that count by themselves


def regular(scene: NodeScene, total: float) -> float:
    """How much better a joint explains where the nodes lie than a handle that lies about one place, as a logarithm.

    total: log evidence of the joints. Of how far the nodes came nothing is said by that: play comes as far, but follows
    no line, and no circle to a hundredth of its size. A hand wanders, so that few of its places count by themselves.
    """
    p = scene.track.positions
    k, squares = len(p), float(((p - p.mean(axis=0)) ** 2).sum())
    variance = max(squares / (3.0 * (k - 1)), 1e-12)
    rests = -1.5 * ((k - 1) * (math.log(2.0 * math.pi * variance) + 1.0) + math.log(k))
    if scene.track.oriented:
        turned = []
        for log_sway, sway in zip(LOG_PLAYS, SWAYS, strict=False):
            W, half = scene.by_sway(float(sway))
            left, weight = about_mean(W, scene.turned)
            turned.append(log_sway - 0.5 * left - 3.0 * half - 1.5 * (math.log(weight) - LOG_2PI))
        rests += float(np.logaddexp.reduce(turned))
    # configurations are flat in metres for all of a joint; those that moved so far lie within that
    return (total - k * math.log(scene.moved) - rests) * min(1.0, _PLACES / k)


def size_priors(noise: float) -> Array:
    """Log-probabilities of all SIZES (n,), of readings that scatter by so much [m]: more than a fine one's tells."""
    size, out = max(noise, 1e-12) / furniture.NOISE, []
    for distorted, _, prior in SIZES:
        beyond = max(math.log(size / distorted), 0.0) / furniture.DISTORTED if distorted in furniture.FINE[0] else 0.0
        out.append(prior - 0.5 * beyond * beyond)
    return np.array(out)


def of_fine(motion: Motion) -> float:
    """What the logarithm of the prior of a fine joint is above that of furniture: its axis may be nearer."""
    if not (isinstance(motion, AxisMotion) and motion.turns):
        return 0.0
    mean, std = RADIUS
    off = min(math.log(motion.r) - mean, 0.0) / std
    return max(0.5 * off * off + math.log(std * math.sqrt(2.0 * math.pi) / (mean - furniture.NEAREST)), 0.0)


def weigh(rows: Mapping[Kind, list[EvidenceRow]], log_priors: Array, log_shares: Mapping[Kind, float],
          scene: NodeScene, counted: bool = False) -> tuple[dict[Kind, float], Kind, int, int]:  # fmt: skip
    """Probabilities of all kinds; of those that move the best one, its best row and its best sway.

    log_priors: of each kind's rows (n,). counted: whether that it rests is judged by how the nodes of the scene lie,
    and not by how far apart alone. log_shares: how often each kind that moves is met, as a logarithm.
    """
    logs: dict[Kind, float] = {}
    best: tuple[float, Kind, int, int] | None = None
    for kind, at in rows.items():
        table = np.array([r.evidence for r in at]) + log_priors[:, None]
        if table.shape[1] > 1:
            table = table + LOG_SWAYS
        logs[kind] = float(np.logaddexp.reduce(table, axis=None))
        logs[kind] += log_shares[kind]
        i, j = np.unravel_index(int(np.argmax(table)), table.shape)
        if best is None or logs[kind] > best[0]:
            best = logs[kind], kind, int(i), int(j)
    assert best is not None
    total = float(np.logaddexp.reduce(list(logs.values())))
    rigid = still(scene.moved)
    if counted:
        rigid = rigid / (rigid + (1.0 - rigid) * math.exp(min(max(regular(scene, total), -50.0), 500.0)))
    shares: dict[Kind, float] = {STILL.name: rigid}
    for kind in log_shares:
        shares[kind] = (1.0 - rigid) * float(np.exp(logs[kind] - total)) if kind in logs else 0.0
    return shares, best[1], best[2], best[3]


FARTHEST = math.exp(RADIUS[0] + 2.0 * RADIUS[1])  # m, 1.6: of 95 % of hinges
_LEAVES = 0.4 / (48.0 * math.sqrt(7.0))  # of κ L², the RMS that an arc leaves of a bend that changes by its mean
_OF_LINE = 1.0 / (12.0 * math.sqrt(5.0))  # of κ L², the RMS that a line leaves of an arc
_USUAL = math.hypot(math.exp(PLAY[0]), DISTORTION[0])  # m: what handles and cameras leave


def unproved(motion: Motion, a: Array) -> str:
    """Why a hinge so far away is to be doubted, as text; empty where it is not. a (n,): configurations."""
    if not (isinstance(motion, AxisMotion) and motion.turns) or motion.r <= FARTHEST:
        return ""
    turned = _span(a)
    if turned * turned * motion.r * _LEAVES > _USUAL:  # κ L² = angle² r
        return ""
    return (
        f"hinges are seldom farther away than {FARTHEST:.1f} m, and {math.degrees(turned):.0f}° tell one from no other "
        "curve"
    )


def hidden(motion: Motion, a: Array, left: float) -> str:
    """Why a line is to be doubted, as text: it leaves so much [m] that a hinge would not be seen. a (n,): [m]."""
    bow = _OF_LINE * _span(a) ** 2 / math.exp(RADIUS[0])
    if motion.turns or not motion.flat or left <= bow:
        return ""
    return f"it leaves {1e3 * left:.0f} mm, where the arc of a hinge at 40 cm is {1e3 * bow:.0f} mm from a line"


def _span(a: Array) -> float:
    low, high = np.quantile(a, [0.01, 0.99])
    return float(high - low)
