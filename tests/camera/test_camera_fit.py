"""One fit of arm, camera, target and lens, against arms in MuJoCo seen through OpenCV's projection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from camera.boards import BOARD, LENS
from camera.fits import FLAT, MEASURED, alone, images, solved, start, true_error
from camera.scenes import scene
from finite_differences import assert_jacobian

from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.parameters import View, ordered_candidates
from modcal_core.camera.claim import ALL_BUT_IMAGES, APPLY, AS_STATED, DO_NOT_APPLY, arm_draws
from modcal_core.camera.corners import CornerTable, common_prior, corner_rows
from modcal_core.camera.equations import Sizes
from modcal_core.camera.lens import FISHEYE, Lens
from modcal_core.camera.mounting import board_poses, find_mounting
from modcal_core.camera.views import postures_in_view
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POSE
from modcal_core.robots.kinematics import chain_forward


def test_images_that_cannot_tell_are_refused() -> None:
    s = images(True)
    A, poses = chain_forward(s.chain, s.q), board_poses(CornerTable.of(s.views, s.board), s.lens, FLAT)
    still = replace(poses, T=np.repeat(poses.T[:1], len(A), axis=0), cost=np.repeat(poses.cost[:1], len(A), axis=0))
    with pytest.raises(BadRecording, match="move, or stand, together"):
        find_mounting(A, still)
    with pytest.raises(NotEnoughData, match="at least 4"):
        find_mounting(A[:3], poses)
    with pytest.raises(NotEnoughData, match="turns it by 0.0° only"):
        find_mounting(np.repeat(A[:1], len(A), axis=0), poses)
    with pytest.raises(BadRecording, match="belong together"):
        find_mounting(A[np.random.default_rng(0).permutation(len(A))], poses)


def test_turning_about_one_axis_is_said() -> None:
    rng = np.random.default_rng(2)
    turn = so3.exp(np.c_[np.zeros((12, 2)), rng.uniform(-1.0, 1.0, 12)])
    A = se3.transform(turn, rng.uniform(-0.3, 0.3, (12, 3)))
    X, Y = se3.exp([0.1, 0.0, 0.1, 0.3, 0.2, 0.1]), se3.exp([0.5, 0.0, 0.3, 2.0, 0.1, 0.3])
    poses = board_poses(CornerTable.of(images(True).views[:12], BOARD), LENS, FLAT)
    B = se3.inverse(Y @ A @ X)
    found = find_mounting(A, replace(poses, T=np.stack([B, B], axis=1)), stated=True)
    assert found.one_axis


@pytest.mark.slow
@pytest.mark.parametrize("on_tip", [True, False])
def test_motion_of_the_target_in_the_images(on_tip: bool) -> None:
    """Every derivative of the target's pose as the camera sees it, and of the joints' own."""
    s = images(on_tip)
    _, arm = start(s, velocity=0.3)
    arm = arm.select(np.arange(2))
    x = 0.01 * np.random.default_rng(0).normal(size=len(arm.parameters))
    T, J = arm.tool_motions(x, 0.1)
    here = arm.seen(T)
    J = np.concatenate([J, np.einsum("nij,nj->ni", arm.own_motions(x, T)[:, :, :-3], arm.velocity)[:, :, None]], axis=2)

    def seen(v: Array) -> Array:
        there = arm.seen(arm.tool_motions(v[:-1], float(v[-1]))[0])
        return se3.log(there @ se3.inverse(here)).ravel()

    # own_motions is at q; tool_motions at q + 0.1 velocity
    late = replace(arm, q=arm.q + 0.1 * arm.velocity)
    J[:, :, -1] = np.einsum("nij,nj->ni", late.own_motions(x, T)[:, :, :-3], arm.velocity)
    assert_jacobian(seen, arm.as_twists(T, J).reshape(12, -1), np.r_[x, 0.1], tolerance=1e-7)


def test_the_arms_faults_are_those_of_all_its_bodies() -> None:
    """Of a minimal set of parameters, brought to it: at postures anywhere they move the tip as all faults do, so a link
    between two bodies that may each be displaced is known less well than either.
    """
    s = images(True)
    _, arm = start(s)
    assert arm.faults is not None
    kept = [p for p in arm.parameters if p.of_arm]
    every = [p for p in ordered_candidates(s.chain, arm.model.frames, (View(POSE, 0),)) if p.of_arm]
    assert len(kept) < len(every)
    q = np.random.default_rng(3).uniform(-1.5, 1.5, (6, s.chain.n))
    samples = arm.at_postures(q).drivers().samples
    J, whole = (linearise(arm.model, some, np.zeros(len(some)), samples).J.T for some in (kept, every))
    for ratio in (1.0, 3.0):
        std = np.array([p.prior_std * (1.0 if p.turns else ratio) for p in every])
        assert J @ arm.faults.covariance(ratio) @ J.T == pytest.approx((whole * std**2) @ whole.T, abs=1e-9)
    assert np.sqrt(np.diag(arm.faults.covariance() - arm.faults.covariance(0.0))).max() > 1.3 * max(
        p.prior_std for p in every if not p.turns
    )


def test_likelihood_is_that_of_the_whole_normal_distribution() -> None:
    """Two images of few corners: −2 log of the density of all residuals, with every covariance written out."""
    s = images(False)
    few = [v.select(np.arange(0, len(v), 5)) for v in s.views[:2]]
    table = CornerTable.of(few, s.board)
    arm = start(s)[1].select(np.arange(2))
    prior = common_prior(LENS, s.board.scale)
    cameras = alone(table, arm, prior, LENS)
    eq = cameras.equations(cameras.expected.start)
    # base and tool are known to some centimetres here, so that the covariance written out has digits left
    eq = replace(eq, information=eq.information + 1e3 * np.diag(np.diag(eq.information) < 1.0))
    rows = corner_rows(table, LENS, FLAT, arm.seen(arm.tool_motions(arm.values.start)[0]))
    r, (seen,) = rows.residual.ravel(), eq.cameras
    A = np.concatenate([rows.by_pose @ seen.moved[table.view], rows.by_common], axis=2).reshape(len(r), -1)
    own = rows.by_pose @ seen.own[table.view]
    B, C = own[:, :, :-3].reshape(len(r), -1), own[:, :, -3:].reshape(len(r), -1)
    same = np.equal.outer(np.repeat(table.view, 2), np.repeat(table.view, 2))
    use = np.flatnonzero(eq.free)

    def density(z: Sizes) -> float:
        prior_cov = np.linalg.inv(eq.prior(z)[np.ix_(use, use)])
        cov = z.noise**2 * np.eye(len(r)) + same * (z.joint**2 * B @ B.T + z.shift**2 * C @ C.T)
        cov += A[:, use] @ prior_cov @ A[:, use].T
        gap = r + A[:, use] @ eq.offset[use]
        return float(np.linalg.slogdet(cov)[1] + gap @ np.linalg.solve(cov, gap))

    one, two = Sizes(1.0, 1e-3, 1e-3, 0.1), Sizes(1.7, 4e-3, 2e-4, 0.3)
    gap = eq.solve(one).misfit() - eq.solve(two).misfit()
    assert gap == pytest.approx(density(one) - density(two), rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("on_tip", [True, False])
def test_an_arm_that_is_centimetres_off(on_tip: bool) -> None:
    """Below 1.5 mm at the tool from 20 images, inside the stated interval, and said to be worth applying."""
    s = images(on_tip)
    r = solved(s)
    q = postures_in_view(r.fit, np.random.default_rng(1))
    _, low, high = r.claim.in_view.interval
    error, nominal = true_error(s, r.fit, q), true_error(s, r.nominal, q)
    assert 0.5 * low < error < high
    assert error < 1.5e-3
    assert nominal > 5e-3
    assert nominal == pytest.approx(r.claim.in_view.nominal_interval[0], rel=0.15)
    assert r.claim.decision.word == APPLY
    assert r.fit.sizes.noise == pytest.approx(1.0, abs=0.1)
    assert 2e-5 < r.fit.sizes.joint < 1e-4  # 5e-5 was put in
    assert not r.camera.left_out
    assert r.camera.mounting.camera_on_tip == on_tip
    assert r.evidence.moved is None
    # the arm by itself is known better than where the camera, or target, stands
    assert r.claim.alone is not None
    model = r.fit.poses.model_at(r.fit.state.values)
    tip = se3.inverse(model.T_tip_tool)[:3, 3]
    said, true = (se3.apply(T, tip) - se3.apply(T, tip).mean(0) for T in (model.predict(q), s.truth(q)))
    turn = so3.exp(np.linalg.lstsq(-so3.hat(said).reshape(-1, 3), (true - said).ravel(), rcond=None)[0])
    by_itself = float(np.sqrt(((said @ turn.T - true) ** 2).sum(1).mean()))
    assert 0.5 * r.claim.alone.interval[1] < by_itself < min(r.claim.alone.interval[2], 1.1 * error)
    # were everything known but what corners and joints scatter, less would be left, and no less than with one thing known
    whole, left = r.claim.shares[ALL_BUT_IMAGES]
    assert left < min(known for name, (_, known) in r.claim.shares.items() if name != ALL_BUT_IMAGES) < whole
    # lens and sheet within what is stated of them
    std = r.fit.std[0][-15:-6]
    assert (np.abs(r.fit.state.lens.values - s.lens.values) < 4.0 * std).all()
    assert r.claim.held_out_px[1] < 0.1 * r.claim.held_out_px[0]


@pytest.mark.slow
@pytest.mark.parametrize("on_tip", [True, False])
def test_a_perfect_arm_is_not_made_worse(on_tip: bool) -> None:
    """Nor is the base held where it was found first: the arm's prior is narrow here, and may not be the base's."""
    s = scene(3, on_tip, count=15, length_std=0.0, angle_std=0.0, board=MEASURED)
    r = solved(s)
    q = postures_in_view(r.fit, np.random.default_rng(1))
    assert r.claim.decision.word == DO_NOT_APPLY
    assert true_error(s, r.fit, q) < r.claim.in_view.interval[2]


@pytest.mark.slow
def test_an_arm_behind_a_fisheye() -> None:
    """Up to 60° to its side; nothing stated of it but that it is one."""
    wide = Lens(np.array([340.0, 341.0, 645.0, 355.0, 0.03, -0.012, 0.004, -0.001, 0.0]), LENS.size, FISHEYE)
    s = scene(1, True, count=25, board=MEASURED, lens=wide)
    r = solved(s, fisheye=True)
    q = postures_in_view(r.fit, np.random.default_rng(1))
    assert true_error(s, r.fit, q) < min(r.claim.in_view.interval[2], 1.5e-3)
    assert r.fit.state.lens.model == FISHEYE
    assert r.fit.state.lens.values[8] == 0.0
    assert np.abs(r.fit.state.lens.values[:2] / wide.values[:2] - 1.0).max() < 0.005


def test_draws_of_an_arm_of_stated_faults_are_those_of_the_fit() -> None:
    """There the law is normal, with the covariance of all faults brought to the parameters of the fit."""
    fit = solved(images(True), arm_m=5e-3, look_for_effects=False).fit
    values, chance = arm_draws(fit, np.random.default_rng(0))[AS_STATED]
    assert chance == 1.0
    P = fit.poses.count
    std = np.sqrt(np.diag(fit.covariance)[:P])
    assert values.std(axis=0) / std == pytest.approx(np.ones(P), abs=0.15)
    assert np.abs(values.mean(axis=0) / std).max() < 0.2
