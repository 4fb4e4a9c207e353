"""The checker of derivatives passes right ones and fails wrong ones."""

from __future__ import annotations

import numpy as np
import pytest
from finite_differences import assert_jacobian

X = np.array([0.3, -1.2])


def f(x: np.ndarray) -> np.ndarray:
    return np.array([np.sin(x[0]) * x[1], np.exp(x[1]), 1e3 * x[0] ** 2])


J = np.array([[np.cos(0.3) * -1.2, np.sin(0.3)], [0.0, np.exp(-1.2)], [600.0, 0.0]])


@pytest.mark.parametrize("wrong", [J * (1.0 + 1e-7), J + 1e-4, -J, J[:, ::-1]])
def test_a_wrong_one_fails(wrong: np.ndarray) -> None:
    with pytest.raises(AssertionError, match="entry"):
        assert_jacobian(f, wrong, X)


def test_outputs_on_a_circle() -> None:
    """An angle that wraps is differenced the short way."""

    def short(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (a - b + np.pi) % (2.0 * np.pi) - np.pi

    assert_jacobian(lambda x: np.mod(x, 2.0 * np.pi), np.eye(2), np.zeros(2), difference=short)
