"""What other stages found that a verdict has to know: regimes, effects that could not be applied, contradictions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from modcal_core.calibration import RejectedPlace
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
