"""Columns that are never written out: products with them are those with the columns in full."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.verdict.features import Waves
from modcal_core.verdict.ridge import Baseline, Layout
from modcal_core.verdict.sparse import SparseRegressor

N = 30
SINGLE = 1e-6  # of columns of unit length, in single precision


@pytest.mark.parametrize("parameters", [0, 4])
def test_contracted_products_are_those_of_the_columns_in_full(parameters: int) -> None:
    rng = np.random.default_rng(0)
    waves = Waves(
        (rng.normal(size=(1, 6, N)), rng.normal(size=(3, 6, N))), (rng.normal(size=(7, N)), rng.normal(size=(5, N)))
    )
    seen = np.ones((6, N), bool)
    seen[3:, ::3] = False  # some readings without orientation
    layout = Layout.of(np.array([0, 5, 12, 18, 25, N]), seen)
    U = 10.0 * layout.flat(rng.normal(size=(parameters, 6, N)))
    full = layout.flat(waves.written(np.arange(22)) * seen)
    seen_only = Waves(tuple(u * seen for u in waves.motions), waves.numbers)
    few = SparseRegressor.of("", seen_only, Baseline(U, layout), 0.02)
    assert few is not None
    np.testing.assert_allclose(seen_only.squares(), np.sum(full**2, axis=1), rtol=1e-12)

    # ridge regression on parameters of unit variance, taken out of the columns, which are then of unit length
    left = full - full @ U.T @ np.linalg.solve(U @ U.T + np.eye(parameters), U)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    np.testing.assert_allclose(few.written(np.arange(22)), left, atol=SINGLE)
    r = rng.normal(size=(left.shape[1], 3))
    trials = Baseline(U, layout).trials(r)
    for k, (a, b) in enumerate(layout.spans):
        rest = np.r_[0:a, b : left.shape[1]]
        train = r[rest] - U[:, rest].T @ np.linalg.solve(
            U[:, rest] @ U[:, rest].T + np.eye(parameters), U[:, rest] @ r[rest]
        )
        np.testing.assert_allclose(few.trained(trials)[k], left[:, rest] @ train, atol=10.0 * SINGLE)
