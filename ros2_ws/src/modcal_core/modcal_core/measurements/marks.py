"""Marks of readings, by which a recording is known again.

A posture and what was read there, to a microradian and a micrometre, do not come again: who finds them in two
recordings looks at the same measurement twice. A few marks of a recording are enough to tell how much of another one it
holds: those with the least numbers, which are a random choice of them (Broder 1997).
"""

from __future__ import annotations

import numpy as np

from modcal_core.measurements.samples import Samples

_KEPT = 256  # marks: a recording that holds a twentieth of these samples shares a dozen of them
_FINEST = 1e-6  # m, rad, s; far above what another reader rounds, far below what an arm repeats and a clock counts
_BITS = np.uint64(16)  # taken off, so that a mark is a number that any reader of YAML keeps


def marks_of(samples: Samples) -> tuple[int, ...]:
    """The least of the samples' marks, in order, at most 256."""
    return tuple(np.unique(_marks(samples))[:_KEPT].tolist())


def share_of_known(marks: tuple[int, ...], samples: Samples) -> float:
    """Which share of the samples is in the recording that had these marks, as far as they tell; 0 without marks."""
    if not marks:
        return 0.0
    own = _marks(samples)
    comparable = own if len(marks) < _KEPT else own[own <= marks[-1]]
    return float(np.isin(comparable, marks).mean()) if len(comparable) else 0.0


def _marks(samples: Samples) -> np.ndarray:
    """A number of 48 bits for each sample, (N,): of its posture, its reading, and the time if that is one."""
    time = samples.stamps[:, None] if samples.clock else np.empty((len(samples), 0))
    values = np.concatenate([samples.q, samples.reading, samples.R.reshape(-1, 9), time], axis=1)
    with np.errstate(over="ignore"):
        digits = np.round(values / _FINEST).astype(np.int64).view(np.uint64)
        mark = np.zeros(len(digits), np.uint64)
        for column in digits.T:  # splitmix64 (Steele, Lea and Flood 2014)
            mark = mark + column + np.uint64(0x9E3779B97F4A7C15)
            mark = (mark ^ (mark >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            mark = (mark ^ (mark >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            mark = mark ^ (mark >> np.uint64(31))
    return mark >> _BITS
