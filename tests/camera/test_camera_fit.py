"""One fit of arm, camera, target and lens, against arms in MuJoCo seen through OpenCV's projection."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from camera.boards import BOARD, LENS, views
from camera.scenes import CameraScene, scene
from finite_differences import assert_jacobian

from modcal_core.calibration.linearise import linearise
from modcal_core.calibration.parameters import View, ordered_candidates
from modcal_core.camera.arm_poses import ArmPoses, arm_poses
from modcal_core.camera.corners import CornerTable, corner_rows
from modcal_core.camera.decision import APPLY, CANNOT_TELL, DO_NOT_APPLY
from modcal_core.camera.equations import Sizes
from modcal_core.camera.fit import CameraFit, CameraState, equations_at, fit_camera
from modcal_core.camera.flange import flange_arm, flange_joints, flange_poses
from modcal_core.camera.lens import FISHEYE, Lens
from modcal_core.camera.mounting import find_mounting
from modcal_core.camera.pnp import board_poses
from modcal_core.camera.priors import FIXED, TOLERANCE, common_prior
from modcal_core.camera.solve import CameraSolution, solve_camera
from modcal_core.camera.target import PrintedTarget
from modcal_core.camera.target_file import RULER_STD_M, scale_of_rulers
from modcal_core.camera.tool_error import postures_in_view
from modcal_core.camera.weakness import ALL_BUT_IMAGES
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POSE
from modcal_core.robots.kinematics import forward

FLAT = np.zeros(5)
MEASURED = replace(BOARD, scale=scale_of_rulers((0.2, 0.12), (0.2, 0.12), "rulers", RULER_STD_M))
AS_DRAWN = replace(BOARD, scale=scale_of_rulers((0.2, 0.12), (0.2, 0.12), "rulers"))  # which anybody states


@cache
def images(on_tip: bool) -> CameraScene:
    return scene(1, on_tip, count=20, board=MEASURED)


def start(s: CameraScene, velocity: float = 0.0) -> tuple[CornerTable, ArmPoses]:
    table = CornerTable.of(s.views, s.board)
    found = find_mounting(forward(s.chain, s.q), board_poses(table, s.lens, FLAT))
    moving = np.full_like(s.q, velocity)
    return table, arm_poses(s.chain, s.q, moving, found.T_frame_base, found.T_tip_tool, found.camera_on_tip)


def solved(s: CameraScene, **options: object) -> CameraSolution:
    return solve_camera(s.chain, s.q, s.views, s.board, s.lens.size, np.random.default_rng(3), **options)  # type: ignore[arg-type]


def true_error(s: CameraScene, fit: CameraFit, q: Array) -> float:
    """RMS distance of the flange, as the model has it on the tool, from the truth [m]."""
    tip = se3.inverse(fit.poses.model_at(fit.state.values).T_tip_tool)[:3, 3]
    model = fit.poses.model_at(fit.state.values).predict(q)
    return float(np.sqrt(((se3.apply(model, tip) - se3.apply(s.truth(q), tip)) ** 2).sum(1).mean()))


@pytest.mark.parametrize("on_tip", [True, False])
def test_mounting_is_told_without_a_guess(on_tip: bool) -> None:
    s = images(on_tip)
    found = find_mounting(forward(s.chain, s.q), board_poses(CornerTable.of(s.views, s.board), s.lens, FLAT))
    assert found.camera_on_tip == on_tip
    assert found.rival > 10.0
    assert found.misfit_m < 0.02  # of an arm whose bodies are 7 mm off
    assert not found.one_axis


def test_images_that_cannot_tell_are_refused() -> None:
    s = images(True)
    A, poses = forward(s.chain, s.q), board_poses(CornerTable.of(s.views, s.board), s.lens, FLAT)
    still = replace(poses, T=np.repeat(poses.T[:1], len(A), axis=0), cost=np.repeat(poses.cost[:1], len(A), axis=0))
    with pytest.raises(BadRecording, match="move, or stand, together"):
        find_mounting(A, still)
    with pytest.raises(NotEnoughData, match="at least 4"):
        find_mounting(A[:3], poses)
    with pytest.raises(NotEnoughData, match="far apart"):
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
    J = np.concatenate([J, np.einsum("nij,nj->ni", arm.joint_motions(x, T), arm.velocity)[:, :, None]], axis=2)

    def seen(v: Array) -> Array:
        there = arm.seen(arm.tool_motions(v[:-1], float(v[-1]))[0])
        return se3.log(there @ se3.inverse(here)).ravel()

    # joint_motions is at q; tool_motions at q + 0.1 velocity
    late = replace(arm, q=arm.q + 0.1 * arm.velocity)
    J[:, :, -1] = np.einsum("nij,nj->ni", late.joint_motions(x, T), arm.velocity)
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
    assert np.sqrt(np.diag(arm.faults.lengths)).max() > 1.3 * max(p.prior_std for p in every if not p.turns)


def test_likelihood_is_that_of_the_whole_normal_distribution() -> None:
    """Two images of few corners: −2 log of the density of all residuals, with every covariance written out."""
    s = images(False)
    few = [v.select(np.arange(0, len(v), 5)) for v in s.views[:2]]
    table = CornerTable.of(few, s.board)
    arm = start(s)[1].select(np.arange(2))
    prior = common_prior(LENS, s.board.scale)
    state = CameraState(np.zeros(len(arm.parameters)), 0.0, LENS, FLAT)
    eq = equations_at(table, arm, prior, state)
    # base and tool are known to some centimetres here, so that the covariance written out has digits left
    eq = replace(eq, information=eq.information + 1e3 * np.diag(np.diag(eq.information) < 1.0))
    rows = corner_rows(table, LENS, FLAT, arm.seen(arm.tool_motions(state.values)[0]))
    r = rows.residual.ravel()
    A = np.concatenate([rows.by_pose @ eq.moved[table.view], rows.by_common], axis=2).reshape(len(r), -1)
    B = (rows.by_pose @ eq.joints[table.view]).reshape(len(r), -1)
    C = (rows.by_pose @ eq.shifts[table.view]).reshape(len(r), -1)
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
    q, enough = postures_in_view(r.fit, np.random.default_rng(1))
    assert enough
    _, low, high = r.in_view.interval
    error, nominal = true_error(s, r.fit, q), true_error(s, r.nominal, q)
    assert 0.5 * low < error < high
    assert error < 1.5e-3
    assert nominal > 5e-3
    assert nominal == pytest.approx(r.in_view.nominal_interval[0], rel=0.15)
    assert r.decision.word == APPLY
    assert r.fit.sizes.noise == pytest.approx(1.0, abs=0.1)
    assert 2e-5 < r.fit.sizes.joint < 1e-4  # 5e-5 was put in
    assert not r.left_out
    assert r.moved is None
    # the arm by itself is known better than where the camera, or target, stands
    assert r.alone is not None
    model = r.fit.poses.model_at(r.fit.state.values)
    tip = se3.inverse(model.T_tip_tool)[:3, 3]
    said, true = (se3.apply(T, tip) - se3.apply(T, tip).mean(0) for T in (model.predict(q), s.truth(q)))
    turn = so3.exp(np.linalg.lstsq(-so3.hat(said).reshape(-1, 3), (true - said).ravel(), rcond=None)[0])
    alone = float(np.sqrt(((said @ turn.T - true) ** 2).sum(1).mean()))
    assert 0.5 * r.alone.interval[1] < alone < min(r.alone.interval[2], 1.1 * error)
    # were everything known but what corners and joints scatter, less would be left, and no less than with one thing known
    whole, left = r.shares[ALL_BUT_IMAGES]
    assert left < min(known for name, (_, known) in r.shares.items() if name != ALL_BUT_IMAGES) < whole
    # lens and sheet within what is stated of them
    std = np.sqrt(np.diag(r.fit.covariance))[-15:-6]
    assert (np.abs(r.fit.state.lens.values - s.lens.values) < 4.0 * std).all()
    assert r.held_out_px[1] < 0.1 * r.held_out_px[0]


@pytest.mark.slow
@pytest.mark.parametrize("on_tip", [True, False])
def test_a_perfect_arm_is_not_made_worse(on_tip: bool) -> None:
    """Nor is the base held where it was found first: the arm's prior is narrow here, and may not be the base's."""
    s = scene(3, on_tip, count=15, length_std=0.0, angle_std=0.0, board=MEASURED)
    r = solved(s)
    q, _ = postures_in_view(r.fit, np.random.default_rng(1))
    assert r.decision.word == DO_NOT_APPLY
    assert true_error(s, r.fit, q) < r.in_view.interval[2]


@pytest.mark.slow
def test_without_anything_metric_nothing_can_be_told() -> None:
    s = scene(1, True, count=15, board=BOARD)
    r = solved(s)
    assert r.decision.word == CANNOT_TELL
    assert "rulers" in r.decision.because[0]
    whole, known = r.shares["print scale"]
    assert known < 0.5 * whole  # which is what a ruler would tell


@pytest.mark.slow
def test_a_sheet_of_another_size_is_named() -> None:
    """Printed 5 % too large, and measured by nobody; the arm is known to a millimetre."""
    s = scene(4, True, count=15, length_std=3e-4, angle_std=5e-4, printed=1.05 * BOARD.points)
    r = solved(s, arm_m=1e-3)
    assert r.decision.word == DO_NOT_APPLY
    assert re.search(r"\+(4\.9|5\.[01]) % \(x\)", r.decision.because[0])


@pytest.mark.slow
@pytest.mark.parametrize("on_tip", [True, False])
def test_a_kicked_tripod_is_named(on_tip: bool) -> None:
    s = scene(5, on_tip, count=20, board=MEASURED)
    half = len(s.views) // 2
    kick = se3.exp([2e-3, 0.0, 0.0, 0.0, 2e-3, 0.0])  # of what stands in the world
    T = kick @ s.T[half:]
    later = views(np.random.default_rng(0), se3.inverse(T) if on_tip else T, board=s.board)
    r = solved(replace(s, views=[*s.views[:half], *later]))
    assert r.decision.word == DO_NOT_APPLY
    assert r.moved is not None
    assert r.moved.at == half
    assert r.moved.in_world
    what = "target" if on_tip else "camera"
    assert any(said.startswith(f"The {what} was moved before image") for said in r.decision.because)


@pytest.mark.slow
@pytest.mark.parametrize(("on_tip", "zoom"), [(True, 1.003), (True, 1.03), (False, 1.003)])
def test_a_focus_that_was_changed_is_no_move(on_tip: bool, zoom: float) -> None:
    """Of images that look like those of a camera that was moved along its axis."""
    s = images(on_tip)
    half = len(s.views) // 2
    other = replace(s.lens, values=s.lens.values * np.r_[zoom, zoom, np.ones(7)])
    later = views(np.random.default_rng(0), se3.inverse(s.T) if on_tip else s.T, lens=other, board=s.board)[half:]
    r = solved(replace(s, views=[*s.views[:half], *later]), look_for_effects=False)
    assert r.decision.word == DO_NOT_APPLY
    assert r.moved is not None
    assert r.moved.at == half
    assert 100.0 * r.moved.focal == pytest.approx(100.0 * (zoom - 1.0), rel=0.3)
    assert any("another focal length from image" in said for said in r.decision.because)


@pytest.mark.slow
def test_an_image_of_another_posture_is_left_out() -> None:
    s = images(True)
    q = s.q.copy()
    q[7] += 0.05
    r = solved(replace(s, q=q))
    assert list(r.left_out) == [s.views[7].name]


@pytest.mark.slow
def test_images_that_are_late() -> None:
    """20 ms at 0.3 rad/s are found to a millisecond."""
    velocity = 0.3 * np.random.default_rng(8).choice([-1.0, 1.0], (20, 7))
    s = scene(6, True, count=20, board=MEASURED, velocity=velocity, delay_s=0.02)
    r = solved(s, velocity=velocity)
    assert r.fit.state.offset_s == pytest.approx(-0.02, abs=1e-3)


@pytest.mark.slow
def test_stated_intrinsics_stay_where_they_are_fixed() -> None:
    s = images(True)
    r = solved(s, lens=s.lens, stated=FIXED)
    assert (r.fit.state.lens.values == s.lens.values).all()


@pytest.mark.slow
def test_flange_poses_place_camera_and_target() -> None:
    s = images(False)
    A = forward(s.chain, s.q)
    q = flange_joints(A)
    assert np.abs(flange_poses(q) - A).max() < 1e-12
    assert np.abs(forward(flange_arm(), q) - A).max() < 1e-12
    table = CornerTable.of(s.views, s.board)
    found = find_mounting(A, board_poses(table, s.lens, FLAT))
    arm = arm_poses(
        flange_arm(), q, np.zeros_like(q), found.T_frame_base, found.T_tip_tool, found.camera_on_tip, (), True
    )
    assert not arm.of_arm.any()
    fit = fit_camera(table, arm, s.lens, common_prior(s.lens, s.board.scale))
    assert fit.converged


@pytest.mark.slow
@pytest.mark.parametrize("stated", [BOARD, MEASURED], ids=["unmeasured", "measured"])
def test_squares_of_another_size_are_named(stated: PrintedTarget) -> None:
    """Printed 10 % too large: the arm's links could take it up, which no arm is built like."""
    s = scene(21, True, count=15, length_std=1e-3, angle_std=2e-3, printed=1.1 * BOARD.points, board=stated)
    r = solved(s)
    assert r.decision.word == DO_NOT_APPLY
    assert "The sheet is +9." in r.decision.because[0] or "The sheet is +10." in r.decision.because[0]
    assert "scale than its URDF" in r.decision.because[0]


@pytest.mark.slow
@pytest.mark.parametrize("on_tip", [True, False])
def test_a_sheet_that_a_bad_arm_hides_is_not_trusted(on_tip: bool) -> None:
    """Rulers stated at their nominal lengths, a sheet 2 % larger, an arm 4 mm off a body: images do not decide, so the interval has
    both, and what would tell is said.
    """
    s = scene(33, on_tip, count=20, length_std=4e-3, angle_std=5e-3, board=AS_DRAWN, printed=1.02 * BOARD.points)
    r = solved(s)
    q, _ = postures_in_view(r.fit, np.random.default_rng(1))
    assert r.decision.word == CANNOT_TELL
    assert "state how well (--measured-to-mm)" in r.decision.because[0]
    assert true_error(s, r.fit, q) < r.in_view.interval[2]
    assert r.rests_on is not None
    assert true_error(s, r.fit, q) < r.rests_on.if_wrong_m
    assert any("look much alike" in said or "The sheet is +" in said for said in r.decision.because)
    if on_tip:
        return
    T = se3.inverse(s.T) if on_tip else s.T
    clean = solved(replace(s, board=MEASURED, views=views(np.random.default_rng(0), T, board=s.board)))
    assert clean.decision.word == APPLY
    assert clean.in_view.interval[2] < 4e-3
    assert "rests on the sheet's stated size" in clean.decision.because[-1]


def test_rulers_of_which_nobody_says_how_well_they_were_read_count_as_any_statement() -> None:
    """One in twenty is of another sheet, whatever the images say against it; of rulers that were read with care that
    is up to the images.
    """
    s = scene(34, True, count=12, length_std=4e-3, angle_std=5e-3)
    chance = {}
    for std in (None, RULER_STD_M):
        board = replace(BOARD, scale=scale_of_rulers((0.2, 0.12), (0.2008, 0.1205), "rulers", std))
        error = solved(replace(s, board=board), look_for_effects=False).in_view
        chance[std] = float(error.weight[error.of == error.wrong.index("size")].sum())
    assert chance[None] >= 0.0499
    assert chance[RULER_STD_M] < 0.03


@pytest.mark.slow
def test_a_lens_of_another_camera_is_named() -> None:
    """Focal length 2 % and centre of another resolution, both stated as exact: neither can be the arm's fault."""
    s = images(True)
    longer = Lens(s.lens.values * np.r_[1.02, 1.02, np.ones(7)], s.lens.size)
    r = solved(s, lens=longer, stated=FIXED)
    assert r.decision.word == DO_NOT_APPLY
    assert any("contradict the stated lens: focal length 9" in said for said in r.decision.because)
    assert not any("contradict" in said for said in solved(s, lens=s.lens, stated=TOLERANCE).decision.because)


@pytest.mark.slow
def test_an_arm_worse_than_stated_is_named() -> None:
    r = solved(images(True), arm_m=3e-4)
    assert r.decision.word == DO_NOT_APPLY
    assert any("as far off as --arm-mm states" in said for said in r.decision.because)


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.03, 1.0])
def test_images_of_another_moment_are_refused_or_named(delay_s: float) -> None:
    """An arm that moves at 0.3 rad/s, taken as standing: the joints are those of 30 ms or 1 s before."""
    velocity = 0.3 * np.random.default_rng(8).choice([-1.0, 1.0], (20, 7))
    s = scene(6, True, count=20, board=MEASURED, velocity=velocity, delay_s=delay_s)
    if delay_s == 1.0:
        with pytest.raises(BadRecording, match="belong"):
            solved(s)
        return
    r = solved(s)
    assert r.decision.word == DO_NOT_APPLY
    assert any("of the same moment" in said for said in r.decision.because)


def test_pictures_turned_upside_down_are_left_out() -> None:
    """Every third of them, as a viewer saves them that turns them upright: no fit runs away."""
    s = images(True)
    far = np.array(s.lens.size) - 1.0
    turned = [replace(v, pixels=far - v.pixels) if i % 3 == 0 else v for i, v in enumerate(s.views)]
    r = solved(replace(s, views=turned), look_for_effects=False)
    assert r.decision.word == DO_NOT_APPLY
    assert set(r.left_out) == {v.name for v in turned[::3]}


def test_a_camera_that_hung_is_noticed() -> None:
    """The same picture, noise and all, under four names, and with four postures of the arm."""
    s = images(True)
    hung = [replace(s.views[4], name=v.name) if 4 <= i < 8 else v for i, v in enumerate(s.views)]
    r = solved(replace(s, views=hung), look_for_effects=False)
    assert set(r.left_out) == {"5.png", "6.png", "7.png"}
    assert all("the same picture as 4.png" in why for why in r.left_out.values())
    assert r.decision.word == DO_NOT_APPLY


def test_copies_of_images_say_nothing_more() -> None:
    s = images(True)
    copies = [replace(v, name=f"copy of {v.name}") for v in s.views]
    both = replace(s, q=np.concatenate([s.q, s.q]), views=[*s.views, *copies])
    once, twice = (solved(one, look_for_effects=False) for one in (s, both))
    assert twice.in_view.interval == pytest.approx(once.in_view.interval, rel=1e-6)
    assert set(twice.left_out) == {v.name for v in copies}


def test_two_boards_in_turn_are_refused() -> None:
    """Every other image shows a board of the same print that lies 0.2 m away."""
    s = images(False)
    T = se3.exp([0.05, 0.0, 0.0, 0.0, 0.2, 0.0]) @ s.T
    other = views(np.random.default_rng(0), T, board=s.board)
    with pytest.raises((BadRecording, NotEnoughData)):
        solved(replace(s, views=[a if i % 2 else b for i, (a, b) in enumerate(zip(s.views, other, strict=True))]))


@pytest.mark.slow
def test_an_arm_behind_a_fisheye() -> None:
    """Up to 60° to its side; nothing stated of it but that it is one."""
    wide = Lens(np.array([340.0, 341.0, 645.0, 355.0, 0.03, -0.012, 0.004, -0.001, 0.0]), LENS.size, FISHEYE)
    s = scene(1, True, count=25, board=MEASURED, lens=wide)
    r = solved(s, fisheye=True)
    q, _ = postures_in_view(r.fit, np.random.default_rng(1))
    assert true_error(s, r.fit, q) < min(r.in_view.interval[2], 1.5e-3)
    assert r.fit.state.lens.model == FISHEYE
    assert r.fit.state.lens.values[8] == 0.0
    assert np.abs(r.fit.state.lens.values[:2] / wide.values[:2] - 1.0).max() < 0.005
