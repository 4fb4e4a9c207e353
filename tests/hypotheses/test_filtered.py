"""Readings mixed with those of neighbouring rows by a filter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10

from modcal_core.geometry.so3 import Array
from modcal_core.hypotheses.refusal import disagreement
from modcal_core.measurements.samples import Samples

CHAIN = ur10()


@pytest.fixture(scope="module")
def clean() -> Samples:
    return record(14, 90).samples


def moving_mean(p: Array, before: int, after: int) -> Array:
    rows = [p[max(0, i - before) : i + after + 1].mean(axis=0) for i in range(len(p))]
    return np.array(rows)


def settling(p: Array, kept: float) -> Array:
    out = [p[0]]
    for row in p[1:]:
        out.append(kept * out[-1] + (1.0 - kept) * row)
    return np.array(out)


@pytest.mark.parametrize(
    ("points", "filtered", "said"),
    [
        (False, lambda p: moving_mean(p, 1, 1), "the mean of 3 rows about its own"),
        (True, lambda p: moving_mean(p, 3, 3), "the mean of 7 rows about its own"),
        (False, lambda p: moving_mean(p, 1, 0), "the mean of its own row and the 1 before"),
        (True, lambda p: settling(p, 0.5), "if 50% of the reading before were still in it"),
    ],
)
def test_a_filter_is_named(clean: Samples, filtered, said: str, points: bool) -> None:  # type: ignore[no-untyped-def]
    samples = replace(clean, reading=filtered(clean.reading))
    if points:
        samples = replace(samples, kind=np.full(len(samples), "point"))
    found = disagreement(samples, CHAIN)
    assert found is not None
    assert found.what == f"readings look filtered: each as {said}"
