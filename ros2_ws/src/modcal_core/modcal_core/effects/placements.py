"""What people put back by hand, and what of an arm moves readings in the same way.

A target, a tool, a tracker or a base is taken off, knocked and put back; a zero, a gear or a link changes with the arm
itself. Where the two move the readings alike they share their probability, and a repair goes to what is put back by
hand: the arm would be bent for nothing, and its orientation with it where points are read.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.geometry import Array

AS_LIKELY = 3.5  # in log-likelihood (33 to 1), within which two placements move the readings alike
_ONE_MOTION = {"base": "tracker", "tool": "target"}  # two names of one placement: neither moves but against the other
OF_FRAME = "frame "  # what the place of an instrument begins with, before its frame


def one_motion(place: str) -> tuple[str, ...]:
    """The other name of a placement, for ``same_as``; none of a place of the arm."""
    return (_ONE_MOTION[place],) if place in _ONE_MOTION else ()


def of_readings(place: str) -> bool:
    """Whether a place is an instrument, where effects change what is read and move no tool."""
    return place == "tracker" or place.startswith(OF_FRAME)


def by_hand(place: str) -> bool:
    """Whether people put a place back by hand, or an instrument that stands there."""
    return place in (*_ONE_MOTION, *_ONE_MOTION.values()) or of_readings(place)


def put_back_first(best: int, outside: Sequence[bool], log_likelihood: Array, within: float = AS_LIKELY) -> int:
    """The number of what is to be repaired: the best, or what outside the arm explains the readings as well.

    outside: of each, whether people put it back by hand. log_likelihood: (C,), each with its sizes at their best.
    """
    if outside[best]:
        return best
    likely = np.where(outside, log_likelihood, -np.inf)
    first = int(np.argmax(likely))
    return first if likely[first] > log_likelihood[best] - within else best
