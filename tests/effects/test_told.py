"""What a report tells of an effect: rows where a table has no clock, and what the readings do not tell it from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10

from modcal_core.loop import calibrate
from modcal_core.outcome import Finding

SIZES = {"x": (1e-3, 1e-5, "m")}


def test_rivals_are_in_the_sentence_and_no_more_than_two() -> None:
    found = Finding("step", "base", "all", "time", SIZES, 1e-9, 1e-3, 1e-4, ("tool", "joint_1", "joint_2", "joint_3"))
    assert found.sentence.startswith("One of these, which the readings do not tell apart: base moves")
    assert "; tool; joint_1; 2 more. The error is" in found.sentence
    assert "One of these" not in replace(found, same_as=()).sentence


@pytest.mark.parametrize(("clock", "words"), [(True, "(stamp "), (False, "(row 60)")])
def test_a_table_without_a_clock_has_rows_and_no_seconds(clock: bool, words: str) -> None:
    made = record(3, 120)
    late = np.arange(120) >= 60
    samples = replace(made.samples, reading=made.samples.reading + np.outer(late, [0.0, 2e-3, 0.0]))
    samples = replace(samples, stamps=10.0 * np.arange(1.0, 121.0), clock=clock)
    report = calibrate(samples, ur10(), np.random.default_rng(0)).report
    (step,) = (e for e in report.effects if e.family == "step")
    assert words in step.sentence
    assert step.parameters["at"][2] == ("s" if clock else "rows")
