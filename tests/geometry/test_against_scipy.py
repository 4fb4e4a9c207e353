"""The same rotations and motions by SciPy, and what the mean and the nearest rotation promise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array

ANGLES = [0.0, 1e-12, 0.99e-4, 1.01e-4, 0.5, 3.0, np.pi - 1e-9]


def rotation_vectors(rng: np.random.Generator, angle: float, count: int = 30) -> Array:
    d = rng.normal(size=(count, 3))
    d[:6] = np.r_[np.eye(3), -np.eye(3)]
    return angle * d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", ANGLES)
def test_rotations(angle: float, rng: np.random.Generator) -> None:
    w = rotation_vectors(rng, angle)
    theirs = Rotation.from_rotvec(w)
    R = so3.exp(w)
    assert np.abs(R - theirs.as_matrix()).max() < 1e-14
    assert np.abs(np.array(so3.exp_rows(w.reshape(-1, 3).T)).transpose(2, 1, 0) - R.reshape(-1, 3, 3)).max() < 1e-14
    assert np.abs(so3.exp(so3.log(R)) - R).max() < 1e-14
    assert np.abs(so3.log(R) - w).max() < 1e-14
    q = so3.to_quaternion(R)
    assert np.abs(np.abs(np.sum(q * theirs.as_quat(), axis=1)) - 1.0).max() < 1e-14
    assert np.abs(so3.from_quaternion(3.0 * theirs.as_quat()) - R).max() < 1e-14


def test_roll_pitch_yaw(rng: np.random.Generator) -> None:
    rpy = rng.uniform(-np.pi, np.pi, (200, 3)) * [1.0, 0.5, 1.0]
    assert np.abs(so3.from_rpy(rpy) - Rotation.from_euler("xyz", rpy).as_matrix()).max() < 1e-14
    assert np.abs(so3.to_rpy(so3.from_rpy(rpy)) - rpy).max() < 1e-12


@pytest.mark.parametrize("angle", ANGLES)
def test_motions(angle: float, rng: np.random.Generator) -> None:
    xi = np.c_[rng.normal(size=(30, 3)), rotation_vectors(rng, angle)]
    T = se3.exp(xi)
    for twist, motion in zip(xi, T, strict=True):
        generator = np.zeros((4, 4))
        generator[:3, :3], generator[:3, 3] = so3.hat(twist[3:]), twist[:3]
        assert np.abs(motion - expm(generator)).max() < 1e-14
    assert np.abs(se3.log(T) - xi).max() < 1e-13
    if 0.0 < angle < 3.1:
        assert np.abs(so3.hat(so3.log(T[7, :3, :3])) - logm(T[7, :3, :3]).real).max() < 1e-12


def test_half_a_turn(rng: np.random.Generator) -> None:
    """At π both signs of the axis are right; either must give the motion back."""
    for w in rotation_vectors(rng, np.pi):
        T = se3.exp([0.1, -0.2, 0.3, *w])
        xi = se3.log(T)
        assert np.linalg.norm(xi[3:]) == pytest.approx(np.pi, abs=1e-12)
        assert np.abs(se3.exp(xi) - T).max() < 1e-14


def test_adjoint_is_a_representation(rng: np.random.Generator) -> None:
    A, B = se3.exp(rng.normal(size=(2, 20, 6)))
    assert np.abs(se3.adjoint(A @ B) - se3.adjoint(A) @ se3.adjoint(B)).max() < 1e-14
    assert np.abs(se3.adjoint(se3.inverse(A)) @ se3.adjoint(A) - np.eye(6)).max() < 1e-14
    p = rng.normal(size=(20, 3))
    assert np.abs(se3.apply(A @ B, p) - se3.apply(A, se3.apply(B, p))).max() < 1e-14


def test_mean_is_where_the_sum_of_squares_is_least(rng: np.random.Generator) -> None:
    R = so3.exp(0.3 * rng.normal(size=(12, 3))) @ so3.exp([1.0, -2.0, 0.5])
    M = so3.mean(R)

    def spread(at: Array) -> float:
        return float(np.sum((R - at) ** 2))

    assert np.linalg.det(M) == pytest.approx(1.0)
    assert np.abs(M - Rotation.from_matrix(R).mean().as_matrix()).max() < 1e-13
    for d in 1e-3 * rng.normal(size=(20, 3)):
        assert spread(M @ so3.exp(d)) > spread(M)
    turn = so3.exp([0.4, 0.1, -0.7])
    assert np.abs(so3.mean(turn @ R) - turn @ M).max() < 1e-14


def test_nearest_rotation(rng: np.random.Generator) -> None:
    R = so3.exp(rng.normal(size=(20, 3)))
    stretch = np.diag([1.1, 0.8, 0.95])
    U = so3.exp(rng.normal(size=(20, 3)))
    assert np.abs(so3.nearest_rotation(R @ U @ stretch @ np.swapaxes(U, -1, -2)) - R).max() < 1e-14
    mirrored = so3.nearest_rotation(R @ np.diag([1.0, 1.0, -0.2]))
    assert np.abs(np.linalg.det(mirrored) - 1.0).max() < 1e-13
