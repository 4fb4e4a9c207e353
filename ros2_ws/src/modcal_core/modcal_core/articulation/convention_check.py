"""Online: whether rotations that follow no joint would follow one in another convention (``rotation_convention``).

A whole selection for every convention is too much for one pose. But a joint that turns says itself in closed form: all
rotations are turns about one axis, and a handle that is held firmly lies where they bring it,

    R_i = exp(δ_i w) M,    p_i = exp(δ_i w) y + c + h δ_i w,

which is linear in arm y, centre c and rise h. So every convention is compared with every joint that turns by small
least squares over the nodes, one convention at a step. Those are named where the rotations as written leave too much
for any such joint, and in another convention no more than usual furniture and tracking do. A hand that turns in its
grasp does so in neither. A short piece of any path fits a screw in most conventions: while one does, and the path lies
in a plane, which a screw's does not, nothing is said.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from modcal_core.articulation.misfit import limits, rms, too_much, usual
from modcal_core.articulation.models.revolute import RevoluteMotion
from modcal_core.articulation.models.screw import ScrewMotion
from modcal_core.articulation.rotation_convention import RIVAL, OtherConvention, ReadOtherwise, readings, written
from modcal_core.articulation.track import Track
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array

_TURN = 2.0  # times what a hand may sway by and still hold firmly: a smaller turn is no turn


@dataclass(frozen=True)
class LeftByHinge:
    """What a joint that turns leaves of a path. position [m], rotation [rad]: of the nine tenths that fit best.

    turn: how far it turns [rad]. rise: how far it rises meanwhile [m].
    """

    position: float
    rotation: float
    turn: float
    rise: float

    def beside(self, shift: float, sway: float) -> float:
        """What it leaves, against what would be too much of positions [m] and rotations [rad]."""
        return math.hypot(self.position / shift, self.rotation / sway)


class ConventionCheck:
    """written: what poses were written as, None as long as nothing says that they are not as they should be.

    What has been said by a long way is not taken back by a shorter one, as after a restart of the estimate.
    """

    def __init__(self) -> None:
        self.written: OtherConvention | None = None
        self._turned = 0.0  # by the way that it was said by [rad]
        self._work: Iterator[None] = iter(())

    def begin(self, nodes: Track, noise: tuple[float, float]) -> None:
        """Ask again. nodes: the path so far, pooled, with rotations. noise: of one pose [m, rad]."""
        self._work = self._steps(nodes, noise)

    def advance(self) -> None:
        """Look at one convention more, if any is left."""
        next(self._work, None)

    def _steps(self, nodes: Track, noise: tuple[float, float]) -> Iterator[None]:
        apart = nodes.positions - nodes.positions.mean(axis=0)
        plane = usual(rms(np.abs(apart @ np.linalg.svd(apart)[2][2])), 0.0, noise)
        as_is = left(nodes)
        if as_is.turn < self._turned:
            return
        if not too_much(as_is.position, as_is.rotation, noise):
            self.written, self._turned = None, 0.0
            return
        shift, sway = limits(noise)
        fits: list[tuple[ReadOtherwise, LeftByHinge]] = []
        for reading in readings(nodes):
            yield
            of = left(reading.track)
            if of.turn > _TURN * sway and usual(of.position, of.rotation, noise):
                fits.append((reading, of))
        least = min((of.beside(shift, sway) for _, of in fits), default=0.0)
        fits = [(reading, of) for reading, of in fits if of.beside(shift, sway) <= RIVAL * least]
        flat = all(of.rise < shift for _, of in fits)
        kind = RevoluteMotion.kind if flat else ScrewMotion.kind
        told = bool(fits) and (flat or not plane)
        self.written = written([reading for reading, _ in fits], kind) if told else None
        self._turned = as_is.turn if told else 0.0


def left(track: Track) -> LeftByHinge:
    """What the joint that turns and fits best leaves of a track with rotations."""
    assert track.rotations is not None
    p, middle = track.positions, so3.mean(track.rotations)
    seen = middle.T @ track.rotations
    turns = so3.log(seen)
    u = np.linalg.svd(turns, full_matrices=False)[2][0]
    w, a = middle @ u, turns @ u
    span = float(np.ptp(a))
    about = a
    arm, centre, pitch = _placed(p, w, a)
    for _ in range(2):  # how far it is at each pose, positions say better than rotations
        a = _angles(p - centre, w, arm, about)
        arm, centre, pitch = _placed(p, w, a)
    shift = p - (so3.exp(a[:, None] * w) @ arm + centre + pitch * a[:, None] * w)
    grasp = so3.exp(-a[:, None] * u) @ seen
    turn = so3.log(so3.mean(grasp).T @ grasp)
    return LeftByHinge(rms(np.linalg.norm(shift, axis=1)), rms(np.linalg.norm(turn, axis=1)), span, abs(pitch) * span)


def _placed(p: Array, w: Array, a: Array) -> tuple[Array, Array, float]:
    """Arm, centre and rise per angle, where the joint is at angles a (n,) about w."""
    along = (a[:, None] * w)[..., None]
    A = np.concatenate([so3.exp(a[:, None] * w), np.broadcast_to(np.eye(3), (len(a), 3, 3)), along], axis=2)
    x = np.linalg.lstsq(A.reshape(-1, 7), p.ravel(), rcond=1e-9)[0]
    return x[:3], x[3:6], float(x[6])


def _angles(x: Array, w: Array, arm: Array, about: Array) -> Array:
    """Angles (n,) about w that bring the arm nearest to positions x (n, 3) from the centre, near those of rotations."""
    across = np.cross(w, arm)
    a = np.arctan2(x @ across, x @ (arm - w * (w @ arm)))
    return about + (a - about + np.pi) % (2.0 * np.pi) - np.pi
