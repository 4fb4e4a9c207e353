"""Whether rotations do not follow the handle because they, or the positions, were written in another convention.

A door whose quaternions w x y z are read as x y z w turns about another axis at every pose; inverse rotations turn the
other way; in a left-handed frame positions go round the other way than rotations. Each follows none of the joint types,
or looks like a grasp that turns in the hand. Read as written they follow a joint with certainty, which no such grasp
does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from modcal_core.articulation.choice import Choice, choose
from modcal_core.articulation.models.registry import STILL
from modcal_core.articulation.track import Track
from modcal_core.errors import BadRecording
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class _Reading:
    """offender, said, remedy: of the refusal, of which the kind of joint is the end of said. positions (n, 3) [m],
    rotations (n, 3, 3): the track, so read. turns: of the handle in positions so read, (n, 3, 3).
    """

    offender: str
    said: str
    remedy: str
    positions: Array
    rotations: Array
    turns: Array

    def missed(self) -> float:
        """Median angle [rad] between the rotations and the turns of a handle that is held firmly."""
        grasp = np.swapaxes(self.turns, 1, 2) @ self.rotations
        return float(np.median(np.linalg.norm(so3.log(so3.mean(grasp).T @ grasp), axis=-1)))


def require_convention(track: Track, choice: Choice, rng: np.random.Generator | None = None) -> None:
    """Raise BadRecording where rotations that follow no joint would follow one in another convention.

    choice: what was found for the track as it is. rng: picks samples for first guesses.
    """
    if track.rotations is None or (choice.follows and not choice.misfit.fails):
        return
    alone = choose(track.points(), rng) if choice.follows else choice  # else positions alone have told already
    fit = alone.fit
    written = min(_readings(track, fit.model.pose(fit.configurations)[:, :3, :3]), key=_Reading.missed)
    other = choose(Track(written.positions, written.rotations, track.stamps), rng)
    if other.enough and other.follows and other.best != STILL.name:
        raise BadRecording(f"track, {written.offender}", f"{written.said} a {other.best} one", written.remedy)


def _readings(track: Track, turns: Array) -> Iterator[_Reading]:
    """The track in other conventions. turns: of a handle that moves as its positions say, (n, 3, 3)."""
    p, R = track.positions, track.rotations
    assert R is not None
    order = so3.from_quaternion(so3.to_quaternion(R)[:, [1, 2, 3, 0]])
    said = "read as x y z w they follow no joint, read as w x y z"
    yield _Reading("quaternions", said, "give x y z w", p, order, turns)
    said = "read as the handle's in the frame of the positions they follow no joint, read as their inverses"
    remedy = "give the rotation of the handle in the frame of its positions"
    yield _Reading("rotations", said, remedy, p, np.swapaxes(R, 1, 2), turns)
    for i, axis in enumerate("xyz"):
        mirror = np.where(np.arange(3) == i, -1.0, 1.0)
        said = f"with rotations they follow no joint, with the sign of {axis} reversed (a left-handed frame)"
        remedy = f"correct the sign of {axis}, or the order of the columns"
        yield _Reading("positions", said, remedy, p * mirror, R, mirror[:, None] * turns * mirror)
