"""Laws of SO(3) and SE(3), near zero and just below half a turn included."""

from __future__ import annotations

import numpy as np
import pytest
from finite_differences import assert_jacobian
from hypothesis import given
from hypothesis import strategies as st

from modcal_core.geometry import se3, so3

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
