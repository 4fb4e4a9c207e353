"""The histogram of multi-point sensitivity: the last interval is closed, so that the largest value is in it."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.planning.sensitivity_study import interval_probabilities


def test_the_largest_value_shares_the_last_interval() -> None:
    assert interval_probabilities(np.array([0.0, 1.0, 2.0, 3.0, 4.0]), 2) == pytest.approx([0.4, 0.4, 0.6, 0.6, 0.6])


def test_shares_are_those_of_an_independent_histogram(rng: np.random.Generator) -> None:
    values = rng.gamma(2.0, size=200)
    counts, edges = np.histogram(values, bins=9)
    expected = counts[np.clip(np.searchsorted(edges, values, side="right") - 1, 0, 8)] / 200.0
    assert interval_probabilities(values, 9) == pytest.approx(expected)
