"""What columns of distances, directions and heights mean, told by the reading by which the nominal arm meets them.

As :mod:`meanings` does for poses and points. The instruments of one reading and the tool's point are fitted together;
what is left has a likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import find_tool, new_instruments
from modcal_core.geometry import Array
from modcal_core.hypotheses.hand_eye import INDEPENDENT, OF_MOTION, likeliest
from modcal_core.hypotheses.meanings import ARM_SHARE
from modcal_core.measurements import Samples, spread_rows
from modcal_core.robots import Chain, forward

_MAX = 120  # rows, evenly along the table; each trial of a tool places the instruments again
_NOMINAL = {"m": 1e-3, "rad": 1e-3}  # of the reach, and rad, per direction: finer says nothing of a nominal arm
_HOPELESS = 0.1  # of the reach; no other start improves what misses by more after three


@dataclass(frozen=True)
class Sighting:
    """Readings of one instrument. kind: range, bearing, plane or ray. values: (N, width), in m or as unit vectors, NaN
    where it read nothing.
    """

    frame: str
    kind: str
    values: Array


@dataclass(frozen=True)
class SightMatch:
    """How well the nominal arm meets readings. score: log-likelihood less what parameters cost. typical: median of what
    is left, spread: of what the readings vary by, both [m] at the tool.
    """

    score: float
    typical: float
    spread: float

    def explained(self, chain: Chain) -> bool:
        """Whether what is left is what a nominal arm may be wrong by, and little of what moves."""
        return self.typical <= min(ARM_SHARE * chain.reach(), OF_MOTION * self.spread)


def sights_match(chain: Chain, q: Array, sightings: Sequence[Sighting], log_volume: float = 0.0) -> SightMatch:
    """How well readings taken at postures q (N, n) fit, every instrument placed again and one tool for all of them.

    log_volume: of one row, by how much the readings' volume was shrunk to have them in m and rad, in logarithm.
    """
    rows = spread_rows(len(q), _MAX)
    samples = _samples(q[rows], [Sighting(s.frame, s.kind, s.values[rows]) for s in sightings])
    best = find_tool(new_instruments(samples), samples, forward(chain, samples.q), hopeless=_HOPELESS)
    total, spread = 0.0, []
    for one in best.seen:
        floor = _NOMINAL[one.unit] * (chain.reach() if one.unit == "m" else 1.0)
        square = np.sum(one.residual**2, axis=0)
        anywhere = one.dimensions * np.log(4.0 * max(float(np.sqrt(square.max())), floor))
        total += float(likeliest(square, floor, anywhere, np.inf, one.dimensions).sum())
        change = np.linalg.norm(one.reading - np.median(one.reading, axis=0), axis=1)
        spread.append(float(np.median(change * one.lever)))
    cost = 0.5 * (3.0 + 6.0 * len(best.seen)) * np.log(len(rows))  # BIC: tool, and six values an instrument at most
    score = (total + len(rows) * log_volume) * min(1.0, INDEPENDENT / len(rows)) - cost
    return SightMatch(float(score), best.middle, float(np.median(spread)))


def _samples(q: Array, sightings: Sequence[Sighting]) -> Samples:
    frames = tuple(dict.fromkeys(s.frame for s in sightings))
    read = [np.flatnonzero(np.isfinite(s.values).all(axis=1)) for s in sightings]
    reading = np.concatenate(
        [np.pad(s.values[rows], ((0, 0), (0, 3 - s.values.shape[1]))) for s, rows in zip(sightings, read, strict=True)]
    )
    counts = [len(rows) for rows in read]
    return Samples(
        names=(),
        frames=frames,
        q=q[np.concatenate(read)],
        station=np.concatenate(read),
        frame=np.repeat([frames.index(s.frame) for s in sightings], counts),
        kind=np.repeat([s.kind for s in sightings], counts),
        reading=reading,
    )
