"""Whether rotations do not follow the handle because they, or the positions, were written in another convention.

A door whose quaternions w x y z are read as x y z w turns about another axis at every pose; inverse rotations turn the
other way; in a left-handed frame positions go round the other way than rotations. Each follows none of the joint types,
or looks like a grasp that turns in the hand. Read as written they follow a joint with certainty, which no such grasp
does.

Several conventions may do so alike: where a door turns about the frame's z, a reversed x is as good as a reversed y,
and inverse rotations may be as good as either. Then all of them are named, for nothing in the track tells them apart.
What turns against its path, as the second leaf of a folding door does, looks like them on a part of its way. It is no
joint either, so the remedy says what to do about it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.articulation.choice import Choice, choose
from modcal_core.articulation.models.model import Kind
from modcal_core.articulation.models.registry import STILL
from modcal_core.articulation.track import Track
from modcal_core.errors import BadRecording
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array

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
        """Median angle [rad] between its rotations and the turns (n, 3, 3) of a handle that is held firmly.

        turns: by the positions as they were written.
        """
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
        return OtherConvention(
            offenders[0], f"{_READ[offenders[0]]} they follow no joint, {ways[0]} a {kind} one", remedy
        )
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
