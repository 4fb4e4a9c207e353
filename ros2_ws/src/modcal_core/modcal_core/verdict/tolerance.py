"""Whether the tool's error stays within a tolerance: PASS, FAIL or CANNOT TELL, by the claim; the interval of an RMS.

Units of the held-out set (a station, or a block of neighbours) are independent of each other, samples within one are
not. The interval of the RMS comes from drawing whole units again: the bootstrap-t interval of the logarithm (Efron &
Tibshirani 1993, chapter 12), which keeps its level for few units and skew errors, where percentiles of the draws are
too narrow.
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
    """What came of it. value_mm: the statistic at the tool, None where nothing is claimed. ci95: its ends [mm], each
    passed with a chance of 5 %, None where nothing is claimed. because: a sentence for a person.
    """

    asked: Asked
    value_mm: float | None
    ci95: tuple[float | None, float | None]
    result: Result
    because: str


@dataclass(frozen=True)
class AtTool:
    """What is claimed of the statistic asked for, at the tool [mm]. over: which postures. open_mm: what of it only the
    usual size of errors holds. remedy: what would show that, or make the interval narrower. read_mm: the statistic of
    the readings that no fit has seen, with the instrument's noise in it; None where they have no length.
    """

    value: float
    ci95: tuple[float, float]
    over: str
    open_mm: float
    remedy: str
    read_mm: float | None = None


def assess(claim: AtTool | None, asked: Asked, verdict: Verdict | None) -> Tolerance:
    """The result for a claim at the tool. A reason to be open bars a PASS. A dependence or a scatter does so only where
    the readings are missed by more than is asked for, for it may be the arm's.
    """
    if claim is None:
        return Tolerance(asked, None, (None, None), "CANNOT TELL", "Nothing is known of the tool's error.")
    low, high = claim.ci95
    name, limit = _NAMES[asked.statistic], f"{asked.mm:g} mm"
    said = f"The tool's error over the {claim.over} ({name}) is {claim.value:.3f} mm"
    if low > asked.mm:
        because = f"{said}, and at least {low:.3f} mm with 95 % confidence: more than {limit}."
        return Tolerance(asked, claim.value, claim.ci95, "FAIL", because)
    if high > asked.mm:
        because = f"{said}, its interval {low:.3f} … {high:.3f} mm contains {limit}."
        if claim.open_mm > asked.mm:
            because += f" {claim.open_mm:.3f} mm of it are held by what arms are like, not by readings."
        because += f" {claim.remedy}"
        return Tolerance(asked, claim.value, claim.ci95, "CANNOT TELL", because)
    against = _against(verdict, claim.read_mm is None or claim.read_mm <= asked.mm)
    if against:
        return Tolerance(asked, claim.value, claim.ci95, "CANNOT TELL", f"{said}, at most {high:.3f} mm, but {against}")
    because = f"{said}, and at most {high:.3f} mm with 95 % confidence: within {limit}."
    return Tolerance(asked, claim.value, claim.ci95, "PASS", because)


def _against(verdict: Verdict | None, within: bool) -> str:
    """What bars a PASS; empty where nothing does. within: whether the readings are missed by no more than is asked."""
    if verdict is None:
        return "no verdict was made."
    reasons = [reason.sentence for reason in verdict.reasons if reason.kind != "predictable"]
    reasons += [] if within else verdict.open_because
    return _lower(reasons[0]) if reasons else _lower(verdict.unproven) if verdict.unproven else ""


def interval_of_rms(norms: Array, unit: np.ndarray) -> tuple[float, float] | None:
    """95 % interval of the RMS of errors (N,) that belong to these units (N,), in their unit; None of too few units."""
    _, rows_of = np.unique(unit, return_inverse=True)
    if int(rows_of.max()) + 1 < _MIN_UNITS:
        return None
    low, high = _interval_of_mean(norms**2, rows_of)
    return float(np.sqrt(low)), float(np.sqrt(high))


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


def _lower(sentence: str) -> str:
    """The sentence to go on after a comma: a first word that is no name begins with a small letter."""
    first = sentence.split(" ", 1)[0]
    return sentence[:1].lower() + sentence[1:] if first[1:].islower() or len(first) == 1 else sentence
