"""The inverse of a triangle."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.calibration.fit import inverse_of_triangle


@pytest.mark.parametrize("rows", [0, 1, 63, 64, 65, 200])
def test_it_is_the_inverse_and_reads_nothing_above_the_diagonal(rows: int) -> None:
    rng = np.random.default_rng(rows)
    lower = np.tril(rng.normal(size=(rows, rows))) + 2.0 * np.sqrt(rows) * np.eye(rows)
    written_above = np.asfortranarray(lower + np.triu(np.full((rows, rows), np.nan), 1))
    inverse = inverse_of_triangle(written_above)
    np.testing.assert_allclose(inverse @ lower, np.eye(rows), atol=1e-12)
    np.testing.assert_array_equal(np.triu(inverse, 1), 0.0)
