"""Orthogonal arrays are orthogonal, and postures made of them stay within the joints' ranges."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
import pytest
from cells import ur10

from modcal_core.errors import BadTable
from modcal_core.planning.sensitivity_study import array_postures, orthogonal_array


@pytest.mark.parametrize(
    ("factors", "levels", "runs"), [(6, 5, 25), (3, 2, 4), (7, 2, 8), (4, 3, 9), (8, 7, 49), (7, 5, 125)]
)
def test_every_pair_of_levels_equally_often(factors: int, levels: int, runs: int) -> None:
    array = orthogonal_array(factors, levels)
    assert array.shape == (runs, factors)
    for a, b in combinations(range(factors), 2):
        counts = {pair: 0 for pair in product(range(levels), repeat=2)}
        for row in array:
            counts[int(row[a]), int(row[b])] += 1
        assert set(counts.values()) == {runs // levels**2}


def test_l25_is_the_one_in_the_books() -> None:
    """Taguchi's L25(5^6): columns i, j, i + j, i + 2 j, i + 3 j, i + 4 j mod 5, up to the order of the last four."""
    array = orthogonal_array(6, 5)
    i, j = array[:, 0], array[:, 1]
    assert np.array_equal(i, np.repeat(range(5), 5))
    assert np.array_equal(j, np.tile(range(5), 5))
    assert {tuple(c) for c in array[:, 2:].T} == {tuple((i + k * j) % 5) for k in range(1, 5)}


def test_an_array_that_would_be_huge_is_refused() -> None:
    with pytest.raises(BadTable, match="20000 are the limit"):
        orthogonal_array(40, 31)


def test_levels_are_different_angles() -> None:
    """From −2π to 2π in five levels three would be one angle; they are spread over a turn instead."""
    q = array_postures(ur10(), 5)
    for k in range(6):
        assert len(np.unique(np.round(np.exp(1j * q[:, k]), 9))) == 5
        assert (q[:, k] >= ur10().lower[k]).all()
