"""Steps and covariances come from one factor, however unlike the units of the values are."""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.fit import Curvature


def test_solution_and_inverse_at_units_far_apart() -> None:
    """Values of which one is a thousand million times as large as another."""
    rng = np.random.default_rng(0)
    J = rng.normal(size=(40, 12)) * 10.0 ** np.linspace(-5, 4, 12)
    H, g = J.T @ J, J.T @ rng.normal(size=40)
    curvature = Curvature.of(H)
    size = np.sqrt(np.diag(H))
    expected = np.linalg.lstsq(J / size, np.linalg.pinv((J / size).T) @ (g / size), rcond=None)[0] / size
    np.testing.assert_allclose(curvature.solve(g), expected, rtol=1e-9)
    np.testing.assert_allclose((H @ curvature.inverse()) * size / size[:, None], np.eye(12), atol=1e-9)
    np.testing.assert_array_equal(curvature.inverse(), curvature.inverse().T)


def test_damping_holds_every_value_alike() -> None:
    """Damped by its own diagonal, a step is that of ``H + damping · diag(H)``."""
    J = np.random.default_rng(1).normal(size=(30, 5)) * np.array([1.0, 1e3, 1e-3, 1.0, 10.0])
    H, g = J.T @ J, J.T @ np.ones(30)
    np.testing.assert_allclose(
        Curvature.of(H, damping=0.5).solve(g), np.linalg.solve(H + 0.5 * np.diag(np.diag(H)), g), rtol=1e-9
    )


def test_what_is_singular_has_a_solution() -> None:
    """Two columns are the same: the step is shared between them, and solves the equations."""
    J = np.random.default_rng(2).normal(size=(30, 4))
    J = np.concatenate([J, J[:, :1]], axis=1)
    H, g = J.T @ J, J.T @ np.ones(30)
    step = Curvature.of(H).solve(g)
    np.testing.assert_allclose(H @ step, g, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(step[0], step[4], rtol=1e-3, atol=1e-5)
