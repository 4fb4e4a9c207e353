"""A calibrated Delta is corrected like an arm: where it truly is, what to command, and what it cannot do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from deltas import RecordedDelta, record_delta

from modcal_core.calibration.store import Calibration
from modcal_core.correction.commander import CalibratedRobot, Commander, corrected_urdf
from modcal_core.correction.compensation import compensate
from modcal_core.correction.correction import ArmState, Correction
from modcal_core.errors import BadRobot, NotReachable
from modcal_core.geometry import se3, so3
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.online.supervisor import Live
from modcal_core.robots.mechanism import tool_frames

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
