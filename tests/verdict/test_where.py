"""What the rest of an open verdict depends on is named: joint, tool, base or tracker, and what has two values."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from cells import NOISE_M, NOISE_RAD, noisy, record, samples_of, ur10

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.noise import NoiseModel
from modcal_core.calibration.stated import Stated
from modcal_core.calibration.store import Calibration
from modcal_core.evaluation import evaluate
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.path import ahead
from modcal_core.measurements.samples import Samples
from modcal_core.verdict.case import Case
from modcal_core.verdict.drivers import PlaceDrivers
from modcal_core.verdict.rest import Rest
from modcal_nodes.simulation.mjcf import World

pytestmark = pytest.mark.slow
CHAIN = ur10()
KNOWN = Cell(
    stated=Stated(repeatability_mm=0.01, repeatability_deg=0.001, instrument_mm=0.09, instrument_deg=0.006)
)  # what the readings scatter by, and a little


MADE = record(21, 120)
P, Q, R = MADE.samples.reading, MADE.samples.q, MADE.samples.R
FAR = np.linalg.norm(P, axis=1, keepdims=True)
SIGHT = P / FAR
SEEN = np.einsum("nji,nj->in", R, SIGHT)  # the direction of sight in the target's axes, (3, N)
BIT = 2.0 * np.pi / 4096.0


def said(samples: Samples) -> str:
    report = calibrate(samples, CHAIN, np.random.default_rng(0), KNOWN, look_for_effects=False).report
    return " ".join(report.judged.open_because)


def off(by: Array) -> Samples:
    """The tracker's positions are off (N, 3)."""
    return replace(MADE.samples, reading=P + by)


def bent(j: int, by: Array, tool: Array | None = None) -> Samples:
    """A joint stands elsewhere than reported by so much (N,); the tool is moved by twists (N, 6)."""
    T = MADE.world.tool_in_tracker(Q + np.outer(by, np.arange(6) == j))
    return MADE.reread(T if tool is None else T @ se3.exp(tool))


def test_no_driver_holds_what_was_read() -> None:
    """Errors of readings stand in the residuals alone; an instrument they are to depend on is where the model has it."""
    model = fit_cell(CHAIN, MADE.exact, Cell()).model
    noise = NoiseModel(5e-5, 5e-5)
    for error in (np.zeros(3), np.random.default_rng(3).normal(0.0, 0.05, (len(MADE.exact), 3))):
        samples = replace(MADE.exact, reading=MADE.exact.reading + error)
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


def loose() -> Samples:
    """The tool falls to its lower side."""
    down = MADE.world.T_tracker_base[:3, :3] @ [0.0, 0.0, -1.0]
    return off(4e-4 * np.sign(R[:, :, 0] @ down)[:, None] * R[:, :, 0])


def hysteresis() -> Samples:
    return bent(2, 8e-4 * ahead(Q, np.array([0.8]), np.arange(len(Q))).mean(axis=2)[:, 2, 0])


FAULTS: dict[str, tuple[Callable[[], Samples], tuple[str, ...]]] = {
    "a scale that changes with distance": (
        lambda: off(P * 1e-3 * (FAR - FAR.mean()) ** 2), ("an error of the tracker's readings",)
    ),
    "the sine of the beam's angle": (
        lambda: off(4e-4 * np.sqrt(1.0 - SEEN[2] ** 2)[:, None] * SIGHT), ("the side from which the tracker sees the target",)
    ),
    "the target's roll": (
        lambda: off(4e-4 * np.sin(2.0 * np.arctan2(SEEN[1], SEEN[0]))[:, None] * SIGHT), ("the side from which the tracker sees the target",)
    ),
    "a loose tool": (loose, ("how it is turned against gravity, as an error of the tool",)),
    "a wide hysteresis": (hysteresis, ("how elbow_joint arrived", "as an error of joint elbow_joint")),
    # it goes with nothing, but moves the tool as no other joint does
    "a joint at random": (
        lambda: bent(2, 1e-3 * np.random.default_rng(8).normal(size=120)), ("of what is left lies along the motion of joint elbow_joint",)
    ),
    "positions at random": (lambda: off(8e-4 * np.random.default_rng(9).normal(size=(120, 3))), ("Look at what moves points alone",)),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_what_the_rest_depends_on_is_named(fault: str) -> None:
    make, words = FAULTS[fault]
    text = said(make())
    assert all(word in text for word in words), text


def test_a_base_whose_bolts_hold_by_friction() -> None:
    """The base tilts with the weight's moment until it slips, and from there again: MuJoCo's poses say the moment."""
    base = MADE.world.T_tracker_base
    reach = (np.linalg.inv(base) @ MADE.world.tool_in_tracker(MADE.samples.q))[:, :2, 3]
    held, turn = np.zeros(2), np.zeros((120, 3))
    for k, moment in enumerate(reach):
        held = np.clip(held, moment - 0.7 * reach.std(axis=0), moment + 0.7 * reach.std(axis=0))
        turn[k] = [-1.5e-3 * (moment - held)[1], 1.5e-3 * (moment - held)[0], 0.0]
    T = base @ se3.transform(so3.exp(turn), np.zeros((120, 3))) @ np.linalg.inv(base)
    text = said(MADE.reread(T @ MADE.world.tool_in_tracker(MADE.samples.q)))
    assert "(slip), as an error of the base" in text


def test_a_frozen_model_of_an_arm_with_a_new_zero_and_outside_its_range() -> None:
    inner = np.flatnonzero(Q[:, 1] < 1.0)
    inside = calibrate(MADE.samples.select(inner), CHAIN, np.random.default_rng(0), KNOWN, look_for_effects=False)
    report = evaluate(inside.calibration, bent(4, np.full(120, 2e-3)), np.random.default_rng(0), cell=KNOWN)
    text = " ".join(report.judged.open_because)
    assert "is a constant error of joint wrist_2_joint" in text
    assert "lie outside the joint ranges that were calibrated: shoulder_lift_joint" in text
    assert report.judged.status == "open"


def groups_in(samples: Samples) -> str:
    report = calibrate(samples, CHAIN, np.random.default_rng(0), look_for_effects=False).report
    return " ".join(s for s in report.judged.open_because if "two groups" in s)


@cache
def frozen() -> Calibration:
    return calibrate(MADE.samples, CHAIN, np.random.default_rng(0), look_for_effects=False).calibration


def seated(other: Array, turn: float = 0.0) -> Samples:
    """A target that sits elsewhere at some stations."""
    return bent(0, np.zeros(120), np.outer(other, [4e-4, 0.0, 3e-4, turn, 0.0, 0.0]))


def lost_bit() -> Samples:
    """The reported position lacks a bit; the arm stands where it stands."""
    return replace(MADE.samples, q=Q - np.outer(BIT * (np.floor(Q[:, 2] / BIT) % 2.0), np.arange(6) == 2))


def of_points(samples: Samples) -> Samples:
    return replace(samples, kind=np.full(120, "point"), R=np.broadcast_to(np.eye(3), R.shape))


def of_two_arms() -> Samples:
    """Another arm of the make, on the same base and with the same tool, measured at a third of the stations."""
    rng = np.random.default_rng(21)  # as MADE has it
    base, tool = se3.exp(rng.normal(size=6)), se3.exp(np.r_[0.05, 0.03, 0.12, rng.normal(size=3)])
    theirs = World(CHAIN, np.random.default_rng(9), T_tracker_base=base, T_tip_tool=tool)
    third = (np.arange(120) % 3 == 2)[:, None, None]
    return MADE.reread(np.where(third, theirs.tool_in_tracker(Q), MADE.world.tool_in_tracker(Q)))


TOOL = "the tool (or the target on it) had two positions"
GROUPS: dict[str, tuple[Callable[[], Samples], tuple[str, ...]]] = {
    "a bit that an encoder lost": (lost_bit, ("joint elbow_joint had two positions", "1/4096 of a turn")),
    "one of two places": (lambda: seated(np.random.default_rng(2).random(120) < 0.4, 8e-4), (TOOL,)),
    "one of two targets, by points": (lambda: of_points(seated(np.arange(120) % 3 == 2)), (TOOL,)),
    "two arms in turn": (of_two_arms, ("as if two arms, or two states of one, had been mixed",)),
    # what has more values than two is not split
    "normal": (lambda: bent(2, 5e-4 * np.random.default_rng(3).normal(size=120)), ()),
    "uniform": (lambda: bent(2, 1e-3 * np.random.default_rng(3).uniform(-1.0, 1.0, 120)), ()),
    "wave": (lambda: bent(2, 8e-4 * np.sin(37.0 * Q[:, 2])), ()),
    "outliers": (lambda: bent(2, 5e-4 * np.random.default_rng(3).standard_t(2.0, 120)), ()),
    "a clean arm": (lambda: record(40, 40).samples, ()),
    "a clean arm, by points": (lambda: record(41, 40, "point").samples, ()),
}  # fmt: skip


@pytest.mark.parametrize("of", GROUPS)
def test_two_values_are_named_with_what_has_them_and_nothing_else_is_split(of: str) -> None:
    make, words = GROUPS[of]
    text = groups_in(make())
    assert all(word in text for word in words), text
    assert words or text == ""


def test_a_tracker_that_looks_with_either_face() -> None:
    text = groups_in(off(3e-4 * np.outer(np.random.default_rng(1).choice([-1.0, 1.0], 120), [0.6, -0.8, 0.0])))
    assert "the tracker, in its positions, had two positions" in text
    apart = re.search(r"([0-9.]+) mm apart", text)
    assert float(apart[1]) == pytest.approx(0.6, rel=0.1)  # the geometry takes up a part


def test_two_groups_far_apart_keep_their_distance() -> None:
    """A frozen model, of which nearly half of the readings stand 5 mm beside the others."""
    beside = off(5e-3 * np.outer(np.arange(120) % 9 < 4, [0.6, -0.8, 0.0]))
    judged = evaluate(frozen(), beside, np.random.default_rng(0)).judged
    apart = re.search(r"([0-9.]+) mm apart", " ".join(judged.open_because))
    assert float(apart[1]) == pytest.approx(5.0, rel=0.1)


def test_a_joint_that_was_mastered_again_is_not_two_trackers() -> None:
    """Stations on two sides of the arm, which its new zero moves apart."""
    rng = np.random.default_rng(3)
    q = np.array([0.0, -1.5, 0.3, -0.5, 1.4, 0.3]) + 0.15 * rng.standard_normal((120, 6))
    q[:, 0] += rng.choice([-1.5, 1.5], 120)
    q[:, 3:] += rng.uniform(-1.5, 1.5, (120, 3))
    T = MADE.world.tool_in_tracker(q + 4e-3 * (np.arange(6) == 1))
    T = noisy(T, NOISE_M, NOISE_RAD, rng)
    judged = evaluate(frozen(), samples_of(CHAIN, q, T), np.random.default_rng(0)).judged
    assert judged.status == "open"
    assert not any("two groups" in s for s in judged.open_because)
