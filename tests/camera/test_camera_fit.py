"""One fit of arm, camera, target, lens and effects, beside other instruments; truth from MuJoCo by OpenCV's projection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from camera.boards import BOARD, LENS, views
from camera.fits import FLAT, MEASURED, alone, images, solved, start, true_error
from camera.scenes import CameraScene, scene
from finite_differences import assert_jacobian

from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.parameters import View, ordered_candidates
from modcal_core.camera.arm_poses import ImageMoments
from modcal_core.camera.claim import ALL_BUT_IMAGES, APPLY, AS_STATED, CANNOT_TELL, DO_NOT_APPLY, arm_draws
from modcal_core.camera.corners import CornerTable, common_prior, corner_rows
from modcal_core.camera.equations import ReadingsBeside, Sizes, beside
from modcal_core.camera.lens import FISHEYE, Lens
from modcal_core.camera.mounting import board_poses, find_mounting
from modcal_core.camera.solve import CameraSolution
from modcal_core.camera.views import postures_in_view
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POSE
from modcal_core.measurements.samples import Samples
from modcal_core.robots.kinematics import chain_forward

pytestmark = pytest.mark.slow


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
    prior = common_prior(LENS, s.board)
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


def test_a_perfect_arm_is_not_made_worse() -> None:
    """Nor is the base held where it was found first: the arm's prior is narrow here, and may not be the base's."""
    s = scene(3, True, count=15, length_std=0.0, angle_std=0.0, board=MEASURED)
    r = solved(s)
    q = postures_in_view(r.fit, np.random.default_rng(1))
    assert r.claim.decision.word == DO_NOT_APPLY
    assert true_error(s, r.fit, q) < r.claim.in_view.interval[2]


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


TRACKER = se3.exp([1.5, -0.4, 0.3, 0.2, 0.1, 2.0])  # where the camera's or the target's frame is in the tracker's
BALL = np.array([0.03, -0.05, 0.12])  # in the tool


def ball(s: CameraScene, q: Array, noise: float, rng: np.random.Generator) -> Array:
    """Where a tracker sees a ball on the tool, (N, 3) [m]."""
    T = TRACKER @ s.truth(q)
    return np.asarray(se3.apply(T, BALL) + noise * rng.standard_normal((len(q), 3)))


def tracked(s: CameraScene, count: int = 15, noise: float = 5e-5) -> ReadingsBeside:
    rng = np.random.default_rng(7)
    low, high = s.q.min(0), s.q.max(0)
    q = rng.uniform(low, high, (count, s.chain.n))
    return beside(s.chain, Samples.from_arrays(q, points=ball(s, q, noise, rng), names=s.chain.names))


def errors(s: CameraScene, r: CameraSolution) -> tuple[float, float]:
    """(true error at the tool, upper end of what is said of it) where the target is in view [m]."""
    q = postures_in_view(r.fit, np.random.default_rng(1))
    return true_error(s, r.fit, q), r.claim.in_view.interval[2]


def test_a_few_tracker_points_give_the_length_that_images_lack() -> None:
    """A sheet that nobody measured, 0.8 % too large: cannot tell; with fifteen points of a ball the arm is better by
    several times, said so, and the sheet's size is found.
    """
    s = scene(12, False, count=15, length_std=3e-3, angle_std=4e-3, printed=1.008 * BOARD.points)
    alone, mixed = solved(s), solved(s, beside=tracked(s))
    assert alone.claim.decision.word == CANNOT_TELL
    assert mixed.claim.decision.word == APPLY
    assert mixed.claim.metric == ("readings of point in tracker",)
    off, said = errors(s, mixed)
    assert off < said < errors(s, alone)[1]
    assert off < min(1e-3, 0.5 * errors(s, alone)[0])
    assert mixed.fit.state.shape[:2] == pytest.approx(0.008, abs=5e-4)
    assert mixed.fit.sizes.other == pytest.approx(5e-5, rel=1.0)


def test_wrong_readings_beside_images_are_left_out() -> None:
    s = scene(12, True, count=15, board=MEASURED)
    good = tracked(s)
    reading = good.samples.reading.copy()
    reading[4] += [0.0, 0.02, 0.0]
    r = solved(s, beside=replace(good, samples=replace(good.samples, reading=reading)))
    assert len(r.fit.cameras.beside.samples) == 14
    assert errors(s, r)[0] < 1e-3


def test_too_few_readings_beside_images_are_refused() -> None:
    s = scene(12, True, count=15)
    with pytest.raises(NotEnoughData, match="at least 3"):
        tracked(s, count=2)


def test_derivatives_of_rows_beside_images() -> None:
    s = scene(12, True, count=8)
    table, arm = start(s)
    cameras = replace(alone(table, arm, common_prior(s.lens, s.board), s.lens), beside=tracked(s, count=4))
    x = cameras.expected.start
    at = x + 1e-3 * np.random.default_rng(0).normal(size=len(x))
    rows = cameras.equations(at).beside
    own = np.arange(len(cameras.columns[0]), len(x))
    of_arm = np.r_[np.arange(cameras.first.poses.count), own]
    assert (np.delete(rows.J, of_arm, axis=1) == 0.0).all()

    def predicted(v: Array) -> Array:
        there = cameras.equations(v).beside
        return -there.residual

    # residuals are taken as seen from the root, which a frame's own turn moves: its shifts are enough here
    shifts = [not p.name.startswith("frame ") for p in cameras.beside.own]
    free = np.r_[np.arange(cameras.first.poses.count), own[shifts]]

    def partly(v: Array) -> Array:
        whole = at.copy()
        whole[free] = v
        return predicted(whole)

    assert_jacobian(partly, rows.J[:, free], at[free], tolerance=1e-6)


def with_motion(s: CameraScene, true_q: Array) -> CameraScene:
    """The same images of an arm whose joints stand at true_q where they report q."""
    T = s.world.tool_in_tracker(true_q + 3e-5 * np.random.default_rng(3).standard_normal(true_q.shape))
    seen = views(np.random.default_rng(4), se3.inverse(T) if s.on_tip else T, board=s.board)
    keep = [i for i, v in enumerate(seen) if len(v) >= 8]
    return replace(s, q=s.q[keep], T=T[keep], views=[seen[i] for i in keep])


def test_a_gear_is_found_from_corners_alone() -> None:
    """Seven waves a turn of 2 mrad in joint 3: named with its period and size, and the arm is better for it."""
    s = scene(41, False, count=30, length_std=2e-3, angle_std=3e-3, board=MEASURED)
    q = s.q.copy()
    q[:, 2] += 2e-3 * np.sin(7.0 * q[:, 2] + 0.3)
    r = solved(with_motion(s, q))
    (cause,) = r.evidence.causes
    assert (cause.effect.family, cause.effect.place) == ("gear_harmonic", s.chain.names[2])
    assert cause.effect.shape.settings["cycles"] == pytest.approx(7.0, abs=0.05)
    assert np.hypot(*cause.effect.amplitudes) == pytest.approx(2e-3, rel=0.1)
    assert cause.p_value < 1e-4
    assert r.fit.sizes.joint < 0.2 * r.geometric.sizes.joint
    assert r.claim.decision.word == APPLY


def test_a_ratio_and_backlash_are_found_from_corners() -> None:
    """0.2 % in joint 4; and 1 mrad of play in joint 1, whose side the way it came tells."""
    s = scene(41, True, count=30, length_std=2e-3, angle_std=3e-3, board=MEASURED)
    came = np.random.default_rng(5).choice([-1.0, 1.0], s.q.shape)
    q = s.q.copy()
    q[:, 3] *= 1.002
    q[:, 0] += 1e-3 * came[:, 0]
    moved = with_motion(s, q)
    r = solved(moved, moments=ImageMoments(approach=came[: len(moved.q)]))
    found = {(c.effect.family, c.effect.place): c.effect for c in r.evidence.causes}
    ratio, play = found["gear_ratio", s.chain.names[3]], found["backlash", s.chain.names[0]]
    assert ratio.values == pytest.approx(0.002, abs=2e-4)
    assert np.abs(play.values) == pytest.approx(1e-3, rel=0.2)


def test_a_clean_arm_has_no_effects() -> None:
    s = scene(61, True, count=25, length_std=3e-3, angle_std=4e-3, board=MEASURED)
    r = solved(s)
    assert not r.evidence.causes
    assert r.evidence.left is None
