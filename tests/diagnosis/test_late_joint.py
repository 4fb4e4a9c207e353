"""A joint whose logged value lags its command is found at its joint, with its share; a sound log stays clean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10

from modcal_core.calibration.store import from_data, to_data
from modcal_core.evaluation import evaluate
from modcal_core.geometry import so3
from modcal_core.loop import Solution, calibrate
from modcal_core.measurements.samples import Samples

ELBOW = 2
SHARE = 0.8
LATE, AHEAD = 12e-3, 30e-3  # s; the log behind the arm, and the commands before it


def late(seed: int, count: int, share: float) -> Samples:
    """The elbow is logged short of its command by a milliradian or so, and truly by less, in proportion."""
    made = record(seed, count)
    rng = np.random.default_rng(seed)
    apart = 2e-5 * rng.standard_normal(made.samples.q.shape)
    apart[:, ELBOW] += 1e-3 * rng.standard_normal(count)
    q = made.samples.q.copy()
    q[:, ELBOW] -= share * apart[:, ELBOW]
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = made.samples.R, made.samples.reading
    return replace(samples_of(ur10(), q, T), following=apart)


def in_motion(seed: int, count: int, *, by_share: bool) -> Samples:
    """An arm that never stops. The elbow's log is late by a time; or by a share of what is left to its command, which
    goes its own way.
    """
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.6, 1.2, (2, 6)), rng.uniform(0.0, 2.0 * np.pi, (2, 6))
    size = 0.5

    def course(t: np.ndarray, order: int = 0) -> np.ndarray:
        """The course of all joints at times (N,), or its derivative of some order, (N, 6)."""
        angle = t[:, None, None] * rate + phase + 0.5 * np.pi * order
        return np.asarray((size * rate**order * np.sin(angle)).sum(axis=1))

    t = 0.05 * np.arange(count)
    lag = np.zeros(6)
    lag[ELBOW] = 0.0 if by_share else LATE
    q, velocity, acceleration = (
        np.stack([course(t - lag[j], order)[:, j] for j in range(6)], axis=1) for order in range(3)
    )
    following = course(t + AHEAD) - q
    if by_share:
        following[:, ELBOW] *= 1.0 + 0.5 * np.sin(3.0 * t)
        q[:, ELBOW] -= SHARE * following[:, ELBOW] / (1.0 - SHARE)
        following[:, ELBOW] /= 1.0 - SHARE
    made = record(seed, 1)
    T = made.world.tool_in_tracker(course(t))
    T[:, :3, 3] += 5e-5 * rng.standard_normal((count, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(5e-5 * rng.standard_normal((count, 3)))
    return replace(
        samples_of(ur10(), q, T), stamps=1.7e9 + t, velocity=velocity, acceleration=acceleration,
        following=following, moving=np.ones(count, bool),
    )  # fmt: skip


@pytest.fixture(scope="module")
def found() -> Solution:
    return calibrate(late(1, 120, SHARE), ur10(), np.random.default_rng(0))


@pytest.mark.slow
def test_it_is_named_at_its_joint_with_its_share(found: Solution) -> None:
    (effect,) = found.report.effects
    assert (effect.family, effect.place, effect.driver) == ("joint_lag", "elbow_joint", "following:elbow_joint")
    share, std, unit = effect.parameters["stale_share"]
    assert abs(share - SHARE) < 4.0 * std < 0.1
    assert unit == "1"
    assert any("stale by 0." in text and "of commanded − measured" in text for text in found.report.story)
    truth = calibrate(record(1, 120).samples, ur10(), np.random.default_rng(0)).report.size_mm("final")
    size = found.report.size_mm("final")
    assert size is not None
    assert truth is not None
    assert size.rms < 1.03 * truth.rms  # as with a log that is right


@pytest.mark.slow
def test_it_is_kept_in_the_file_and_its_lack_has_a_cost(found: Solution) -> None:
    calibration = from_data(to_data(found.calibration))
    samples = late(1, 120, SHARE)
    rng = np.random.default_rng(0)
    kept = evaluate(calibration, samples, rng)
    assert kept.grounds.not_applied == ()
    (item,) = evaluate(
        calibration, replace(samples, following=np.full_like(samples.q, np.nan)), rng
    ).grounds.not_applied
    assert "no commanded positions of elbow_joint" in item.why
    assert item.cost_mm2 > 0.1


@pytest.mark.slow
def test_a_log_that_is_right_stays_clean() -> None:
    """Joints are away from their commands, and say so."""
    samples = late(2, 120, 0.0)
    report = calibrate(samples, ur10(), np.random.default_rng(0)).report
    assert report.effects == ()


@pytest.mark.slow
def test_a_joint_that_is_farther_from_its_command_than_it_says_is_not_called_late() -> None:
    """A spring under the torque that makes up the following error: the same driver, the other sign."""
    samples = late(3, 120, -0.8)
    report = calibrate(samples, ur10(), np.random.default_rng(0)).report
    assert report.effects
    assert all(effect.family != "joint_lag" for effect in report.effects)
    assert {effect.driver for effect in report.effects} == {"following:elbow_joint"}


@pytest.mark.slow
def test_a_delay_in_motion_is_a_time_and_no_gear_ratio_stands_beside_it() -> None:
    """A share of commanded − measured is nearly a delay; what it leaves follows the acceleration, and so the position."""
    (effect,) = calibrate(in_motion(4, 600, by_share=False), ur10(), np.random.default_rng(0)).report.effects
    assert (effect.family, effect.place, effect.driver) == ("joint_lag", "elbow_joint", "velocity")
    delay, std, unit = effect.parameters["delay"]
    assert abs(delay - LATE) < 4.0 * std < 1e-3
    assert unit == "s"


@pytest.mark.slow
def test_a_share_in_motion_stays_a_share() -> None:
    """Where the command goes its own way, a time is not what the log is late by."""
    (effect,) = calibrate(in_motion(5, 600, by_share=True), ur10(), np.random.default_rng(0)).report.effects
    assert (effect.family, effect.place, effect.driver) == ("joint_lag", "elbow_joint", "following:elbow_joint")
    share, std, _ = effect.parameters["stale_share"]
    assert abs(share - SHARE) < 4.0 * std < 0.1
