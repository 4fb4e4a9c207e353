"""Signals that say what was told rather than what a sensor saw: a payload, a tool's number, an output on or off.

They come when something changes, in round numbers, and hold until the next message; between two of them there is no
course. What a sensor saw is interpolated.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array

_DIGITS = 4  # significant ones that people write; a sensor's floating-point number has seven or more
_SAME = 1e-6  # relative; rounding of single precision is a tenth of it
_JUMP = 0.05  # of the range, from one message to the next, usually; what is sampled often enough changes by less
_BEHIND = 0.1  # s within which messages of one note follow each other, far below the time to the next station


def is_told(x: Array) -> bool:
    """Whether values (m,) in the order of their stamps are round numbers that jump from message to message."""
    if len(x) < 2 or not np.ptp(x) > 0.0:
        return False
    known = np.abs(x[x != 0.0])
    with np.errstate(over="ignore", invalid="ignore"):  # numbers near the ends of what is a number are not round
        scaled = known * 10.0 ** (_DIGITS - 1 - np.floor(np.log10(known)))
        is_round = bool(np.all(np.abs(scaled - np.round(scaled)) <= _SAME * scaled))
    return is_round and float(np.median(np.abs(np.diff(x)))) > _JUMP * float(np.ptp(x))


def told_at(t: Array, x: Array, stamps: Array, moving: np.ndarray) -> Array:
    """What holds at the stamps (N,) [s] of values x (m,) told at rising t (m,); the first before that.

    moving: samples (N,) taken in motion; at all others what is told just behind belongs to the same station.
    """
    at = stamps + np.where(moving, 0.0, _BEHIND)
    return np.asarray(x[np.maximum(np.searchsorted(t, at, side="right") - 1, 0)])


def staircase(t: Array, x: Array, step: float) -> tuple[Array, Array]:
    """The same commands as a course that rises within a step [s] before each message, stamps (2 m,) and values."""
    before = np.maximum(t[1:] - step, t[:-1])
    return np.r_[t[0], np.stack([before, t[1:]], axis=1).ravel()], np.r_[
        x[0], np.stack([x[:-1], x[1:]], axis=1).ravel()
    ]
