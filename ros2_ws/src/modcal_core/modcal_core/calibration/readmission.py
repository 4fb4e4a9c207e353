"""Rejected samples that no other sample speaks against: a learned curve is known there from rejected ones alone.

Geometry misses by far where a curve is large, and a fit begins from geometry. Where a recording has few stations, all
of them may then be rejected before the curve could bend to them, and what is left of it there is nobody's: it misses
them for ever, and they stay rejected. A wrong reading is one that its neighbours contradict; three that have no other
neighbours are to be fitted first and judged then.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.data_split import consecutive
from modcal_core.calibration.distances import AnyDistance
from modcal_core.calibration.final_fit import sharpened
from modcal_core.calibration.fit import FITTED, Fit, identify
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.score import outlying
from modcal_core.effects import claimed
from modcal_core.measurements import Samples

_LOST = 0.5  # of a function's squares, less of which is left to samples that count: the others then decide it
_NEIGHBOURS = 3  # rejected stations at one place are no chance (as in runs); one alone may be a wrong reading
_SAID = 0.2  # the same, of all samples, from which a place is said: where they were half of those that are fitted
_THERE = 0.1  # of a function's largest square, from which a station says something of it


@dataclass(frozen=True)
class ReadmittedPlace:
    """Where stations were taken in again. joint: whose curve they show. low, high: of its position [rad or m] at these.
    stations: how many, of so many between.
    """

    joint: str
    low: float
    high: float
    stations: int
    of: int


@dataclass(frozen=True)
class Readmitted:
    """Stations that were taken in again. stations: how many. unscored: how many of them the score rejects still, since
    the fit that is scored has no others there. places: what they show.
    """

    stations: int = 0
    unscored: int = 0
    places: tuple[ReadmittedPlace, ...] = ()


def uncontradicted(model: Model, samples: Samples, rejected: np.ndarray) -> np.ndarray:
    """True for rejected samples that stand where curves of the model are known from rejected ones, (N,)."""
    out = np.zeros(len(samples), bool)
    for _, _, there in _alone(model, samples, rejected, 1.0 - _LOST):
        if len(np.unique(samples.station[there])) >= _NEIGHBOURS:
            out |= there
    return out


def right_after_all(
    scored: Fit,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    distances: Sequence[AnyDistance],
    wrong: np.ndarray,
) -> tuple[np.ndarray, Fit | None]:
    """True for samples that the scored fit had no others beside of, and that a fit to all of them explains, (N,).

    What was held out from it may be all that there is of a place. wrong: True for what it rejects, (N,). Also that fit,
    where it is to just those samples that are right after all and those that are not wrong.
    """
    alone = uncontradicted(scored.model, samples, wrong)
    if not alone.any():
        return alone, None
    start = scored.start.with_effects(sharpened(scored.model, samples).effects)
    some = samples.select(~wrong | alone)
    fit = identify(start, some, parameters, distances, tolerance=FITTED, begin=scored.values, reject=False)
    right = np.asarray(alone & ~outlying(fit.model, scored.noise, samples))
    return right, fit if np.array_equal(right, alone) else None


def readmitted(model: Model, samples: Samples, again: np.ndarray, wrong: np.ndarray) -> Readmitted:
    """What was taken in again (True, (N,)), and where they say much of the model's curves. wrong: True for what the
    score rejects, (N,).
    """
    places = []
    for joint, x, there in _alone(model, samples, again, _SAID):
        low, high = float(x[there].min()), float(x[there].max())
        count = len(np.unique(samples.station[there]))
        places.append(
            ReadmittedPlace(joint, low, high, count, len(np.unique(samples.station[(x >= low) & (x <= high)])))
        )
    return Readmitted(
        len(np.unique(samples.station[again])), len(np.unique(samples.station[again & wrong])), tuple(places)
    )


def _alone(
    model: Model, samples: Samples, some: np.ndarray, share: float
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Stretches of curves of which some samples (True, (N,)) say this share of all, or more: the joint, its positions,
    and True for these samples there, (N,) each.
    """
    curves = [effect for effect in model.effects if effect.shape.kind == "spline" and claimed(effect)]
    if not some.any() or not curves:
        return
    drivers = model.drivers(samples)
    for effect in curves:
        x = drivers.values(effect.driver, effect.lag)
        square = effect.shape.basis(x) ** 2
        whole = square.sum(axis=1)
        lost = square[:, ~some].sum(axis=1) < (1.0 - share) * whole
        for first, last in consecutive(lost & (whole > 0.0)):
            part = square[first:last]
            there = some & (part > _THERE * part.max()).any(axis=0)
            if there.any():
                yield effect.place, x, there
