"""Setpoints without a jump, a Delta corrected like an arm, and what the live view draws."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from calibration.test_effects import started
from cells import NOISE_M, samples_of, ur10
from correction.test_compensation import STEEP, calibration_of, moment, true_model
from deltas import RecordedDelta, record_delta

from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import NoiseModel
from modcal_core.calibration.store import Calibration
from modcal_core.correction.commander import (
    Bounds,
    CalibratedRobot,
    Commander,
    CommanderSettings,
    SetpointStream,
    compensate,
    corrected_urdf,
)
from modcal_core.correction.correction import ArmState, Correction
from modcal_core.correction.picture import ellipsoid, enlarged_axes, joint_axes, known_to, residuals, tool_ellipsoid
from modcal_core.errors import BadCommand, BadRobot, NotReachable
from modcal_core.geometry import se3, so3
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.online.supervisor import Live
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.mechanism import tool_frames
from modcal_nodes.simulation.mjcf import World, body_name

AT = np.array([0.3, -1.2, 1.4, -0.8, 1.1, 0.2])


def robot(*amplitudes: float, chain: Chain | None = None) -> CalibratedRobot:
    made = calibration_of(true_model(STEEP.started(np.array(amplitudes))))
    return CalibratedRobot(Correction(made), chain or ur10(), 3.0)


def test_bounds_are_the_narrower_of_what_is_described_and_calibrated() -> None:
    narrow = replace(ur10(), lower=np.full(6, -1.0), upper=np.full(6, 9.0))
    bounds = Bounds.of((narrow, ur10()), 0.5, 0.1)
    assert bounds.lower.tolist() == [-1.0] * 6
    assert bounds.upper.tolist() == ur10().upper.tolist()
    with pytest.raises(BadCommand, match=r"command -1.2000 of joint shoulder_lift_joint"):
        bounds.require_within(AT)
    for nothing in (np.nan, np.inf):
        with pytest.raises(BadCommand, match="not finite"):
            bounds.require_within(np.full(6, nothing))


def test_a_step_is_as_long_as_the_speed_allows() -> None:
    bounds = Bounds.of((ur10(),), 0.5, 0.1)
    step = np.zeros(6)
    step[4] = -0.05
    bounds.require_step(AT + 0.999 * step, AT, 0.1)
    with pytest.raises(BadCommand, match="wrist_2_joint"):
        bounds.require_step(AT + 1.001 * step, AT, 0.1)
    with pytest.raises(BadCommand):
        bounds.require_step(np.full(6, np.nan), AT, 0.1)
    assert bounds.seconds(AT + 10.0 * step, AT) == pytest.approx(1.0)


def test_a_change_comes_in_without_a_jump_of_position_or_speed() -> None:
    stream, dt = SetpointStream(), 0.01
    stream.given(np.zeros(1), 0.0)
    stream.take_over(np.array([1e-3]), 0.0, 2e-3, 0.5)
    sent = []
    for k in range(1, 80):
        q = stream.setpoint(np.array([1e-3]), k * dt)
        stream.given(q, k * dt)
        sent.append(float(q[0]))
    steps = np.diff([0.0, *sent])
    assert sent[-1] == 1e-3
    assert (steps >= 0.0).all()
    # the steepest point of a cubic blend is 1.5 times the mean
    assert steps.max() <= 1.5 * 1e-3 * dt / 0.5 + 1e-12
    assert np.abs(np.diff([0.0, *steps])).max() < 6.5 * 1e-3 * (dt / 0.5) ** 2


def test_too_large_a_change_is_refused_while_streaming_and_taken_in_a_pause() -> None:
    stream = SetpointStream()
    stream.given(np.zeros(1), 10.0)
    with pytest.raises(BadCommand, match="moves a joint by 0.0100"):
        stream.take_over(np.array([1e-2]), 10.1, 2e-3, 0.5)
    assert stream.setpoint(np.array([0.5]), 10.1)[0] == 0.5, "a refusal changes nothing"
    stream.take_over(np.array([1e-2]), 11.0, 2e-3, 0.5)
    assert stream.setpoint(np.array([1e-2]), 11.0)[0] == 1e-2
    # a clock that jumped back is no running stream
    assert not stream.running(5.0)


def test_a_commander_changes_calibration_in_a_stream_without_a_jump() -> None:
    settings = CommanderSettings(stream=True, horizon=0.2, blend=0.3)
    commander = Commander(settings)
    first, second = robot(1e-4, 2e-4), robot(-1e-4, 1e-4)
    assert commander.use(first, 0.0)
    wish = first.correction.pose(AT, ArmState.at_rest(AT, 0.0))
    sent = []
    for k in range(100):
        now = 100.0 + 0.01 * k
        at = ArmState.at_rest(AT, now)
        if k == 20:
            assert not commander.use(second, now), "it must wait for a setpoint"
        commander.change_over(at, now)
        setpoint = commander.setpoint(wish, "", at, now)
        commander.sent(setpoint, now)
        sent.append(setpoint.q)
    assert commander.robot is second
    assert np.abs(np.diff(sent, axis=0)).max() < 2e-5
    assert np.abs(sent[-1] - sent[0]).max() > 5e-5
    reached = second.correction.pose(sent[-1], ArmState.at_rest(sent[-1], 101.0))
    assert np.abs(reached - wish).max() < 1e-9


def test_a_commander_keeps_to_limits_that_only_the_description_knows() -> None:
    narrow = replace(ur10(), upper=np.array([0.31, *ur10().upper[1:]]))
    commander = Commander(CommanderSettings(), robot(1e-4, 2e-4, chain=narrow))
    for beyond, allowed in ((0.005, True), (0.02, False)):
        there = AT + beyond
        wish = commander.robot.correction.pose(there, ArmState.at_rest(there, 0.0))
        if allowed:
            assert np.abs(commander.setpoint(wish, "", ArmState.at_rest(AT, 0.0), 0.0).q - there).max() < 1e-6
        else:
            with pytest.raises(BadCommand, match="shoulder_pan_joint"):
                commander.setpoint(wish, "", ArmState.at_rest(AT, 0.0), 0.0)


def test_a_commander_without_a_robot_or_a_way_refuses() -> None:
    commander = Commander(CommanderSettings(stream=True))
    at = ArmState.at_rest(AT, 0.0)
    with pytest.raises(BadCommand, match="no command is corrected"):
        commander.setpoint(np.eye(4), "", at, 0.0)
    commander.use(robot(1e-4, 2e-4), 0.0)
    with pytest.raises(NotReachable):
        commander.setpoint(se3.transform(p=[1.5, 1.0, 0.9]), "", at, 0.0)
    straight = np.array([0.3, -1.2, 0.0, -0.8, 1.1, 0.2])
    wish = commander.robot.correction.pose(straight, ArmState.at_rest(straight, 0.0))
    with pytest.raises((BadCommand, NotReachable)):
        commander.setpoint(wish, "", ArmState.at_rest(straight + 1e-4, 0.0), 0.0)


def test_a_robot_must_be_the_one_that_was_calibrated() -> None:
    made = calibration_of(true_model(started("gear")))
    with pytest.raises(BadRobot):
        CalibratedRobot.of(made, "<robot name='r'><link name='base_link'/></robot>")


def test_a_joint_that_does_not_move_keeps_the_side_it_came_from() -> None:
    at = ArmState.at_rest([0.1, 0.2, 0.3, 0.4], 5.0, approach=[1.0, -1.0, 1.0, 0.0])
    there = at.arriving(at.q + [0.0, 0.0, -0.2, 0.3])
    assert there.approach.tolist() == [1.0, -1.0, -1.0, 1.0]
    assert np.array_equal(there.velocity, np.zeros(4))


COUNT = 120


@pytest.fixture(scope="module")
def cell() -> RecordedDelta:
    return record_delta(4, COUNT + 40, "pose", unequal=(6e-4, 6e-4, -6e-4))


@pytest.fixture(scope="module")
def calibration(cell: RecordedDelta) -> Calibration:
    return calibrate(cell.samples.select(np.arange(COUNT)), cell.nominal, np.random.default_rng(0)).calibration


@pytest.mark.slow
def test_true_poses_in_the_trackers_frame(cell: RecordedDelta, calibration: Calibration) -> None:
    rest = cell.samples.select(np.arange(COUNT, COUNT + 40))
    correction = Correction(calibration)
    T = correction.poses(rest.q, ArmState.at_rest(rest.q[0], 0.0), "tool", "tracker")
    assert np.sqrt(np.mean(np.sum((T[:, :3, 3] - rest.reading) ** 2, axis=1))) < 1.5 * 3e-5 * np.sqrt(3.0)
    plain = cell.nominal
    nominal = tool_frames(plain, np.eye(4), rest.q).transform(-1)
    moved = correction.poses(rest.q, ArmState.at_rest(rest.q[0], 0.0)) @ se3.inverse(nominal)
    assert np.abs(moved[:, :3, 3]).max() > 2e-4


def test_a_command_brings_the_tool_there(cell: RecordedDelta, calibration: Calibration) -> None:
    correction = Correction(calibration)
    seed, wanted = cell.samples.q[0], cell.samples.q[1]
    at = ArmState.at_rest(seed, 0.0)
    desired = correction.pose(wanted, at, "tool")
    command = compensate(correction, desired, seed, at, "tool")
    assert np.abs(command.q - wanted).max() < 1e-6
    level = desired.copy()  # as somebody asks who knows nothing of the platform's tilt
    level[:3, :3] = so3.exp(np.array([0.0, 0.0, 0.3])) @ calibration.calibrated.T_tip_tool[:3, :3]
    command = compensate(correction, level, seed, at, "tool")
    truly = correction.pose(command.q, at, "tool")
    assert np.linalg.norm(truly[:3, 3] - level[:3, 3]) < 1e-7
    tilted = level.copy()
    tilted[:3, :3] = so3.exp(np.array([0.3, 0.0, 0.0])) @ level[:3, :3]
    with pytest.raises(NotReachable, match="cannot turn so"):
        compensate(correction, tilted, seed, at, "tool")


def test_the_covariance_is_what_the_fit_scatters_by(calibration: Calibration, cell: RecordedDelta) -> None:
    correction = Correction(calibration)
    C = correction.covariance(cell.samples.q[3], ArmState.at_rest(cell.samples.q[3], 0.0))
    assert np.all(np.linalg.eigvalsh(C) > 0.0)
    assert 5e-6 < np.sqrt(np.trace(C[:3, :3])) < 5e-4


def test_a_commander_knows_its_delta(calibration: Calibration, cell: RecordedDelta) -> None:
    robot = CalibratedRobot.of(calibration, cell.nominal)
    assert corrected_urdf(robot, "") == ""
    commander = Commander()
    assert commander.use(robot, 0.0)
    at = ArmState.at_rest(cell.samples.q[0], 0.0)
    desired = robot.correction.pose(cell.samples.q[2], at)
    assert np.abs(commander.setpoint(desired, "", at, 0.0).q - cell.samples.q[2]).max() < 1e-5
    other = cell.nominal.moved(np.full((6, 3), 1e-3))
    with pytest.raises(BadRobot):
        CalibratedRobot.of(calibration, other)


@pytest.mark.slow
def test_a_trusted_delta_is_watched(calibration: Calibration, cell: RecordedDelta) -> None:
    """Readings as before raise no alarm; an arm whose zero has moved does, and is named."""
    live = Live(calibration)
    for i in range(COUNT, COUNT + 20):
        live.add(cell.samples.select(np.array([i])))
    assert live.hypothesis is None
    assert np.abs(live.estimator.values).max() < 1.0
    world = cell.world.tool_in_tracker(cell.samples.q + np.array([0.0, 3e-3, 0.0, 0.0]))
    for i in range(COUNT, COUNT + 20):
        row = cell.samples.select(np.array([i]))
        live.add(_read(row, world[i]))
    assert live.hypothesis.place == "arm_2" or any("arm_2" in name for name in live.hypothesis.same_as)


def _read(row: Samples, T: np.ndarray) -> Samples:
    return replace(row, reading=T[None, :3, 3], R=T[None, :3, :3])


SPREAD = NoiseModel(NOISE_M, 1e-4)
T_TIP_TOOL = se3.exp(np.array([0.05, 0.03, 0.12, 0.4, -0.2, 0.1]))


def test_misses_are_how_far_mujocos_tool_is_from_the_drawings(rng: np.random.Generator) -> None:
    """In the base link: from where the drawing has the tool to where MuJoCo has it, however the tracker stands."""
    chain = ur10()
    world = World(chain, rng, 5e-4, 1e-3, se3.exp(rng.normal(size=6)), T_TIP_TOOL)
    q = rng.uniform(-2.0, 2.0, (40, 6))
    seen = samples_of(chain, q, world.tool_in_tracker(q))
    drawn = Model(chain, ("tracker",), world.T_tracker_base[None], T_TIP_TOOL)
    of = residuals(drawn, seen, SPREAD)
    expected = (chain_forward(chain, q) @ T_TIP_TOOL)[:, :3, 3]
    assert np.abs(of.expected - expected).max() < 1e-12
    assert np.abs(of.residual - (world.tool_in_base(q)[:, :3, 3] - expected)).max() < 1e-12
    assert of.size.max() > 1e-3
    assert of.rejected.sum() > 20  # a millimetre is far outside this spread


def test_frames_are_known_by_their_names(rng: np.random.Generator) -> None:
    model, q = true_model(), rng.uniform(-2.0, 2.0, (4, 6))
    samples = samples_of(model.serial, q, model.predict(q))
    mixed = replace(samples, frames=("elsewhere", "tracker"), frame=np.array([1, 0, 0, 1]))
    kept = known_to(model, mixed)
    assert kept.frames == ("tracker",)
    assert kept.frame.tolist() == [0, 0]
    assert np.array_equal(kept.q, q[[0, 3]])


def test_axes_are_mujocos(rng: np.random.Generator) -> None:
    chain = ur10()
    world = World(chain, rng, 0.0, 0.0)
    q = rng.uniform(-2.0, 2.0, 6)
    world.tool_in_base(q)
    p, d = joint_axes(chain, q)
    ids = [world.model.body(body_name(name)).jntadr[0] for name in chain.names]
    assert np.abs(d - world.data.xaxis[ids]).max() < 1e-12
    gap = p - world.data.xanchor[ids]
    assert np.abs(np.cross(gap, d)).max() < 1e-12  # on one line
    assert isinstance(world.model, mujoco.MjModel)


def test_axes_stand_off_as_much_larger_as_is_said(rng: np.random.Generator) -> None:
    nominal, q = ur10(), rng.uniform(-2.0, 2.0, 6)
    calibrated = true_model().serial
    (p, d), (p_true, d_true) = joint_axes(nominal, q), joint_axes(calibrated, q)
    angle = np.linalg.norm(np.cross(d, d_true), axis=1)
    assert angle.min() > 1e-5
    for scale in (1.0, 20.0):
        at, along = enlarged_axes(nominal, calibrated, q, scale)
        assert np.abs(at - p - scale * (p_true - p)).max() < 1e-12
        assert np.allclose(np.linalg.norm(along, axis=1), 1.0)
        # a tangent for a sine: what is enlarged is the step across the axis
        assert np.tan(np.arccos(np.sum(along * d, axis=1))) == pytest.approx(scale * angle, rel=1e-5)
    _, along = enlarged_axes(nominal, calibrated, q, 1e9)
    assert (np.sum(along * d, axis=1) > 0.0).all()


def test_an_ellipsoid_holds_as_much_as_it_should(rng: np.random.Generator) -> None:
    """Of a normal distribution, the share within three deviations is that of a chi-square of three degrees below 9."""
    A = rng.normal(size=(3, 3)) * [1e-4, 3e-5, 1e-5]
    C = A @ A.T
    R, half = ellipsoid(C)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.allclose(R @ np.diag((half / 3.0) ** 2) @ R.T, C, rtol=1e-9, atol=1e-20)
    x = rng.multivariate_normal(np.zeros(3), C, 20_000)
    inside = np.mean(np.sum((x @ R / half) ** 2, axis=1) < 1.0)
    assert inside == pytest.approx(0.97071, abs=4.0 * np.sqrt(0.97071 * 0.02929 / 20_000))


def test_the_ellipsoid_is_about_the_predicted_tool(rng: np.random.Generator) -> None:
    model = true_model(STEEP.started(np.array([2e-4, 1e-4])))
    correction, q = Correction(calibration_of(model)), rng.uniform(-2.0, 2.0, 6)
    at = moment(q, rng)
    T, half = tool_ellipsoid(correction, at)
    assert np.abs(T[:3, 3] - correction.pose(q, at, "tool")[:3, 3]).max() < 1e-15
    assert half == pytest.approx(3.0 * correction.calibration.noise.position)
    unknown = replace(correction.calibration, noise=NoiseModel(np.nan, 1e-4))
    with pytest.raises(BadCommand):
        tool_ellipsoid(Correction(unknown), at)
