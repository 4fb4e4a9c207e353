"""Least squares without negative values: what SciPy finds, on columns of every kind."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from modcal_core.calibration.equations import nonnegative


@pytest.mark.parametrize("count", [1, 2, 7, 20])
@pytest.mark.parametrize("alike", [0.0, 0.99], ids=["columns apart", "columns nearly alike"])
def test_the_least_without_negative_values(rng: np.random.Generator, count: int, alike: float) -> None:
    for _ in range(50):
        X = rng.normal(size=(60, count)) * rng.uniform(0.01, 100.0, count)
        X[:, count // 2 :] += alike * 100.0 * rng.normal(size=(60, 1))
        r = X @ rng.normal(size=count) + rng.normal(size=60)
        ridge = 1e-9 * np.trace(X.T @ X) / count * np.eye(count)
        x = nonnegative(X.T @ X + ridge, X.T @ r)
        L = np.linalg.cholesky(X.T @ X + ridge)
        expected = nnls(L.T, np.linalg.solve(L, X.T @ r))[0]
        assert (x >= 0.0).all()
        size = np.sqrt(np.diag(X.T @ X))
        np.testing.assert_allclose(x * size, expected * size, rtol=1e-5, atol=1e-6 * np.linalg.norm(r))


def test_where_all_want_to_be_negative_all_are_zero() -> None:
    np.testing.assert_array_equal(nonnegative(np.eye(3), np.array([-1.0, -2.0, 0.0])), np.zeros(3))


def test_many_at_once_are_as_each_alone(rng: np.random.Generator) -> None:
    X, r = rng.normal(size=(40, 3, 30, 5)), rng.normal(size=(40, 3, 30))
    X[:, 1, :, 1:] *= -1.0
    r[0, 0] = -X[0, 0].sum(axis=1)
    A, v = np.swapaxes(X, -1, -2) @ X, np.einsum("wtki,wtk->wti", X, r)
    x = nonnegative(A, v)
    assert x.shape == v.shape
    for i, j in np.ndindex(40, 3):
        np.testing.assert_allclose(x[i, j], nnls(X[i, j], r[i, j])[0], rtol=1e-7, atol=1e-9)
