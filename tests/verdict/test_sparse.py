"""Columns that are never written out: products with them are those with the columns in full."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.verdict.crossfit import Baseline, Layout, Sparse, principal
from modcal_core.verdict.drivers import Waves

N = 30
SINGLE = 1e-6  # of columns of unit length, in single precision


@pytest.mark.parametrize("parameters", [0, 4])
def test_contracted_products_are_those_of_the_columns_in_full(parameters: int) -> None:
    rng = np.random.default_rng(0)
    waves = Waves(
        "", (rng.normal(size=(1, 6, N)), rng.normal(size=(3, 6, N))), (rng.normal(size=(7, N)), rng.normal(size=(5, N)))
    )
    seen = np.ones((6, N), bool)
    seen[3:, ::3] = False  # some readings without orientation
    layout = Layout.of(rng.permutation(N) % 5, seen)
    own = 10.0 * rng.normal(size=(parameters, 6, N)) * seen
    baseline, U = Baseline(*principal(own), layout), layout.flat(own)
    full = layout.flat(waves.written(np.arange(22)) * seen)
    seen_only = Waves("", tuple(u * seen for u in waves.motions), waves.numbers)
    few = Sparse(seen_only, baseline)
    np.testing.assert_allclose(seen_only.squares(), np.sum(full**2, axis=1), rtol=1e-12)

    # ridge regression on parameters of unit variance, taken out of the columns, which are then of unit length
    left = full - full @ U.T @ np.linalg.solve(U @ U.T + np.eye(parameters), U)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    np.testing.assert_allclose(few.written(np.arange(22)), left, atol=SINGLE)
    r = rng.normal(size=(left.shape[1], 3))
    trials = baseline.trials(r)
    for k, (a, b) in enumerate(layout.spans):
        rest = np.r_[0:a, b : left.shape[1]]
        train = r[rest] - U[:, rest].T @ np.linalg.solve(
            U[:, rest] @ U[:, rest].T + np.eye(parameters), U[:, rest] @ r[rest]
        )
        np.testing.assert_allclose(few.trained(trials)[k], left[:, rest] @ train, atol=10.0 * SINGLE)
