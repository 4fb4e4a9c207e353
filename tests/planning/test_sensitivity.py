"""What the source found on the ABB IRB 1410, and what else must hold of indices, variances and gains."""

from __future__ import annotations

import numpy as np
import pytest
from planning.arms import POINT, dh_point, irb1410, irb1410_table
from scipy.integrate import quad
from scipy.stats import chi

from modcal_core.geometry.so3 import Array
from modcal_core.planning.closed_chain import ClosedChain, dh_closed_chain, sizes_of
from modcal_core.planning.sensitivity_study import (
    design,
    gains,
    interval_probabilities,
    joint_use,
    left_by,
    of_distance,
    of_vector,
    sensitivity,
    sobol_postures,
)


@pytest.fixture(scope="module")
def abb() -> ClosedChain:
    return dh_closed_chain(irb1410(), point=POINT)


@pytest.fixture(scope="module")
def l25() -> Array:
    return design(irb1410(), "l25", np.random.default_rng(0))


def test_single_point_indices_are_how_far_the_point_moves(abb: ClosedChain, l25: Array) -> None:
    sizes = sizes_of(abb, 1e-4, 1e-4)
    found = sensitivity(abb, l25, sizes, "base/x")
    table = irb1410_table()
    for i in (0, 7, 24):
        still = dh_point(table, l25[i], {}, POINT)
        for k, name in enumerate(abb.names):
            moved = np.linalg.norm(dh_point(table, l25[i], {name: sizes[k]}, POINT) - still)
            assert moved == pytest.approx(found.single[i, k], abs=1e-8)


def test_angles_are_not_and_differ_from_pose_to_pose(abb: ClosedChain, l25: Array) -> None:
    found = sensitivity(abb, l25, sizes_of(abb, 5e-4, 1e-3), "base/x")
    angles = [k for k, f in enumerate(abb.factors) if not f.is_length]
    multi = found.multi[angles]
    assert len(np.unique(np.round(multi / multi.max(), 3))) > len(angles) - 3
    for k in angles:
        share = np.ptp(found.single[:, k]) / found.single[:, k].mean()
        # the point is fixed to the last frame: about its axes it is as far away at every pose
        assert (share < 1e-9) == (abb.names[k] in ("joint_6/theta", "joint_6/alpha")), abb.names[k]


def test_interval_weights_by_hand() -> None:
    values = np.array([1.0, 1.0, 1.0, 3.0])
    assert np.array_equal(interval_probabilities(values, 2), [0.75, 0.75, 0.75, 0.25])
    # the last interval is closed: the largest value is in it
    assert interval_probabilities(np.arange(5.0), 2) == pytest.approx([0.4, 0.4, 0.6, 0.6, 0.6])
    # weighted: (3 · 0.75 + 3 · 0.25) / (3 · 0.75 + 0.25) = 1.2, nearer to what is usual than the mean, 1.5
    closed = dh_closed_chain(irb1410(), point=POINT)
    q = np.zeros((4, 6))
    q[3, 1] = 1.0
    found = sensitivity(closed, q, sizes_of(closed, 1e-3, 1e-3), "base/x", bins=2)
    usual, rare = found.single[0], found.single[3]
    assert np.allclose(found.multi, np.where(np.isclose(usual, rare), usual, (2.25 * usual + 0.25 * rare) / 2.5))


def test_the_shares_of_a_linear_error_are_those_of_arms_drawn_at_random(abb: ClosedChain) -> None:
    """Each parameter's share is the variance that goes when only it is known."""
    q = sobol_postures(irb1410(), 12, np.random.default_rng(1))
    sizes = sizes_of(abb, 5e-4, 1e-3)
    found = of_vector(gains(abb.jacobian(q)[:, :3], np.diag(sizes**2)))
    table, rng = irb1410_table(), np.random.default_rng(2)
    still = np.array([dh_point(table, posture, {}, POINT) for posture in q])
    drawn = sizes * rng.standard_normal((400, 33))

    def square(errors: Array) -> float:
        named = (dict(zip(abb.names, row, strict=True)) for row in errors)
        return float(
            np.mean([np.sum((dh_point(table, q[k % 12], n, POINT) - still[k % 12]) ** 2) for k, n in enumerate(named)])
        )

    assert found.variance == pytest.approx(square(drawn), rel=0.15)
    strongest = int(np.argmax(found.first))
    known = drawn.copy()
    known[:, strongest] = 0.0
    assert 1.0 - square(known) / square(drawn) == pytest.approx(found.total[strongest], abs=0.1)
    assert found.total.sum() == pytest.approx(1.0, abs=1e-9)


@pytest.mark.slow
def test_sobol_indices_of_a_distance_against_integrals() -> None:
    """Three equal Gaussian shifts: the distance is chi with three degrees of freedom, and its indices are integrals."""
    closed = dh_closed_chain(irb1410(), point=POINT)
    sizes = np.array([1.0 if name in ("base/x", "base/y", "base/z") else 0.0 for name in closed.names])
    G = closed.jacobian(np.zeros((1, 6)))[:, :3]
    found = of_distance(G, sizes, np.random.default_rng(5), arms=1024)

    def gauss(x: float) -> float:
        return float(np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi))

    def known(x: float) -> float:  # E of the distance given one shift; ρ of the others is Rayleigh
        return float(quad(lambda r: np.hypot(x, r) * r * np.exp(-0.5 * r * r), 0.0, 12.0)[0])

    def given_two(r: float) -> float:
        return float(quad(lambda x: np.hypot(x, r) * gauss(x), -9.0, 9.0)[0])

    mean, variance = chi(3).mean(), chi(3).var()
    first = quad(lambda x: (known(x) - mean) ** 2 * gauss(x), -9.0, 9.0)[0] / variance
    rest = quad(lambda r: (given_two(r) - mean) ** 2 * r * np.exp(-0.5 * r * r), 0.0, 12.0)[0] / variance
    at = [closed.index(f"base/{c}") for c in "xyz"]
    assert found.variance == pytest.approx(variance, rel=0.03)
    assert np.abs(found.first[at] - first).max() < 0.02
    assert np.abs(found.total[at] - (1.0 - rest)).max() < 0.02
    others = np.delete(found.total, at)
    assert (others == 0.0).all()


@pytest.mark.parametrize("measured", [False, True])
def test_a_gain_is_what_goes_away_when_the_parameter_is_known(abb: ClosedChain, l25: Array, measured: bool) -> None:
    sizes = sizes_of(abb, 5e-4, 1e-3)
    G = abb.jacobian(sobol_postures(irb1410(), 50, np.random.default_rng(3)))[:, :3]
    J = abb.jacobian(l25[:4])[:, :3].reshape(-1, 33)

    def covariance(sizes: Array) -> Array:
        return left_by(J, np.full(len(J), 5e-5), sizes) if measured else np.diag(sizes**2)

    whole = gains(G, covariance(sizes))
    for k in (4, 7, 12, 20, 32):
        known = sizes.copy()
        known[k] = 1e-12
        assert whole.mean_square - gains(G, covariance(known)).mean_square == pytest.approx(whole.of_each[k], rel=1e-6)


def test_what_matters_and_is_not_seen_is_said(abb: ClosedChain) -> None:
    sizes = sizes_of(abb, 5e-4, 1e-3)
    rng = np.random.default_rng(4)
    G = abb.jacobian(sobol_postures(irb1410(), 200, rng))[:, :3]
    q = sobol_postures(irb1410(), 40, rng)

    def named(q: Array) -> set[str]:
        J = abb.jacobian(q)[:, :3].reshape(-1, 33)
        joint = joint_use(G, sizes, J, np.full(len(J), 5e-5))
        return {abb.names[k] for k in np.flatnonzero(joint.unseen)}

    assert named(q) == set()
    still = q.copy()
    still[:, 3:] = [0.2, 0.4, -0.3]  # the wrist never moves, so it is one piece with the point
    assert named(still) >= {"joint_4/a", "joint_5/d", "point/x"}
    assert not {"joint_2/a", "joint_2/theta", "base/x"} & named(still)
