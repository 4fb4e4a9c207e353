"""Joints whose log lags, searches that go on to what predicts, and sums over samples whichever way they are taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration.test_identify import fit_all
from cells import noisy, record, samples_of, ur10

from modcal_core.calibration.data_split import split
from modcal_core.calibration.fit import Fit
from modcal_core.calibration.store import from_data, to_data
from modcal_core.diagnosis.evidence import Scanner
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.registry import candidates
from modcal_core.evaluation import evaluate
from modcal_core.geometry import so3
from modcal_core.loop import Solution, calibrate
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import Samples

pytestmark = pytest.mark.slow

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
    T = noisy(T, 5e-5, 5e-5, rng)
    return replace(
        samples_of(ur10(), q, T), stamps=1.7e9 + t, velocity=velocity, acceleration=acceleration,
        following=following, moving=np.ones(count, bool),
    )  # fmt: skip


@pytest.fixture(scope="module")
def found() -> Solution:
    return calibrate(late(1, 120, SHARE), ur10(), np.random.default_rng(0))


def test_it_is_named_at_its_joint_with_its_share(found: Solution) -> None:
    (effect,) = found.report.effects
    assert (effect.family, effect.place, effect.driver) == ("joint_lag", "elbow_joint", "following:elbow_joint")
    share, std, unit = effect.parameters["stale_share"]
    assert abs(share - SHARE) < 4.0 * std < 0.1
    assert unit == "1"
    assert any("stale by 0." in text and "of commanded − measured" in text for text in found.report.story)
    truth = calibrate(record(1, 120).samples, ur10(), np.random.default_rng(0)).report
    assert found.report.size_mm("final").rms < 1.03 * truth.size_mm("final").rms  # as with a log that is right


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


def test_a_log_that_is_right_stays_clean() -> None:
    """Joints are away from their commands, and say so."""
    samples = late(2, 120, 0.0)
    report = calibrate(samples, ur10(), np.random.default_rng(0)).report
    assert report.effects == ()


def test_a_joint_that_is_farther_from_its_command_than_it_says_is_not_called_late() -> None:
    """A spring under the torque that makes up the following error: the same driver, the other sign."""
    samples = late(3, 120, -0.8)
    report = calibrate(samples, ur10(), np.random.default_rng(0)).report
    assert report.effects
    assert all(effect.family != "joint_lag" for effect in report.effects)
    assert {effect.driver for effect in report.effects} == {"following:elbow_joint"}


def test_a_delay_in_motion_is_a_time_and_no_gear_ratio_stands_beside_it() -> None:
    """A share of commanded − measured is nearly a delay; what it leaves follows the acceleration, and so the position."""
    (effect,) = calibrate(in_motion(4, 600, by_share=False), ur10(), np.random.default_rng(0)).report.effects
    assert (effect.family, effect.place, effect.driver) == ("joint_lag", "elbow_joint", "velocity")
    delay, std, unit = effect.parameters["delay"]
    assert abs(delay - LATE) < 4.0 * std < 1e-3
    assert unit == "s"


def test_a_share_in_motion_stays_a_share() -> None:
    """Where the command goes its own way, a time is not what the log is late by."""
    (effect,) = calibrate(in_motion(5, 600, by_share=True), ur10(), np.random.default_rng(0)).report.effects
    assert (effect.family, effect.place, effect.driver) == ("joint_lag", "elbow_joint", "following:elbow_joint")
    share, std, _ = effect.parameters["stale_share"]
    assert abs(share - SHARE) < 4.0 * std < 0.1


PAN, WRIST_2, WRIST_3 = 0, 4, 5


def misleading(count: int) -> Samples:
    """A wrist that turns a little too far; and signals that other joints follow where they are fitted, and nowhere else.

    They explain most of what is left, and predict nothing.
    """
    made = record(21, count)
    q, rng = made.samples.q, np.random.default_rng(3)
    sets = split(made.samples, np.random.default_rng(0), None, [])
    actual = q.copy()
    actual[:, WRIST_2] += 3e-4 * q[:, WRIST_2]
    signals = {f"/noise_{j}": rng.standard_normal(count) for j in (PAN, WRIST_3)}
    for j, signal in zip((PAN, WRIST_3), signals.values(), strict=True):
        actual[sets.train, j] += 8e-4 * signal[sets.train]
        actual[sets.explain, j] -= 4e-4 * signal[sets.explain]
    T = made.world.tool_in_tracker(actual)
    T[:, :3, 3] += 3e-5 * rng.standard_normal((count, 3))
    samples = samples_of(ur10(), q, T)
    t = samples.stamps
    return replace(samples, signals=tuple(SignalTrack(f"signal:{n}", t, x[:, None], n) for n, x in signals.items()))


def test_a_choice_that_does_not_predict_does_not_end_the_search() -> None:
    report = calibrate(misleading(620), ur10(), np.random.default_rng(0)).report
    found = [(e.family, e.place) for e in report.effects if e.family != "outliers"]
    assert found == [("gear_ratio", "wrist_2_joint")]
    # what was refused is said where the rest is surely predictable
    assert (report.left is not None) == report.judged.predicted


def swaying(seed: int, count: int = 900) -> Samples:
    """An arm that never stops, on a stand that tilts with its acceleration."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.6, 1.2, (2, 6)), rng.uniform(0.0, 2.0 * np.pi, (2, 6))
    t = 0.05 * np.arange(count)
    angle = t[:, None, None] * rate + phase
    q, acceleration = 0.5 * np.sin(angle).sum(axis=1), -0.5 * (rate**2 * np.sin(angle)).sum(axis=1)
    forward = acceleration[:, 1:2] * np.stack([np.cos(q[:, 0]), np.sin(q[:, 0]), np.zeros(count)], axis=1)
    aside = np.stack([acceleration[:, 0] * np.sin(q[:, 1]), acceleration[:, 2], acceleration[:, 0]], axis=1)
    tilt = so3.exp(2e-4 * forward + 1e-4 * aside)
    T = record(seed, 1).world.tool_in_tracker(q)
    T[:, :3] = tilt @ T[:, :3]
    T[:, :3, 3] += 2e-5 * rng.standard_normal((count, 3))
    return replace(samples_of(ur10(), q, T), stamps=t, moving=np.ones(count, bool))


def test_of_what_remains_in_motion_nothing_is_named_that_does_not_stand_out() -> None:
    """Curves of joints predict neighbours in time, whose errors they share."""
    found = calibrate(swaying(2), ur10(), np.random.default_rng(0)).report.effects
    assert {effect.place for effect in found} <= {"base", "tracker"}


@pytest.fixture(scope="module")
def fitted() -> tuple[Fit, Drivers]:
    """An arm with nothing to be found, and its samples."""
    samples = record(3, 60, "pose").samples
    fit = fit_all(ur10(), samples)
    return fit, fit.model.drivers(samples)


def test_a_scan_explains_what_regressions_do(fitted: tuple[Fit, Drivers]) -> None:
    """The share of the residual's squares, the fitted projected out of both, by least squares of one candidate."""
    fit, drivers = fitted
    scanner = Scanner(list(candidates(drivers)), drivers)
    evidence = scanner.evidence(fit)
    space = scanner.space_of(fit)
    Q, r = space.Q.reshape(-1, space.Q.shape[2]), space.residual.ravel()
    total = r @ r - np.sum((Q.T @ r) ** 2)
    for i in range(0, len(evidence.effects), len(evidence.effects) // 60):
        keys, numbers = scanner._factor(evidence.effects[i])
        U = np.stack([(numbers[a] * scanner._column(key, space)).ravel() for a, key in enumerate(keys)], axis=1)
        gram, seen = U.T @ U - (U.T @ Q) @ (U.T @ Q).T, U.T @ r - (U.T @ Q) @ (Q.T @ r)
        scale = np.sqrt(np.einsum("ij,ij->j", U, U))
        value, vector = np.linalg.eigh(gram / np.outer(scale, scale))
        new = value > 0.0025
        explained = np.sum((vector[:, new].T @ (seen / scale)) ** 2 / value[new])
        assert evidence.explained[i] == pytest.approx(explained / total, abs=1e-7)
