"""Whether an error stays within a tolerance: PASS, FAIL or CANNOT TELL, by the interval of a held-out statistic.

Units of the held-out set (a station, or a block of neighbours) are independent of each other, samples within one are
not. The interval of mean and RMS comes from drawing whole units again: the bootstrap-t interval of the logarithm (Efron
& Tibshirani 1993, chapter 12), which keeps its level for few units and skew errors, where percentiles of the draws are
too narrow. That of the 95th percentile comes from order statistics, which ask for no distribution; drawing again gives
too low an upper end, for no draw exceeds the largest error seen. Below 72 units even the largest one lies under the
true percentile too often, so it is scaled by how far that would be if the error were normal along one axis, of normal
errors in space the one with the longest tail. The largest error itself has no upper limit that stations can show, only
a share of postures that lies below the largest one seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.verdict.verdict import Verdict

Statistic = Literal["mean", "rms", "p95", "max"]
Result = Literal["PASS", "FAIL", "CANNOT TELL"]
STATISTICS: tuple[Statistic, ...] = get_args(Statistic)
_DRAWS = 2000  # bootstrap samples; the 2.5 % tail then has 50
_TAIL = 0.025  # chance outside either end of a 95 % interval
_NORMAL = 1.96  # deviations that leave as much
_MANY = 500  # units from which the mean of them is normal enough not to be drawn
_MIN_UNITS = 8  # of which fewer give no interval worth the name, as seen in tests of its coverage
_NAMES = {"mean": "mean", "rms": "RMS", "p95": "95th percentile", "max": "largest error"}


@dataclass(frozen=True)
class Asked:
    """The tolerance asked for [mm], and of which statistic. Raises BadTable for one that is not positive."""

    mm: float
    statistic: Statistic = "p95"

    def __post_init__(self) -> None:
        if not 0.0 < self.mm < np.inf:
            raise BadTable("--tolerance-mm", f"{self.mm:g} mm, more than 0 is allowed", "give millimetres")


@dataclass(frozen=True)
class Tolerance:
    """What came of it. value_mm: the held-out statistic. ci95: its 95 % interval [mm]; an end that the data do not show
    is None. because: a sentence for a person.
    """

    asked: Asked
    value_mm: float | None
    ci95: tuple[float | None, float | None]
    result: Result
    because: str


@dataclass(frozen=True)
class AtTool:
    """What is claimed of the statistic asked for, at the tool [mm]. over: which postures. open_mm: what of it only the
    usual size of errors holds.
    """

    value: float
    ci95: tuple[float, float]
    over: str
    open_mm: float


def assess_claim(claim: AtTool, asked: Asked, verdict: Verdict | None) -> Tolerance:
    """The result for a claim at the tool, which has what is predictable in it; all else that is open bars a PASS."""
    low, high = claim.ci95
    name, limit = _NAMES[asked.statistic], f"{asked.mm:g} mm"
    said = f"The tool's error over the {claim.over} ({name}) is {claim.value:.3f} mm"
    if low > asked.mm:
        because = f"{said}, and at least {low:.3f} mm with 95 % confidence: more than {limit}."
        return Tolerance(asked, claim.value, claim.ci95, "FAIL", because)
    if high > asked.mm:
        because = f"{said}, its interval {low:.3f} … {high:.3f} mm contains {limit}."
        if claim.open_mm > asked.mm:
            because += (
                f" {claim.open_mm:.3f} mm of it only the usual size of an arm's errors holds, no reading: a known "
                "distance, or an instrument that reads positions, shows it."
            )
        else:
            because += " More stations make it narrower."
        return Tolerance(asked, claim.value, claim.ci95, "CANNOT TELL", because)
    against = _against(verdict)
    if against:
        return Tolerance(asked, claim.value, claim.ci95, "CANNOT TELL", f"{said}, at most {high:.3f} mm, but {against}")
    because = f"{said}, and at most {high:.3f} mm with 95 % confidence: within {limit}."
    return Tolerance(asked, claim.value, claim.ci95, "PASS", because)


def _against(verdict: Verdict | None) -> str:
    """What bars a PASS; empty where nothing does."""
    if verdict is None:
        return "no verdict was made."
    reasons = [reason.sentence for reason in verdict.reasons if reason.kind != "predictable"]
    return _lower(reasons[0]) if reasons else _lower(verdict.unproven) if verdict.unproven else ""


def assess(norms_mm: Array, unit: np.ndarray, asked: Asked, verdict: Verdict | None) -> Tolerance:
    """The result for these held-out errors [mm], (N,), that belong to these units, (N,): of a frozen calibration.

    A predictable share alone does not stand in the way of a PASS: it says that the error could be smaller still. Every
    other reason for an open verdict does, and so does doubt whether the readings were measured.
    """
    count = len(np.unique(unit))
    if not count:
        return Tolerance(asked, None, (None, None), "CANNOT TELL", "No station was held out.")
    value = float(statistic(norms_mm, asked.statistic))
    low, high = interval(norms_mm, unit, asked.statistic)
    name, limit = _NAMES[asked.statistic], f"{asked.mm:g} mm"
    if low is not None and low > asked.mm:
        said = f"The {name} is {value:.3f} mm, and at least {low:.3f} mm with 95 % confidence: more than {limit}."
        return Tolerance(asked, value, (low, high), "FAIL", said)
    because = _cannot(norms_mm, count, asked, value, low, high)
    if not because and verdict is None:
        because = "No verdict was made."
    if not because and (against := _against(verdict)):
        because = f"The {name} is at most {high:.3f} mm, but {against}"
    if because:
        return Tolerance(asked, value, (low, high), "CANNOT TELL", because)
    said = f"The {name} is {value:.3f} mm, and at most {high:.3f} mm with 95 % confidence: within {limit}."
    return Tolerance(asked, value, (low, high), "PASS", said)


def statistic(norms: Array, name: Statistic) -> Array:
    """A statistic of errors along the last axis."""
    if name == "mean":
        return np.asarray(norms.mean(axis=-1))
    if name == "rms":
        return np.asarray(np.sqrt(np.mean(norms**2, axis=-1)))
    return np.asarray(np.percentile(norms, 95, axis=-1) if name == "p95" else norms.max(axis=-1))


def interval(norms: Array, unit: np.ndarray, name: Statistic) -> tuple[float | None, float | None]:
    """95 % interval of a statistic of errors (N,) that belong to these units (N,), in the unit of the errors.

    An end is None where the data do not show it: both of few units, the upper one of the largest error. The lower end
    of that is the largest error seen.
    """
    if name == "max":
        return float(norms.max()), None
    _, rows_of = np.unique(unit, return_inverse=True)
    count = int(rows_of.max()) + 1
    if count < _MIN_UNITS:
        return None, None
    if name == "p95":
        return _interval_of_p95(np.sort(norms), count)
    if name == "mean":
        return _interval_of_mean(norms, rows_of)
    low, high = _interval_of_mean(norms**2, rows_of)
    return float(np.sqrt(low)), float(np.sqrt(high))


def tail_factor(count: int) -> float:
    """By how much the largest of so many errors must be scaled to lie above the 95th percentile with a chance of
    97.5 %, were they the sizes of normal numbers; no less than 1.
    """
    from scipy.special import ndtri

    reached = _TAIL ** (1.0 / count)  # the largest of n lies below the quantile u with chance u ** n
    return float(max(ndtri(0.975) / ndtri(0.5 + 0.5 * reached), 1.0))


def _interval_of_mean(x: Array, rows_of: np.ndarray) -> tuple[float, float]:
    """95 % interval of the mean of positive numbers (N,) in units numbered from 0, (N,)."""
    size, total = np.bincount(rows_of).astype(float), np.bincount(rows_of, x)
    count = len(size)

    def log_and_error(weights: Array) -> tuple[Array, Array]:
        """Logarithm of the mean and its standard error, of units of unequal size (a ratio of sums), (draws,)."""
        mean = (weights @ total) / (weights @ size)
        square = weights @ total**2 - 2.0 * mean * (weights @ (total * size)) + mean**2 * (weights @ size**2)
        error = np.sqrt(np.maximum(square, 0.0) * count / (count - 1.0)) / (weights @ size)
        return np.log(np.maximum(mean, 1e-300)), error / np.maximum(mean, 1e-300)

    (own,), (error,) = log_and_error(np.ones((1, count)))
    t = np.array([_NORMAL, -_NORMAL])
    if count <= _MANY:
        drawn, errors = log_and_error(_drawn_again(count))
        kept = errors > 1e-3 * error  # a draw of one unit again and again has no error
        if kept.any():
            t = np.quantile((drawn[kept] - own) / errors[kept], (1.0 - _TAIL, _TAIL))
    low, high = np.exp(own - t * error)
    return float(low), float(high)


@lru_cache(maxsize=2)  # every stage of a report has as many units
def _drawn_again(count: int) -> Array:
    """How often each unit is drawn, (draws, count), by a fixed seed: the same report gives the same bytes."""
    times = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), size=_DRAWS).astype(float)
    times.flags.writeable = False
    return times


def _interval_of_p95(ordered: Array, count: int) -> tuple[float, float]:
    """95 % interval of the 95th percentile, from errors in order (N,) that belong to so many units.

    The k-th of n independent errors lies above the percentile with the chance that fewer than k lie below it. Of units
    with several errors the same shares of all errors are taken, as if those of a unit were all alike.
    """
    from scipy.special import bdtr

    fewer = bdtr(np.arange(count), count, 0.95)  # chance that at most 0, 1, … n − 1 lie below
    low = int(np.searchsorted(fewer, _TAIL, side="right"))  # as many errors are surely below the percentile
    low_end = ordered[max(int(np.ceil(low / count * len(ordered))) - 1, 0)]
    if not (fewer >= 1.0 - _TAIL).any():
        return float(low_end), float(ordered[-1]) * tail_factor(count)
    high = int(np.argmax(fewer >= 1.0 - _TAIL)) + 1
    return float(low_end), float(ordered[int(np.ceil(high / count * len(ordered))) - 1])


def _cannot(norms: Array, count: int, asked: Asked, value: float, low: float | None, high: float | None) -> str:
    """Why the interval does not tell; empty where it does."""
    if asked.statistic == "max":
        share = 100.0 * _TAIL ** (1.0 / count)
        return (
            f"The largest error seen is {value:.3f} mm. Stations show no upper limit of the largest error: with 97.5 % "
            f"confidence, {share:.3g} % of postures lie below that one. --tolerance-of p95 can be decided."
        )
    if low is None or high is None:
        return f"{count} independent held-out stations or blocks; {_MIN_UNITS} are needed for an interval."
    if high > asked.mm:
        name = _NAMES[asked.statistic]
        said = f"The {name} is {value:.3f} mm, its 95 % interval {low:.3f} … {high:.3f} mm contains {asked.mm:g} mm."
        return f"{said} More stations make it narrower."
    return ""


def _lower(sentence: str) -> str:
    """The sentence to go on after a comma: a first word that is no name begins with a small letter."""
    first = sentence.split(" ", 1)[0]
    return sentence[:1].lower() + sentence[1:] if first[1:].islower() or len(first) == 1 else sentence
