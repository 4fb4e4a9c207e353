"""First guesses of a motion, robust to any share of gross outliers below a half: MLESAC over few samples.

Torr and Zisserman, MLESAC (2000): motions through randomly chosen samples are scored by a likelihood that is cut off
where an outlier begins, and the best are kept. Three positions give a circle, two a line, two poses a screw motion.
Samples are drawn by their order only, so a track that is moved or mirrored gets the moved or mirrored guesses.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from modcal_core.articulation.motion import Motion
from modcal_core.articulation.track import Track
from modcal_core.geometry.single import crossed
from modcal_core.geometry.so3 import Array

_TRIES = 40  # random triples of samples
KEEP = 2  # guesses that are fitted
_SCORED = 50  # samples that a guess is scored on
ROUGH = (5e-3, 0.07)  # m and rad: noise when nothing is known of it yet
_CUT = 9.0  # squared, normalised residual at which an outlier begins
_PAIRS = 10  # of rotations
M = TypeVar("M", bound=Motion)


def few(track: Track) -> Track:
    """Some of its samples, evenly chosen, that guesses are scored on."""
    return track.part(np.unique(np.linspace(0, len(track) - 1, _SCORED).round().astype(int)))


def best_of(guesses: Iterable[M], track: Track, keep: int) -> list[M]:
    """The best of these guesses, best first, by a likelihood that is cut off."""
    sound = [g for g in guesses if g.sound()]
    scored = sorted((_score(g, track), i) for i, g in enumerate(sound))
    return [sound[i] for _, i in scored[:keep]]


def _score(guess: Motion, track: Track) -> float:
    """Cut-off negative log-likelihood."""
    e = guess.residuals(track, guess.configurations(track, ROUGH))
    z = (e[:, :3] ** 2).sum(axis=1) / ROUGH[0] ** 2
    if e.shape[1] == 6:
        z = np.minimum(z, _CUT) + np.minimum((e[:, 3:] ** 2).sum(axis=1) / ROUGH[1] ** 2, _CUT)
    cost = float(np.minimum(z, 2.0 * _CUT if e.shape[1] == 6 else _CUT).sum())
    # The rise of a thread and the width of a circle are bounded by what exists; ties go to the nearer axis.
    return cost + guess.rarity()


def some_three(track: Track, rng: np.random.Generator) -> Iterator[tuple[int, NDArray[np.integer[Any]]]]:
    """The number of each try, and three rows that are drawn for it, in their order."""
    for t in range(_TRIES):
        yield t, np.sort(rng.choice(len(track), 3, replace=False))


def far_apart(track: Track) -> tuple[int, int, int]:
    """Rows of the two samples that are farthest apart, with one between them in the middle."""
    p = track.positions
    middle = p - p.mean(axis=0)
    first = int(np.argmax((middle * middle).sum(axis=1)))
    away = ((p - p[first]) ** 2).sum(axis=1)
    last = int(np.argmax(away))
    return first, int(np.argmin(np.abs(away - 0.25 * away[last]))), last


def frame(e: Array) -> Array:
    """A frame (3, 3) whose first axis is along e."""
    e = e / math.sqrt(e @ e)
    n = np.eye(3)[int(np.argmin(np.abs(e)))]
    n = n - e * (e @ n)
    n = n / math.sqrt(n @ n)
    return np.array([e, n, crossed(e, n)]).T


def middle_rotation(rotations: Array) -> Array:
    """The rotation with the smallest median distance to the others: a median that outliers do not move."""
    some = rotations[np.unique(np.linspace(0, len(rotations) - 1, _PAIRS * 3).round().astype(int))]
    apart = np.linalg.norm(some[:, None] - some[None], axis=(2, 3))
    return some[int(np.argmin(np.median(apart, axis=1)))]
