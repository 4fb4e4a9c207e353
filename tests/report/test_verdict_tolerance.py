"""Tolerance: intervals that cover what they promise, what stands in the way of a PASS, and what may be stated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from modcal_core.calibration.stated import Stated
from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array
from modcal_core.verdict.tolerance import STATISTICS, Asked, AtTool, assess, interval_of_rms
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
@pytest.mark.parametrize("count", [12, 48])
def test_intervals_hold_the_true_value_nearly_always(errors: Errors, count: int) -> None:
    """95 of 100 intervals must; 200 trials with 5 % misses leave 11 or fewer with a chance of 70 %, 20 with 99.9 %."""
    truth = np.sqrt(np.mean(errors(np.random.default_rng(0), 1_000_000) ** 2))
    rng, unit, missed = np.random.default_rng(1), np.arange(count), 0
    for _ in range(200):
        found = interval_of_rms(errors(rng, count), unit)
        assert found is not None
        missed += not found[0] <= truth <= found[1]
    assert missed <= 20


def test_samples_of_one_station_do_not_make_it_narrower() -> None:
    """Ten readings of each station tell no more than one, and are not taken for ten stations."""
    norms = in_space(np.random.default_rng(2), 40)
    once = interval_of_rms(norms, np.arange(40))
    assert once is not None
    assert interval_of_rms(np.repeat(norms, 10), np.repeat(np.arange(40), 10)) == pytest.approx(once, rel=1e-9)
    assert interval_of_rms(norms[:7], np.arange(7)) is None


def claimed(low: float, high: float, open_mm: float = 0.0) -> AtTool:
    return AtTool(0.5 * (low + high), (low, high), "recorded ranges", open_mm, "One known distance shows it.")


def test_the_lower_end_fails_and_the_upper_end_passes() -> None:
    for name in STATISTICS:
        for mm, result in ((0.099, "FAIL"), (0.101, "CANNOT TELL"), (0.301, "PASS")):
            met = assess(claimed(0.1, 0.3), Asked(mm, name), CALM)
            assert met.result == result, (name, mm)
            assert met.ci95 == (0.1, 0.3)
            assert met.because.endswith(".")


def test_what_no_reading_holds_is_said_with_what_would_show_it() -> None:
    met = assess(claimed(0.1, 0.8, 0.7), Asked(0.2), CALM)
    assert met.result == "CANNOT TELL"
    assert met.because.endswith(
        "0.700 mm of it are held by what arms are like, not by readings. One known distance shows it."
    )
    assert "what arms are like" not in assess(claimed(0.1, 0.8, 0.1), Asked(0.2), CALM).because


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
    open_for = Verdict("open", (Reason("predictable", "Half is predictable."), Reason(kind, "This is the reason.")))
    met = assess(claimed(0.1, 0.3), Asked(10.0), open_for)
    assert met.result == result
    assert (result == "PASS") == ("this is the reason" not in met.because)
    assert assess(claimed(0.1, 0.3), Asked(0.01), open_for).result == "FAIL"  # however open


@pytest.mark.parametrize(("read_mm", "result"), [(None, "PASS"), (0.9, "PASS"), (1.1, "CANNOT TELL")])
def test_readings_that_miss_by_more_than_is_asked_pass_only_as_noise(read_mm: float | None, result: str) -> None:
    claim = replace(claimed(0.1, 0.3), read_mm=read_mm)
    scatters = Verdict("open", (Reason("predictable", "The tool scatters."),))
    met = assess(claim, Asked(1.0), scatters)
    assert met.result == result
    assert (result == "PASS") == ("but the tool scatters." not in met.because)
    assert assess(claim, Asked(1.0), CALM).result == "PASS"


def test_without_a_verdict_or_a_claim_nothing_passes_and_a_floor_need_not_be_known() -> None:
    assert assess(claimed(0.1, 0.3), Asked(10.0), None).result == "CANNOT TELL"
    assert assess(None, Asked(10.0), CALM).result == "CANNOT TELL"
    assert assess(claimed(0.1, 0.3), Asked(1.0), Verdict("cannot_tell")).result == "PASS"


def test_tolerances_are_positive() -> None:
    for mm in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(BadTable, match="tolerance"):
            Asked(mm)


def test_repeatability_of_a_data_sheet_as_rms() -> None:
    """RP of ISO 9283 is the mean distance to the mean position plus three standard deviations of it."""
    rng = np.random.default_rng(0)
    gap = 0.03 * rng.standard_normal((400_000, 3))
    far = np.linalg.norm(gap - gap.mean(axis=0), axis=1)
    iso = far.mean() + 3.0 * far.std(ddof=1)
    rms = Stated(repeatability_iso_mm=iso).rms_mm
    assert rms == pytest.approx(np.sqrt(np.mean(far**2)), rel=0.005)


def test_what_cannot_be_stated_is_refused() -> None:
    for values in (
        {"repeatability_mm": 0.0},
        {"instrument_mm": -0.1},
        {"instrument_deg": 20.0},
        {"repeatability_mm": float("nan")},
        {"repeatability_mm": 0.02, "repeatability_iso_mm": 0.05},
    ):
        with pytest.raises(BadTable):
            Stated(**values)
