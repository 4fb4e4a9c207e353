"""Whether rotations do not follow the handle because their quaternions were read in another order than written.

A door whose quaternions w x y z are read as x y z w turns about another axis at every pose: none of the joint types,
or a grasp that turns in the hand. Read in the other order they follow a joint with certainty, which no such grasp does.
"""

from __future__ import annotations

import numpy as np

from modcal_core.articulation.choice import Choice, choose
from modcal_core.articulation.models.registry import STILL
from modcal_core.articulation.track import Track
from modcal_core.errors import BadRecording
from modcal_core.geometry import so3


def require_order(track: Track, choice: Choice, rng: np.random.Generator | None = None) -> None:
    """Raise BadRecording where rotations that follow no joint would follow one if they were read as w x y z.

    choice: what was found for the track as it is. rng: picks samples for first guesses.
    """
    if track.rotations is None or (choice.follows and not choice.misfit.fails):
        return
    written = so3.from_quaternion(so3.to_quaternion(track.rotations)[:, [1, 2, 3, 0]])
    other = choose(Track(track.positions, written, track.stamps), rng)
    if other.enough and other.follows and other.best != STILL.name:
        raise BadRecording(
            "track, quaternions",
            f"read as x y z w they follow no joint, read as w x y z a {other.best} one",
            "give x y z w",
        )
