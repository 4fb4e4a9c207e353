"""Tolerance: intervals that cover what they promise, and what stands in the way of a PASS."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array
from modcal_core.verdict.tolerance import STATISTICS, Asked, Statistic, assess, interval, statistic
from modcal_core.verdict.verdict import Reason, ReasonKind, Verdict

CALM = Verdict("at_floor")
Errors = Callable[[np.random.Generator, int], Array]


def in_space(rng: np.random.Generator, count: int) -> Array:
    """Lengths of normal vectors, as of an instrument alike in all directions."""
    return np.linalg.norm(rng.standard_normal((count, 3)), axis=1)


def along_one_axis(rng: np.random.Generator, count: int) -> Array:
    """Lengths of vectors that are long along one axis, as of an arm that deflects under load."""
    return np.linalg.norm(rng.standard_normal((count, 3)) * [1.0, 0.2, 0.1], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("errors", [in_space, along_one_axis])
@pytest.mark.parametrize(
    ("name", "count"), [*((name, count) for name in ("mean", "rms", "p95") for count in (12, 48)), ("p95", 150)]
)
def test_intervals_hold_the_true_value_nearly_always(errors: Errors, name: Statistic, count: int) -> None:
    """95 of 100 intervals must; 200 trials with 5 % misses leave 11 or fewer with a chance of 70 %, 20 with 99.9 %."""
    truth = statistic(errors(np.random.default_rng(0), 1_000_000), name)
    rng, unit, missed = np.random.default_rng(1), np.arange(count), 0
    for _ in range(200):
        low, high = interval(errors(rng, count), unit, name)
        assert low is not None
        assert high is not None
        missed += not low <= truth <= high
    assert missed <= 20


def test_samples_of_one_station_do_not_make_it_narrower() -> None:
    """Ten readings of each station tell no more than one, and are not taken for ten stations."""
    norms = in_space(np.random.default_rng(2), 40)
    many, unit = np.repeat(norms, 10), np.repeat(np.arange(40), 10)
    for name in STATISTICS:
        once, tenfold = interval(norms, np.arange(40), name), interval(many, unit, name)
        for a, b in zip(once, tenfold, strict=True):
            assert (a is None) == (b is None)
            assert a is None or b == pytest.approx(a, rel=1e-9)


def test_the_lower_end_fails_and_the_upper_end_passes() -> None:
    norms = 0.1 * in_space(np.random.default_rng(3), 100)
    for name in ("mean", "rms", "p95"):
        low, high = interval(norms, np.arange(100), name)  # type: ignore[arg-type]
        assert low is not None
        assert high is not None
        for mm, result in ((0.999 * low, "FAIL"), (1.001 * low, "CANNOT TELL"), (1.001 * high, "PASS")):
            met = assess(norms, np.arange(100), Asked(mm, name), CALM)  # type: ignore[arg-type]
            assert met.result == result, (name, mm)
            assert met.ci95 == (low, high)
            assert met.because.endswith(".")


@pytest.mark.parametrize(
    ("kind", "result"),
    [
        ("predictable", "PASS"),
        ("rejected", "CANNOT TELL"),
        ("not_converged", "CANNOT TELL"),
        ("not_applied", "CANNOT TELL"),
        ("contradiction", "CANNOT TELL"),
        ("convention", "CANNOT TELL"),
        ("above_floor", "CANNOT TELL"),
        ("cut_off", "CANNOT TELL"),
    ],
)
def test_only_a_predictable_share_does_not_stand_in_the_way(kind: ReasonKind, result: str) -> None:
    norms = 0.1 * in_space(np.random.default_rng(4), 100)
    open_for = Verdict("open", (Reason("predictable", "Half is predictable."), Reason(kind, "This is the reason.")))
    met = assess(norms, np.arange(100), Asked(10.0), open_for)
    assert met.result == result
    assert (result == "PASS") == ("this is the reason" not in met.because)
    assert assess(norms, np.arange(100), Asked(0.01), open_for).result == "FAIL"  # however open


def test_without_a_verdict_or_with_few_stations_nothing_passes() -> None:
    norms = 0.1 * in_space(np.random.default_rng(5), 100)
    assert assess(norms, np.arange(100), Asked(10.0), None).result == "CANNOT TELL"
    few = assess(norms[:7], np.arange(7), Asked(10.0), CALM)
    assert few.result == "CANNOT TELL"
    assert few.ci95 == (None, None)
    assert "8 are needed" in few.because
    assert assess(norms[:0], np.arange(0), Asked(10.0), CALM).result == "CANNOT TELL"


def test_a_floor_need_not_be_known_for_a_tolerance() -> None:
    norms = 0.1 * in_space(np.random.default_rng(5), 100)
    assert assess(norms, np.arange(100), Asked(1.0), Verdict("cannot_tell")).result == "PASS"


def test_the_largest_error_has_no_upper_end() -> None:
    """One beyond the limit fails; none beyond it shows a share of postures, not a limit."""
    norms = np.full(100, 0.1)
    norms[3] = 0.5
    assert assess(norms, np.arange(100), Asked(0.4, "max"), CALM).result == "FAIL"
    met = assess(norms, np.arange(100), Asked(50.0, "max"), CALM)
    assert met.result == "CANNOT TELL"
    assert met.ci95 == (0.5, None)
    assert "96.4 % of postures" in met.because  # 0.025 ** (1 / 100)


def test_tolerances_are_positive() -> None:
    for mm in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(BadTable, match="tolerance"):
            Asked(mm)
