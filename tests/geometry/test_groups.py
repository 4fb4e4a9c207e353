"""Laws of SO(3) and SE(3), near zero and just below half a turn included; and the descent of all fits."""

from __future__ import annotations

import numpy as np
import pytest
from finite_differences import assert_jacobian
from hypothesis import given
from hypothesis import strategies as st

from modcal_core.geometry import Array, Descent, descend, se3, so3

vectors = st.tuples(*[st.floats(-1.0, 1.0, allow_nan=False)] * 3).map(np.array)
angles = st.one_of(st.floats(0.0, np.pi - 1e-6), st.sampled_from([0.0, 1e-300, 1e-9, 9.9e-5, 1.01e-4, 1e-3, 3.1415]))


def rotation_vector(direction: np.ndarray, angle: float) -> np.ndarray:
    n = np.linalg.norm(direction)
    return angle * (direction / n if n > 1e-3 else np.array([0.0, 0.6, 0.8]))


@pytest.mark.slow
@given(vectors, angles)
def test_rotations(direction: np.ndarray, angle: float) -> None:
    w = rotation_vector(direction, angle)
    R = so3.exp(w)
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-14
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.abs(R @ w - w).max() < 1e-14
    assert np.abs(so3.log(R) - w).max() < 1e-9 if angle > 3.0 else np.abs(so3.log(R) - w).max() < 1e-14
    assert np.abs(so3.exp(-w) - R.T).max() < 1e-15
    for back in (so3.from_quaternion(so3.to_quaternion(R)), so3.from_rpy(so3.to_rpy(R)), so3.exp(so3.log(R))):
        assert np.abs(back - R).max() < 2e-14


@given(vectors, vectors, angles)
def test_transforms(v: np.ndarray, direction: np.ndarray, angle: float) -> None:
    xi = np.r_[v, rotation_vector(direction, angle)]
    T = se3.exp(xi)
    tolerance = 1e-8 if angle > 3.0 else 1e-13
    assert np.abs(se3.log(T) - xi).max() < tolerance
    assert np.abs(se3.exp(0.4 * xi) @ se3.exp(0.6 * xi) - T).max() < 1e-14
    assert np.abs(se3.inverse(T) @ T - np.eye(4)).max() < 1e-14
    eta = np.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.6])
    assert np.abs(T @ se3.exp(eta) @ se3.inverse(T) - se3.exp(se3.adjoint(T) @ eta)).max() < 1e-13
    assert np.abs(se3.from_pose(se3.to_pose(T)) - T).max() < 1e-14
    assert se3.to_pose(T)[6] >= 0.0


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, 1.5708, np.pi / 2 - 1e-9])
def test_roll_pitch_yaw_gives_the_rotation_back_at_the_pole(pitch: float, rng: np.random.Generator) -> None:
    for roll, yaw in rng.uniform(-np.pi, np.pi, (50, 2)):
        R = so3.from_rpy([roll, pitch, yaw])
        assert np.abs(so3.from_rpy(so3.to_rpy(R)) - R).max() < 1e-14


def test_batches_are_the_same_as_one_by_one(rng: np.random.Generator) -> None:
    xi = rng.normal(size=(4, 5, 6))
    one_by_one = np.array([[se3.exp(x) for x in row] for row in xi])
    assert np.array_equal(se3.exp(xi), one_by_one)
    assert se3.log(se3.exp(xi)).shape == (4, 5, 6)
    assert se3.exp(np.zeros((0, 6))).shape == (0, 4, 4)


def test_left_jacobian(rng: np.random.Generator) -> None:
    for w in (*rng.uniform(-1.7, 1.7, (10, 3)), np.zeros(3), 1e-5 * np.ones(3)):
        R = so3.exp(w)
        assert_jacobian(lambda d, R=R: so3.log(so3.exp(d) @ R), so3.left_jacobian_inverse(w), np.zeros(3))


def test_the_mean_ignores_the_sign_of_quaternions(rng: np.random.Generator) -> None:
    centre = so3.exp([0.3, 2.0, -1.0])
    R = centre @ so3.exp(1e-3 * rng.normal(size=(4000, 3)))
    q = so3.to_quaternion(R) * rng.choice([-1.0, 1.0], (4000, 1))
    gap = so3.log(centre.T @ so3.mean(so3.from_quaternion(q)))
    assert np.abs(gap).max() < 4e-3 / np.sqrt(4000)


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
