"""The closed chain against arms written out by hand; what the source found, and laws of indices, variances and gains."""

from __future__ import annotations

import numpy as np
import pytest
from cells import record, slider_arm, ur10
from finite_differences import assert_jacobian
from planning.arms import POINT, dh_point, irb1410, irb1410_table

from modcal_core.calibration.linearisation import model_at
from modcal_core.calibration.parameters import View
from modcal_core.calibration.structure import choose_parameters
from modcal_core.errors import BadTable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.planning.pool import one_frame_model
from modcal_core.planning.sensitivity_study import (
    ClosedChain,
    array_postures,
    calibration_chain,
    dh_closed_chain,
    gains,
    interval_probabilities,
    joint_use,
    left_by,
    sensitivity,
    sizes_of,
)
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.mechanism import random_postures


def test_errors_move_the_point_as_in_an_arm_written_by_hand(rng: np.random.Generator) -> None:
    table, closed = irb1410_table(), dh_closed_chain(irb1410(), point=POINT)
    q = random_postures(irb1410(), 6, rng)

    def point(x: Array) -> Array:
        named = dict(zip(closed.names, x, strict=True))
        return np.concatenate([dh_point(table, posture, named, POINT) for posture in q])

    assert_jacobian(point, closed.jacobian(q)[:, :3].reshape(-1, 33), np.zeros(33), step=1e-3)


@pytest.mark.parametrize("kind", ["point", "pose"])
@pytest.mark.parametrize("chain", [ur10(), slider_arm(), irb1410()], ids=["ur10", "sliders", "irb1410"])
def test_what_calibrate_fits_moves_its_model(chain: Chain, kind: str, rng: np.random.Generator) -> None:
    T, tool = se3.exp([0.4, -0.2, 0.3, 0.5, 0.1, -0.7]), se3.exp([0.1, 0.05, 0.2, 0.4, -0.3, 0.2])
    closed, model = calibration_chain(chain, T, tool, kind), one_frame_model(chain, T, tool)
    parameters = choose_parameters(model, (View(kind, 0),)).parameters
    q = random_postures(chain, 4, rng)

    def point(x: Array) -> Array:
        return model_at(model, parameters, x).predict(q)[:, :3, 3].ravel()

    P = len(parameters)
    assert closed.names == tuple(p.name for p in parameters)
    assert_jacobian(point, closed.jacobian(q)[:, :3].reshape(-1, P), np.zeros(P), step=1e-3)
    turned = np.array([[T @ chain_forward(chain, q)[i] @ tool for i in range(4)]])[0]
    axis = closed.jacobian(q)[:, 3:]
    step = 1e-5 * np.eye(P)
    for k in range(P):
        R = model_at(model, parameters, step[k]).predict(q)[:, :3, :3]
        assert np.abs(so3.log(R @ turned[:, :3, :3].transpose(0, 2, 1)) / 1e-5 - axis[..., k]).max() < 1e-4


def test_an_arm_of_mujoco_is_met_by_what_calibrate_fits_and_not_by_dh() -> None:
    """Axes 2 and 3 are parallel: a tilt between them out of the drawing's plane has no DH parameter."""
    made = record(5, 60, "point", irb1410(), length_std=1e-5, angle_std=1e-5)
    T = made.world.tool_in_tracker(made.samples.q)
    T_tip_tool = se3.exp(np.r_[0.05, 0.03, 0.12, np.random.default_rng(5).normal(size=9)[6:]])
    tool = se3.transform(p=T_tip_tool[:3, 3])

    nominal = se3.apply(made.world.T_tracker_base @ chain_forward(irb1410(), made.samples.q), tool[:3, 3])

    def left(closed: ClosedChain) -> float:
        P = len(closed.factors)
        gap = (T[:, :3, 3] - nominal).ravel()
        J = closed.jacobian(made.samples.q)[:, :3].reshape(-1, P)
        return float(np.abs(gap - J @ np.linalg.lstsq(J, gap, rcond=1e-10)[0]).max())

    assert left(calibration_chain(irb1410(), made.world.T_tracker_base, tool)) < 5e-9
    assert left(dh_closed_chain(irb1410(), made.world.T_tracker_base, tool[:3, 3])) > 1e-6


def test_sizes_by_name_and_pattern() -> None:
    closed = dh_closed_chain(irb1410())
    sizes = sizes_of(closed, 5e-4, 1e-3, {"point/*": 0.0, "joint_3/a": 2e-3})
    by_name = dict(zip(closed.names, sizes, strict=True))
    assert (by_name["point/y"], by_name["joint_3/a"], by_name["joint_2/a"], by_name["base/rx"]) == (0, 2e-3, 5e-4, 1e-3)
    with pytest.raises(BadTable, match="matches no parameter"):
        sizes_of(closed, 5e-4, 1e-3, {"joint_9/a": 1.0})
    with pytest.raises(BadTable, match="at least 0 is needed"):
        sizes_of(closed, -1.0, 1e-3)


@pytest.fixture(scope="module")
def abb() -> ClosedChain:
    return dh_closed_chain(irb1410(), point=POINT)


@pytest.fixture(scope="module")
def l25() -> Array:
    return array_postures(irb1410())


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
    q = random_postures(irb1410(), 12, np.random.default_rng(1))
    sizes = sizes_of(abb, 5e-4, 1e-3)
    found = gains(abb.jacobian(q)[:, :3], np.diag(sizes**2))
    table, rng = irb1410_table(), np.random.default_rng(2)
    still = np.array([dh_point(table, posture, {}, POINT) for posture in q])
    drawn = sizes * rng.standard_normal((400, 33))

    def square(errors: Array) -> float:
        named = (dict(zip(abb.names, row, strict=True)) for row in errors)
        return float(
            np.mean([np.sum((dh_point(table, q[k % 12], n, POINT) - still[k % 12]) ** 2) for k, n in enumerate(named)])
        )

    assert found.mean_square == pytest.approx(square(drawn), rel=0.15)
    strongest = int(np.argmax(found.share))
    known = drawn.copy()
    known[:, strongest] = 0.0
    assert 1.0 - square(known) / square(drawn) == pytest.approx(found.share[strongest], abs=0.1)
    assert found.share.sum() == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("measured", [False, True])
def test_a_gain_is_what_goes_away_when_the_parameter_is_known(abb: ClosedChain, l25: Array, measured: bool) -> None:
    sizes = sizes_of(abb, 5e-4, 1e-3)
    G = abb.jacobian(random_postures(irb1410(), 50, np.random.default_rng(3)))[:, :3]
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
    G = abb.jacobian(random_postures(irb1410(), 200, rng))[:, :3]
    q = random_postures(irb1410(), 40, rng)

    def named(q: Array) -> set[str]:
        J = abb.jacobian(q)[:, :3].reshape(-1, 33)
        joint = joint_use(G, sizes, J, np.full(len(J), 5e-5))
        return {abb.names[k] for k in np.flatnonzero(joint.unseen)}

    assert named(q) == set()
    still = q.copy()
    still[:, 3:] = [0.2, 0.4, -0.3]  # the wrist never moves, so it is one piece with the point
    assert named(still) >= {"joint_4/a", "joint_5/d", "point/x"}
    assert not {"joint_2/a", "joint_2/theta", "base/x"} & named(still)
