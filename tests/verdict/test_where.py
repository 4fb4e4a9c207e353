"""What the rest of an open verdict depends on is named: joint, tool, base or tracker, and what has two values."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from cells import NOISE_M, NOISE_RAD, Recorded, noisy, record, samples_of, ur10

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.noise import NoiseModel
from modcal_core.calibration.stated import Stated
from modcal_core.evaluation import evaluate
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.path import ahead
from modcal_core.measurements.samples import Samples
from modcal_core.verdict.case import Case
from modcal_core.verdict.drivers import PlaceDrivers
from modcal_core.verdict.rest import Rest

CHAIN = ur10()
KNOWN = Cell(
    stated=Stated(repeatability_mm=0.01, repeatability_deg=0.001, instrument_mm=0.09, instrument_deg=0.006)
)  # what the readings scatter by, and a little


@pytest.fixture(scope="module")
def made() -> Recorded:
    return record(21, 120)


def said(samples: Samples) -> str:
    report = calibrate(samples, CHAIN, np.random.default_rng(0), KNOWN, look_for_effects=False).report
    return " ".join(report.judged.open_because)


def with_error(made: Recorded, j: int, off: Array) -> Samples:
    """Readings of an arm whose joint stands elsewhere than reported by so much (N,)."""
    q = made.samples.q.copy()
    q[:, j] += off
    return made.reread(made.world.tool_in_tracker(q))


def test_no_driver_holds_what_was_read(made: Recorded) -> None:
    """Errors of readings stand in the residuals alone; an instrument they are to depend on is where the model has it."""
    model = fit_cell(CHAIN, made.exact, Cell()).model
    noise = NoiseModel(5e-5, 5e-5)
    for error in (np.zeros(3), np.random.default_rng(3).normal(0.0, 0.05, (len(made.exact), 3))):
        samples = replace(made.exact, reading=made.exact.reading + error)
        none: Any = None
        case = Case(samples, none, none, "station", model, none, noise, {}, none, fitted=True)
        drivers = PlaceDrivers(Rest.of(case, np.arange(len(samples))))
        J = np.ones((1, 6, len(samples)))
        every = (*drivers.grouped(), *drivers.alone(constant=True), *drivers.changed(J))
        columns = [part.columns for part in every if "a gear" not in part.driver]  # whose teeth the residuals choose
        if error.ndim == 1:
            exact = columns
    for one, other in zip(exact, columns, strict=True):
        np.testing.assert_allclose(other, one, rtol=0.0, atol=1e-9 * max(np.abs(one).max(), 1.0))


@pytest.mark.slow
def test_a_tracker_whose_scale_changes_with_distance(made: Recorded) -> None:
    far = np.linalg.norm(made.samples.reading, axis=1, keepdims=True)
    bent = replace(made.samples, reading=made.samples.reading * (1.0 + 1e-3 * (far - far.mean()) ** 2))
    assert "an error of the tracker's readings" in said(bent)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["the sine of the beam's angle", "the target's roll"])
def test_a_target_that_is_read_by_the_side_it_shows(made: Recorded, how: str) -> None:
    sight = made.samples.reading / np.linalg.norm(made.samples.reading, axis=1, keepdims=True)
    x, y, z = np.einsum("nji,nj->in", made.samples.R, sight)
    size = np.sqrt(1.0 - z**2) if "angle" in how else np.sin(2.0 * np.arctan2(y, x))
    bent = replace(made.samples, reading=made.samples.reading + 4e-4 * size[:, None] * sight)
    assert "the side from which the tracker sees the target" in said(bent)


@pytest.mark.slow
def test_a_loose_tool_falls_to_its_lower_side(made: Recorded) -> None:
    down = made.world.T_tracker_base[:3, :3] @ [0.0, 0.0, -1.0]
    side = np.sign(made.samples.R[:, :, 0] @ down)[:, None]
    loose = replace(made.samples, reading=made.samples.reading + 4e-4 * side * made.samples.R[:, :, 0])
    text = said(loose)
    assert "how it is turned against gravity, as an error of the tool" in text


@pytest.mark.slow
def test_a_joint_with_a_wide_hysteresis(made: Recorded) -> None:
    behind = ahead(made.samples.q, np.array([0.8]), np.arange(len(made.samples))).mean(axis=2)[:, 2, 0]
    text = said(with_error(made, 2, 8e-4 * behind))
    assert "how elbow_joint arrived" in text
    assert "as an error of joint elbow_joint" in text


@pytest.mark.slow
def test_a_base_whose_bolts_hold_by_friction(made: Recorded) -> None:
    """The base tilts with the weight's moment until it slips, and from there again: MuJoCo's poses say the moment."""
    base = made.world.T_tracker_base
    reach = (np.linalg.inv(base) @ made.world.tool_in_tracker(made.samples.q))[:, :2, 3]
    held, turn = np.zeros(2), np.zeros((120, 3))
    for k, moment in enumerate(reach):
        held = np.clip(held, moment - 0.7 * reach.std(axis=0), moment + 0.7 * reach.std(axis=0))
        turn[k] = [-1.5e-3 * (moment - held)[1], 1.5e-3 * (moment - held)[0], 0.0]
    T = base @ se3.transform(so3.exp(turn), np.zeros((120, 3))) @ np.linalg.inv(base)
    text = said(made.reread(T @ made.world.tool_in_tracker(made.samples.q)))
    assert "(slip), as an error of the base" in text


@pytest.mark.slow
def test_a_frozen_model_of_an_arm_with_a_new_zero_and_outside_its_range(made: Recorded) -> None:
    inner = np.flatnonzero(made.samples.q[:, 1] < 1.0)
    frozen = calibrate(made.samples.select(inner), CHAIN, np.random.default_rng(0), KNOWN, look_for_effects=False)
    moved = with_error(made, 4, np.full(120, 2e-3))
    report = evaluate(frozen.calibration, moved, np.random.default_rng(0), cell=KNOWN)
    text = " ".join(report.judged.open_because)
    assert "is a constant error of joint wrist_2_joint" in text
    assert "lie outside the joint ranges that were calibrated: shoulder_lift_joint" in text
    assert report.judged.status == "open"


@pytest.mark.slow
def test_a_joint_is_named_by_the_direction_of_its_error_alone(made: Recorded) -> None:
    """Its error goes with nothing, but it moves the tool as no other joint does."""
    off = 1e-3 * np.random.default_rng(8).normal(size=len(made.samples))
    assert "of what is left lies along the motion of joint elbow_joint" in said(with_error(made, 2, off))


@pytest.mark.slow
def test_positions_alone_that_miss_are_no_joint(made: Recorded) -> None:
    off = 8e-4 * np.random.default_rng(9).normal(size=(len(made.samples), 3))
    text = said(replace(made.samples, reading=made.samples.reading + off))
    assert "Look at what moves points alone" in text


BIT = 2.0 * np.pi / 4096.0


def groups_in(samples: Samples) -> str:
    report = calibrate(samples, CHAIN, np.random.default_rng(0), look_for_effects=False).report
    return " ".join(s for s in report.judged.open_because if "two groups" in s)


def bent(made: Recorded, q: Array, tool: Array | None = None) -> Samples:
    """What is read of an arm that stands at q and reports other positions, its tool moved by twists (N, 6)."""
    T = made.world.tool_in_tracker(q)
    return made.reread(T if tool is None else T @ se3.exp(tool))


@pytest.mark.slow
def test_a_bit_that_an_encoder_lost(made: Recorded) -> None:
    """The reported position lacks the bit; the arm stands where it stands."""
    samples = made.samples
    q = samples.q.copy()
    q[:, 2] -= BIT * (np.floor(q[:, 2] / BIT) % 2.0)
    text = groups_in(replace(samples, q=q))
    assert "joint elbow_joint had two positions" in text
    assert "1/4096 of a turn" in text


@pytest.mark.slow
def test_a_tracker_that_looks_with_either_face(made: Recorded) -> None:
    face = np.random.default_rng(1).choice([-1.0, 1.0], 120)[:, None]
    shifted = made.samples.reading + 3e-4 * face * [0.6, -0.8, 0.0]
    text = groups_in(replace(made.samples, reading=shifted))
    assert "the tracker, in its positions, had two positions" in text
    apart = re.search(r"([0-9.]+) mm apart", text)
    assert float(apart[1]) == pytest.approx(0.6, rel=0.1)  # the geometry takes up a part


@pytest.mark.slow
def test_two_groups_far_apart_keep_their_distance(made: Recorded) -> None:
    """A frozen model, of which nearly half of the readings stand 5 mm beside the others."""
    calibration = calibrate(made.samples, CHAIN, np.random.default_rng(0), look_for_effects=False).calibration
    beside = np.where(np.arange(120) % 9 < 4, 5e-3, 0.0)[:, None] * [0.6, -0.8, 0.0]
    samples = replace(made.samples, reading=made.samples.reading + beside)
    judged = evaluate(calibration, samples, np.random.default_rng(0)).judged
    apart = re.search(r"([0-9.]+) mm apart", " ".join(judged.open_because))
    assert float(apart[1]) == pytest.approx(5.0, rel=0.1)


@pytest.mark.slow
def test_a_target_that_sits_in_one_of_two_places(made: Recorded) -> None:
    seat = np.random.default_rng(2).random(120) < 0.4
    step = np.where(seat[:, None], [4e-4, 0.0, 3e-4, 8e-4, 0.0, 0.0], 0.0)
    assert "the tool (or the target on it) had two positions" in groups_in(bent(made, made.samples.q, step))


@pytest.mark.slow
def test_one_of_two_targets_seen_by_points(made: Recorded) -> None:
    other = np.arange(120) % 3 == 2
    step = np.where(other[:, None], [4e-4, 0.0, 3e-4, 0.0, 0.0, 0.0], 0.0)
    seen = bent(made, made.samples.q, step)
    points = replace(seen, kind=np.full(120, "point"), R=np.broadcast_to(np.eye(3), seen.R.shape))
    assert "the tool (or the target on it) had two positions" in groups_in(points)


@pytest.mark.slow
@pytest.mark.parametrize("off", ["normal", "uniform", "wave", "outliers"])
def test_what_has_more_values_than_two_is_not_split(made: Recorded, off: str) -> None:
    rng, q = np.random.default_rng(3), made.samples.q.copy()
    if off == "normal":
        q[:, 2] += 5e-4 * rng.normal(size=120)
    elif off == "uniform":
        q[:, 2] += 1e-3 * rng.uniform(-1.0, 1.0, 120)
    elif off == "wave":
        q[:, 2] += 8e-4 * np.sin(37.0 * q[:, 2])
    else:
        q[:, 2] += 5e-4 * rng.standard_t(2.0, 120)
    assert groups_in(bent(made, q)) == ""


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), [("pose", 0), ("point", 1)])
def test_nothing_is_split_on_clean_arms(seed: int, kind: str) -> None:
    assert groups_in(record(40 + seed, 40, kind).samples) == ""


@pytest.mark.slow
def test_a_joint_that_was_mastered_again_is_not_two_trackers(made: Recorded) -> None:
    """Stations on two sides of the arm, which its new zero moves apart."""
    calibration = calibrate(made.samples, CHAIN, np.random.default_rng(0), look_for_effects=False).calibration
    rng = np.random.default_rng(3)
    q = np.array([0.0, -1.5, 0.3, -0.5, 1.4, 0.3]) + 0.15 * rng.standard_normal((120, 6))
    q[:, 0] += rng.choice([-1.5, 1.5], 120)
    q[:, 3:] += rng.uniform(-1.5, 1.5, (120, 3))
    T = made.world.tool_in_tracker(q + 4e-3 * (np.arange(6) == 1))
    T = noisy(T, NOISE_M, NOISE_RAD, rng)
    judged = evaluate(calibration, samples_of(CHAIN, q, T), np.random.default_rng(0)).judged
    assert judged.status == "open"
    assert not any("two groups" in s for s in judged.open_because)
