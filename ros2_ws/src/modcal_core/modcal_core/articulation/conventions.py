"""Rotations that follow no joint, and the convention in which they would follow one.

A door whose quaternions w x y z are read as x y z w turns about another axis at every pose; inverse rotations turn the
other way; in a left-handed frame positions go round the other way. Each follows none of the joint types, or looks like
a grasp that turns in the hand. Read as written they follow a joint with certainty, which no such grasp does. Several
conventions may do so alike; then all of them are named. The second leaf of a folding door looks like them for a while.

While poses come, the joint is found in closed form: rotations turn about one axis w, and a handle that is held firmly
lies where they bring it,

    R_i = exp(δ_i w) M,    p_i = exp(δ_i w) y + c + h δ_i w,

which is linear in arm y, centre c and rise h. Conventions are named where rotations as written leave too much for any
such joint, and in another convention no more than usual furniture and tracking do. A short piece of any path fits a
screw in most conventions: while one does, and the path lies in a plane, which a screw's does not, nothing is said.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.articulation.choice import Choice, choose
from modcal_core.articulation.joint_motion import Kind
from modcal_core.articulation.misfit import limits, rms, too_much, usual
from modcal_core.articulation.models.registry import STILL
from modcal_core.articulation.models.revolute import RevoluteMotion
from modcal_core.articulation.models.screw import ScrewMotion
from modcal_core.articulation.track import Track
from modcal_core.errors import BadRecording
from modcal_core.geometry import Array, so3

ORDER, INVERSE, MIRROR = "quaternions", "rotations", "positions"
_READ = {
    ORDER: "read as x y z w",
    INVERSE: "read as the handle's in the frame of the positions",
    MIRROR: "with rotations",
}
_OTHERWISE = {ORDER: "read as w x y z", INVERSE: "read as their inverses"}
_REMEDIES = {ORDER: "give x y z w", INVERSE: "give the rotation of the handle in the frame of its positions"}
_AGAINST = "of what turns against its path, as a folding leaf does, give positions alone"
RIVAL = 2.0  # times what the best convention leaves: of those that are right alike, noise leaves alike


@dataclass(frozen=True)
class ReadOtherwise:
    """A track in another convention. offender: what would be written so; axis: whose sign is reversed, if one is."""

    offender: str
    track: Track
    axis: str = ""

    def missed(self, turns: Array) -> float:
        """Median angle [rad] between its rotations and turns (n, 3, 3), by positions as written, of a firm grasp."""
        assert self.track.rotations is not None
        if self.axis:
            mirror = np.where(np.array(list("xyz")) == self.axis, -1.0, 1.0)
            turns = mirror[:, None] * turns * mirror
        grasp = np.swapaxes(turns, 1, 2) @ self.track.rotations
        return float(np.median(np.linalg.norm(so3.log(so3.mean(grasp).T @ grasp), axis=-1)))


@dataclass(frozen=True)
class OtherConvention:
    """Texts of a refusal: offender, the convention in which a track seems to be written, and remedy."""

    offender: str
    said: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.offender}: {self.said}: {self.remedy}"


def readings(track: Track) -> Iterator[ReadOtherwise]:
    """The track, which has rotations, in other conventions."""
    p, R = track.positions, track.rotations
    assert R is not None
    order = so3.from_quaternion(so3.to_quaternion(R)[:, [1, 2, 3, 0]])
    yield ReadOtherwise(ORDER, Track.trusted(p, order))
    yield ReadOtherwise(INVERSE, Track.trusted(p, np.swapaxes(R, 1, 2)))
    for i, axis in enumerate("xyz"):
        yield ReadOtherwise(MIRROR, Track.trusted(p * np.where(np.arange(3) == i, -1.0, 1.0), R), axis)


def written(found: Sequence[ReadOtherwise], kind: Kind) -> OtherConvention:
    """Refusal where rotations follow a joint of this kind in one or more other conventions."""
    axes = [reading.axis for reading in found if reading.axis]
    offenders = list(dict.fromkeys(reading.offender for reading in found))
    ways = [_OTHERWISE[one] for one in offenders if one != MIRROR]
    remedies = [_REMEDIES[one] for one in offenders if one != MIRROR]
    if axes:
        ways.append(f"with the sign of {_either(axes)} reversed (a left-handed frame)")
        remedies.append(f"correct the sign of {_either(axes)}, or the order of the columns")
    if offenders != [ORDER]:
        remedies.append(_AGAINST)
    remedy = "; or ".join(remedies)
    if len(found) == 1:
        said = f"{_READ[offenders[0]]} they follow no joint, {ways[0]} a {kind} one"
        return OtherConvention(offenders[0], said, remedy)
    said = f"with rotations they follow no joint, {_either(ways)} a {kind} one; which of these, the track does not tell"
    return OtherConvention("poses" if len(offenders) > 1 else offenders[0], said, f"see which it is: {remedy}")


def _either(words: Sequence[str]) -> str:
    return " or ".join(words)


def require_convention(track: Track, choice: Choice, rng: np.random.Generator | None = None) -> None:
    """Raise BadRecording where rotations that follow no joint would follow one in another convention.

    choice: what was found for the track as it is. rng: picks samples for first guesses.
    """
    if track.rotations is None or (choice.follows and not choice.misfit.fails):
        return
    alone = choose(track.points(), rng) if choice.follows else choice  # else positions alone have told already
    fit = alone.fit
    turns = fit.model.pose(fit.configurations)[:, :3, :3]
    ranked = sorted(readings(track), key=lambda reading: reading.missed(turns))
    likely = [reading for reading in ranked if reading.missed(turns) <= RIVAL * ranked[0].missed(turns)]
    best, found = "", list[ReadOtherwise]()
    for reading in likely:
        other = choose(Track(reading.track.positions, reading.track.rotations, track.stamps), rng)
        if other.enough and other.follows and other.best != STILL.name and best in ("", other.best):
            best = other.best
            found.append(reading)
        elif not found:
            return  # the likeliest follows none, which others hardly do
    said = written(found, best)
    raise BadRecording(f"track, {said.offender}", said.said, said.remedy)


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

    def ask(self, nodes: Track, noise: tuple[float, float]) -> None:
        """Ask again. nodes: the path so far, pooled, with rotations. noise: of one pose [m, rad]."""
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
