"""What the readings leave open at the tool, in words, and what would show it.

A remedy is tried on the draws: of what is open that part stays which the new reading does not predict.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry import Array

_ENOUGH = 0.5  # of what is open; a reading that leaves less shows it
_DISTANCE_M = 5e-5  # what a distance is known to
_MORE = "More stations make it narrower."


@dataclass(frozen=True)
class OpenDirection:
    """what: is open, empty where the readings show nearly all. remedy: a sentence with what would make the claim
    narrower.
    """

    what: str = ""
    remedy: str = _MORE


def open_direction(unshown: Array, p: Array, positions: bool) -> OpenDirection:
    """What is open.

    unshown: errors of the tool (D, 3 M) [m] that no reading holds, a row a draw. p: where the tool is, (3, M) [m].
    positions: whether the readings are positions in a frame that stands still.
    """
    if positions:
        return OpenDirection(
            "what these postures do not show", "More stations, over the ranges of all joints, show it."
        )
    grown = (p - p.mean(axis=1, keepdims=True)).ravel()
    share = _left(unshown, unshown @ grown / np.linalg.norm(grown), 0.0)
    what = "the scale" if share < _ENOUGH else "directions across those of the readings"
    gaps = np.linalg.norm(p[:, :, None] - p[:, None], axis=0)
    one, other = np.unravel_index(int(gaps.argmax()), gaps.shape)
    along = (p[:, one] - p[:, other]) / gaps[one, other]
    by_axis = unshown.reshape(len(unshown), 3, -1)
    distance = (by_axis[:, :, one] - by_axis[:, :, other]) @ along
    if _left(unshown, distance, _DISTANCE_M) < _ENOUGH:
        return OpenDirection(what, "One known distance shows it (a bar, or between two sockets), and so do positions.")
    return OpenDirection(what, "Readings of position show it: a tracker, or sockets with known distances between them.")


def _left(error: Array, reading: Array, std: float) -> float:
    """The share of errors (D, 3 M), as RMS, that is left once a reading (D,) of this deviation is known."""
    seen = reading @ error / (reading @ reading + len(reading) * std**2)
    whole = max(float(np.linalg.norm(error)), 1e-300)
    return float(np.linalg.norm(error - np.outer(reading, seen))) / whole
