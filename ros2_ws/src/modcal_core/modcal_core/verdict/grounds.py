"""What a verdict has to know besides errors: regimes, what was not applied or rejected, contradictions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from modcal_core.calibration import Errors, ErrorSize, Model, RejectedPlace, station_numbers
from modcal_core.measurements import Samples
from modcal_core.moves import moves_of
from modcal_core.verdict.verdict import NotAsked


@dataclass(frozen=True)
class Regime:
    """Stations ``from_station`` … ``to_station`` (in order of time, the last one included) that have a base, a tool or
    both of their own.
    """

    from_station: int
    to_station: int
    what: Literal["base", "tool", "both"]


@dataclass(frozen=True)
class NotApplied:
    """An effect of the model that this recording lacks a driver for, or that another one cannot continue, why, and what
    that costs [mm²].
    """

    effect: str
    why: str
    cost_mm2: float


@dataclass(frozen=True)
class Grounds:
    """What a verdict has to know besides the errors.

    converged: whether every fit reached its minimum. regimes, not_applied: see there. contradictions: a sentence for
    each thing that the data contradict or that makes the readings doubtful (a known distance, a stated tool, a reading
    that was computed from the joints); each makes the status open. convention: what was undone by itself
    ("pose inverted"), None if nothing. rejected_runs: runs (first, last station in order of time) of at least three
    neighbours that were rejected and belong to no regime. rejected_places: the same of neighbours by a joint's
    position. outside: sentences on what lies outside what a frozen
    calibration has seen. unproven: why it is not certain that the readings were measured, which bars a PASS and
    *at the floor*. not_asked: what the recording is too small for.
    """

    converged: bool = True
    regimes: tuple[Regime, ...] = ()
    not_applied: tuple[NotApplied, ...] = ()
    contradictions: tuple[str, ...] = ()
    convention: str | None = None
    rejected_runs: tuple[tuple[int, int], ...] = ()
    rejected_places: tuple[RejectedPlace, ...] = ()
    outside: tuple[str, ...] = ()
    unproven: tuple[str, ...] = ()
    not_asked: tuple[NotAsked, ...] = ()


def regimes_of(model: Model, samples: Samples) -> tuple[Regime, ...]:
    """Stretches of stations, in order of time, that base or tool were moved between; empty where nothing moved.

    what: that of the move which begins the stretch; of the first one, of the move that ends it.
    """
    moves = moves_of(model)
    number = station_numbers(samples)
    part = np.searchsorted([move.at for move in moves], samples.stamps, side="right")
    parts = [number[part == k] for k in range(len(moves) + 1)]
    if not moves or not all(len(rows) for rows in parts):
        return ()
    return tuple(Regime(int(rows.min()), int(rows.max()), moves[max(k - 1, 0)].what) for k, rows in enumerate(parts))


_SINGLE = 0.03  # chance that a reading is wrong by itself: a reflection, a target that was lost
_SURE = 0.01  # chance of as many single wrong readings, below which they are something else


def too_many(wrong: np.ndarray, samples: Samples) -> bool:
    """Whether more stations hold a rejected sample (True, (N,)) than single wrong readings make up (binomial)."""
    from scipy.special import bdtrc

    count, of = len(np.unique(samples.station[wrong])), samples.stations
    return count > 0 and float(bdtrc(count - 1, of, _SINGLE)) < _SURE


@dataclass(frozen=True)
class Rejected:
    """RMS position error on held-out with the rejected readings and without them [mm]; None where there is nothing to
    tell it from. stations: with a rejected reading, of so many, in the whole recording (held-out where frozen).
    """

    with_mm: float | None
    without_mm: float | None
    stations: int
    of: int

    @property
    def share(self) -> float:
        """Share of the stations that were rejected."""
        return self.stations / max(self.of, 1)


def rejection(
    residuals: Errors, wrong: np.ndarray, samples: Samples, held_out: np.ndarray, frozen: bool = False
) -> Rejected:
    """What is rejected of these samples.

    residuals: errors of the samples held out. wrong: True for rejected samples, (N,). held_out: rows of those held out.
    frozen: whether only those were judged.
    """
    kept = ~wrong[held_out]
    return Rejected(
        _rms_mm(residuals.position_norm),
        _rms_mm(residuals.position_norm[kept]),
        len(np.unique(samples.station[wrong])),
        len(np.unique(samples.station[held_out])) if frozen else samples.stations,
    )


def _rms_mm(norms: np.ndarray) -> float | None:
    size = ErrorSize.of(1e3 * norms)
    return None if size is None else size.rms
