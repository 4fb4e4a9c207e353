"""The solver of all fits: it finds minima, goes round what is impossible, and says where it did not arrive."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.geometry import Array, Descent, descend


def rosenbrock(x: Array) -> tuple[Array, Array]:
    """Residuals (2,) and their derivatives (2, 2) by x."""
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]), np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])


def descended(begin: Array, most: int = 100, least: float = -np.inf) -> Descent[Array]:
    """The way down Rosenbrock's valley. least: of the first value, below which nothing can be asked."""

    def cost(x: Array) -> float:
        return float(np.sum(rosenbrock(x)[0] ** 2))

    def step(x: Array, damping: float) -> tuple[Array, float] | None:
        r, J = rosenbrock(x)
        H = J.T @ J
        there = x - np.linalg.solve(H + damping * np.diag(np.diag(H)), J.T @ r)
        return (there, cost(there)) if there[0] >= least else None

    return descend(begin, cost, step, lambda _, gain, cost: gain <= 1e-12 * cost + 1e-24, most)


@pytest.mark.parametrize("begin", [(-1.2, 1.0), (3.0, -5.0), (0.0, 40.0)])
def test_a_bent_valley_is_followed_to_its_end(begin: tuple[float, float]) -> None:
    found = descended(np.array(begin))
    assert found.converged
    np.testing.assert_allclose(found.place, 1.0, atol=1e-9)


def test_the_cost_falls_with_every_step() -> None:
    costs = [np.sum(rosenbrock(descended(np.array([-1.2, 1.0]), most).place)[0] ** 2) for most in range(1, 12)]
    assert np.all(np.diff(costs) <= 1e-6 * np.array(costs[:-1]))


def test_steps_that_are_impossible_are_shortened() -> None:
    found = descended(np.array([3.0, 9.0]), least=0.9)
    np.testing.assert_allclose(found.place, 1.0, atol=1e-6)


def test_it_says_when_steps_were_too_few() -> None:
    found = descended(np.array([-1.2, 1.0]), most=2)
    assert found.steps == 2
    assert not found.converged


def test_where_no_step_leads_downhill_it_ends() -> None:
    begin = np.zeros(2)
    found = descend(begin, lambda _: 1.0, lambda x, _: (x + 1.0, 2.0), lambda *_: False, 50)
    assert found.converged
    assert np.array_equal(found.place, begin)
