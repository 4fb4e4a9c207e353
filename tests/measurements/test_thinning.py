"""Some rows of many."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.measurements.dwells import spread_rows


@pytest.mark.parametrize(("count", "most"), [(0, 5), (5, 5), (6, 5), (1000, 999), (24_000, 1000), (300_000, 1000)])
def test_so_many_rows_come_in_order_and_evenly(count: int, most: int) -> None:
    rows = spread_rows(count, most)
    assert len(rows) == min(count, most)
    assert (np.diff(rows) > 0).all()
    gaps = np.diff(np.r_[-1, rows, count])
    assert gaps.max(initial=0) <= 3.0 * max(count / most, 1.0) + 1.0
    assert len(set(gaps[1:-1].tolist())) <= 3


@pytest.mark.parametrize("period", [2, 3, 5, 7, 8, 10, 12, 13, 21, 24, 36, 55, 100])
def test_no_raster_is_met(period: int) -> None:
    """Each place of a raster is seen about equally often, also where the rows are every 24th in the mean."""
    seen = np.bincount(spread_rows(24_000, 1000) % period, minlength=period)
    assert np.abs(seen - 1000 / period).max() <= 4 + 0.1 * 1000 / period


def test_the_rows_are_the_same_each_time() -> None:
    assert np.array_equal(spread_rows(12_345, 678), spread_rows(12_345, 678))
