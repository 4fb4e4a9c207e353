"""What columns of distances, directions and heights mean, told by the reading by which the nominal arm meets them.

As :mod:`meanings` does for poses and points. The instruments of one reading and the tool's point are fitted together;
what is left has a likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import Instrument, new_instruments, place_instruments
from modcal_core.geometry import Array, descend, se3, so3
from modcal_core.hypotheses.hand_eye import INDEPENDENT, OF_MOTION, likeliest
from modcal_core.hypotheses.meanings import ARM_SHARE
from modcal_core.measurements import Samples, spread_rows
from modcal_core.measurements.kinds import scene_in
from modcal_core.robots import Chain, forward

_MAX = 120  # rows, evenly along the table; each trial of a tool places the instruments again
_NOMINAL = {"m": 1e-3, "rad": 1e-3}  # of the reach, and rad, per direction: finer says nothing of a nominal arm
_STARTS, _GOOD = 0.15, 0.005  # of the reach: starts of the tool, and a median miss that needs no further one
_HOPELESS = 0.1  # of the reach; no other start improves what misses by more after three
_STEPS = 30  # iterations
_SOFT = 1e-4  # m²; misses beyond a centimetre count less
_SETTLED = 1e-6  # share of the cost that a last step gains


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
    tip = forward(chain, samples.q)
    instruments = new_instruments(samples)
    best: Sequence[_PlacedResidual] = ()
    for tried, start in enumerate((np.zeros(3), *(_STARTS * chain.reach() * np.r_[np.eye(3), -np.eye(3)]))):
        seen = _fitted(instruments, samples, tip, start)
        if not best or _middle(seen) < _middle(best):
            best = seen
        if _middle(best) < _GOOD * chain.reach() or (tried == 2 and _middle(best) > _HOPELESS * chain.reach()):
            break
    total, spread = 0.0, []
    for one in best:
        floor = _NOMINAL[one.unit] * (chain.reach() if one.unit == "m" else 1.0)
        square = np.sum(one.residual**2, axis=0)
        anywhere = one.dimensions * np.log(4.0 * max(float(np.sqrt(square.max())), floor))
        total += float(likeliest(square, floor, anywhere, np.inf, one.dimensions).sum())
        change = np.linalg.norm(one.reading - np.median(one.reading, axis=0), axis=1)
        spread.append(float(np.median(change * one.lever)))
    cost = 0.5 * (3.0 + 6.0 * len(best)) * np.log(len(rows))  # BIC: tool, and six values an instrument at most
    score = (total + len(rows) * log_volume) * min(1.0, INDEPENDENT / len(rows)) - cost
    return SightMatch(float(score), _middle(best), float(np.median(spread)))


@dataclass(frozen=True)
class _PlacedResidual:
    """What one placed instrument leaves: residual (3, m) in its unit, lever (m,) [m per unit]; reading (m, 3)."""

    residual: Array
    lever: Array
    reading: Array
    unit: str
    dimensions: int

    @property
    def square(self) -> Array:
        """Squares of what is left [m²], (m,)."""
        return np.asarray(np.sum((self.residual * self.lever) ** 2, axis=0))


def _middle(seen: Sequence[_PlacedResidual]) -> float:
    """Median of what instruments leave [m]."""
    return float(np.median(np.concatenate([np.linalg.norm(s.residual * s.lever, axis=0) for s in seen])))


@dataclass(frozen=True)
class _Setup:
    """The tool's place x in the tip, instruments and poses of their frames; what they leave, and its derivatives
    (m, 3, k) by the tool and by what is an instrument's own.
    """

    x: Array
    instruments: tuple[Instrument, ...]
    poses: Array
    seen: tuple[_PlacedResidual, ...]
    derivatives: tuple[Array, ...]

    @classmethod
    def of(cls, x: Array, instruments: Sequence[Instrument], poses: Array, samples: Samples, tip: Array) -> _Setup:
        """At tip poses (N, 4, 4)."""
        seen, derivatives = [], []
        for instrument in instruments:
            rows, kind = instrument.rows(samples), instrument.of_kind
            tool, reading = tip[rows] @ se3.transform(p=x), samples.reading[rows]
            scene = scene_in(poses[samples.frames.index(instrument.frame)], tool)
            sight = kind.see(scene, instrument.values, reading)
            seen.append(_PlacedResidual(sight.residual, sight.lever, reading, kind.unit, kind.dimensions))
            through = np.moveaxis(sight.through, 2, 0)
            by_change = instrument.moved_by(np.zeros(len(kind.constants)))
            own = np.moveaxis(sight.constants, (0, 2), (2, 0)) @ by_change
            J = np.concatenate([through @ tool[:, :3, :3], through, -through @ so3.hat(scene.target.T), own], axis=2)
            derivatives.append(J * sight.lever[:, None, None])
        return cls(x, tuple(instruments), poses, tuple(seen), tuple(derivatives))

    @property
    def cost(self) -> float:
        """Robust sum of what all of them leave."""
        return sum(float(np.sum(np.log1p(one.square / _SOFT))) for one in self.seen)


def _fitted(
    instruments: Sequence[Instrument], samples: Samples, T_base_tip: Array, start: Array
) -> Sequence[_PlacedResidual]:
    """What instruments leave when they and the tool are fitted together, from a tool's place in the tip.

    An instrument's frame that moves by a twist (v, ω) changes the prediction as its target would by v + ω × p.
    """
    at = np.tile(np.eye(4), (len(samples.frames), 1, 1))
    placed, poses = place_instruments(instruments, samples, T_base_tip @ se3.transform(p=start), at)
    ends = 3 + np.cumsum([6 + len(i.constants) for i in placed])
    columns = [np.r_[0:3, end - 6 - len(i.constants) : end] for i, end in zip(placed, ends, strict=True)]
    equations: list[Array] = []

    def look(here: _Setup) -> float:
        A, g = np.zeros((int(ends[-1]), int(ends[-1]))), np.zeros(int(ends[-1]))
        for one, J, own in zip(here.seen, here.derivatives, columns, strict=True):  # instruments share the tool alone
            weighted = J / (1.0 + one.square / _SOFT)[:, None, None]
            A[np.ix_(own, own)] += np.tensordot(weighted, J, ([0, 1], [0, 1]))
            g[own] += np.tensordot(weighted, (one.residual * one.lever).T, ([0, 1], [0, 1]))
        equations[:] = A, g
        return here.cost

    def step(here: _Setup, damping: float) -> tuple[_Setup, float]:
        A, g = equations
        change = np.asarray(np.linalg.lstsq(A + damping * np.diag(np.diag(A) + 1e-9), g, rcond=None)[0], dtype=float)
        poses, moved = here.poses.copy(), []
        for instrument, own in zip(here.instruments, columns, strict=True):
            f = samples.frames.index(instrument.frame)
            poses[f] = poses[f] @ se3.exp(change[own[3:9]])
            moved.append(instrument.moved(change[own[9:]]))
        there = _Setup.of(here.x + change[:3], moved, poses, samples, T_base_tip)
        return there, there.cost

    begin = _Setup.of(start, placed, poses, samples, T_base_tip)
    return descend(begin, look, step, lambda _, gain, cost: gain < _SETTLED * cost, _STEPS).place.seen


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
