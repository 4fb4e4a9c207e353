"""What a frozen model leaves over is placed, noise is not; and recorded numbers that say what the arm carries."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cells import record, samples_of, ur10
from deltas import record_delta
from verdict.visits import visited

from modcal_core.calibration.store import Calibration
from modcal_core.effects.drivers import Drivers, NominalArm
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.families.compliance import candidates, carrying
from modcal_core.effects.shapes import Shape
from modcal_core.evaluation import evaluate
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.outcome.contents import Outcome
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.mechanism import offset_wrench, payload_wrench


@cache
def calibration() -> Calibration:
    return calibrate(visited(3, 100), ur10(), np.random.default_rng(0), look_for_effects=False).calibration


def scored(samples: Samples) -> Outcome:
    return evaluate(calibration(), samples, np.random.default_rng(0))


def moved(samples: Samples, step: Array) -> Samples:
    T = step @ se3.transform(samples.R, samples.reading)
    return replace(samples, R=T[:, :3, :3], reading=T[:, :3, 3])


@pytest.mark.slow
def test_a_joint_that_was_adjusted_is_named() -> None:
    second = visited(3, 60)
    q = second.q.copy()
    q[:, 2] += 5e-4
    report = scored(replace(second, q=q))
    assert report.status == "open"
    assert (report.left.effect.place, report.left.effect.public_driver) == ("elbow_joint", "constant")


@pytest.mark.slow
def test_a_base_that_moved_is_named() -> None:
    report = scored(moved(visited(3, 60), se3.exp(1e-2 * np.array([1.5, -1.0, 1.0, 0.5, 1.0, -1.0]))))
    assert report.status == "open"
    assert report.left.effect.place == "base"


def test_where_nothing_has_changed_nothing_is_named() -> None:
    report = scored(visited(3, 60))
    assert report.status != "open"
    assert report.left is None


@pytest.mark.slow
def test_geometry_alone_names_what_it_did_not_look_for() -> None:
    samples = visited(4, 120)
    q = samples.q.copy()
    q[:, 1] += 4e-4 * np.sin(3.0 * q[:, 1])
    report = calibrate(replace(samples, q=q), ur10(), np.random.default_rng(0), look_for_effects=False).report
    assert report.status == "open"
    assert report.left.effect.place == "shoulder_lift_joint"


@pytest.mark.slow
def test_a_delta_whose_drive_was_adjusted_is_open_for_a_constant_error() -> None:
    told = record_delta(1, 70)
    known = calibrate(told.samples, told.nominal, np.random.default_rng(0), look_for_effects=False).calibration
    q = told.samples.q.copy()
    q[:, 1] += 1e-3
    report = evaluate(known, replace(told.samples, q=q), np.random.default_rng(0))
    assert report.status == "open"
    assert report.left.effect.public_driver == "constant"


@pytest.mark.slow
def test_an_effect_that_has_grown_is_named_beside_base_and_tool_that_are_found_again() -> None:
    """The columns of what the calibration knows hide nothing, and base and tool explain nothing that they took up."""

    def worn(size: float, seed: int) -> Samples:
        samples = visited(seed, 100)
        off = samples.q.copy()
        off[:, 1] += size * np.sin(3.0 * off[:, 1])
        return replace(samples, q=off)

    known = calibrate(worn(4e-4, 4), ur10(), np.random.default_rng(0)).calibration
    assert any(effect.place == "shoulder_lift_joint" for effect in known.calibrated.effects)
    report = evaluate(known, worn(8e-4, 4), np.random.default_rng(0), refit_base=True, refit_tool=True)
    assert report.status == "open"
    assert report.left.effect.place == "shoulder_lift_joint"
    assert "as an error of joint shoulder_lift_joint" in " ".join(report.open_because)


ELBOW = 2
COMPLIANCE = 8e-6  # rad/(N m)


def loaded(topic: str, factor: float = 1.0) -> Samples:
    """The elbow deflects under a mass at the tip that changes from station to station."""
    made = record(5, 120)
    chain, q = ur10(), made.samples.q
    rng = np.random.default_rng(1)
    mass = rng.choice([0.0, 2.0, 5.0], len(q))
    step = np.zeros(6)
    step[ELBOW] = 1e-6
    rise = (chain_forward(chain, q + step)[:, 2, 3] - chain_forward(chain, q - step)[:, 2, 3]) / 2e-6
    actual = q - COMPLIANCE * mass[:, None] * 9.81 * rise[:, None] * (np.arange(6) == ELBOW)
    T = made.world.tool_in_tracker(actual)
    T[:, :3, 3] += 2e-5 * rng.standard_normal((len(q), 3))
    samples = samples_of(chain, q, T)
    return replace(samples, signals=(SignalTrack(f"signal:{topic}", samples.stamps, factor * mass[:, None], topic),))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("topic", "factor", "name", "expected"),
    [("/payload_kg", 1.0, "compliance", COMPLIANCE), ("/load_cell_n", 9.81, "compliance_per_unit", COMPLIANCE / 9.81)],
)
def test_a_payload_that_is_recorded_loads_the_joints(topic: str, factor: float, name: str, expected: float) -> None:
    report = calibrate(loaded(topic, factor), ur10(), np.random.default_rng(0)).report
    (effect,) = report.effects
    assert (effect.family, effect.place, effect.driver) == ("compliance", "elbow_joint", "load:elbow_joint")
    assert effect.parameters[name][0] == pytest.approx(expected, rel=0.01)  # lengths are off by half a millimetre
    assert report.size_mm("final").rms < 1.25 * 2e-2 * np.sqrt(3.0)
    assert not any("no masses" in sentence for sentence in report.story)


def test_a_number_that_says_no_unit_of_weight_is_no_payload() -> None:
    for topic in ("/tilt", "/sigma_mm", "/gripper/open"):
        drivers = Drivers(loaded(topic), NominalArm(ur10()))
        assert not any(f"signal:{topic}" in e.driver for e in candidates(drivers))
    assert any("signal:/payload_kg" in e.driver for e in candidates(Drivers(loaded("/payload_kg"), NominalArm(ur10()))))


def test_the_weight_of_a_mass_beside_the_tip_is_that_of_virtual_work() -> None:
    chain, rng = ur10(), np.random.default_rng(2)
    q, beside = rng.uniform(-2.0, 2.0, (20, 6)), np.array([0.03, -0.05, 0.12])

    def height(postures: np.ndarray) -> np.ndarray:
        T = chain_forward(chain, postures)
        return T[:, 2, 3] + T[:, 2, :3] @ beside

    torque = payload_wrench(chain, q)[:, 5] + np.einsum("d,djn->jn", beside, offset_wrench(chain, q)[:, :, 5])
    for j in range(6):
        step = 1e-6 * (np.arange(6) == j)
        rise = (height(q + step) - height(q - step)) / 2e-6
        assert np.abs(torque[j] + 9.80665 * rise).max() < 1e-7


def test_a_stated_payload_is_weighed_at_its_centre() -> None:
    chain, samples = ur10(), loaded("/payload_kg")
    beside = np.array([0.03, -0.05, 0.12])
    at_tip, at_centre = (Drivers(samples, NominalArm(chain, centre=c)) for c in (None, beside))
    more = np.einsum("d,djn->jn", beside, offset_wrench(chain, samples.q)[:, :, 5])
    assert np.abs(more).max() > 0.1
    for j, name in enumerate(chain.names):
        difference = at_centre.values(f"payload:{name}") - at_tip.values(f"payload:{name}")
        np.testing.assert_allclose(difference, more[j], atol=1e-12)


def test_joints_that_carry_have_one_compliance_each() -> None:
    signal, beside = "signal:/payload_kg", "offset_x:{0},offset_y:{0},offset_z:{0},"

    def spring(joint: str, kind: str, loads: str, values: list[float]) -> Effect:
        return Effect("compliance", joint, AXIS, loads.format(joint) + signal, Shape(kind)).started(np.array(values))

    both = "load:{0},payload:{0},"
    found = (
        spring("elbow_joint", "carried", both, [9e-6]),
        spring("elbow_joint", "products", beside, [1e-7, 2e-7, 6e-7]),
        spring("wrist_1_joint", "product", "payload:{0},", [3e-5]),
        spring("wrist_1_joint", "products", beside, [0.0, 0.0, 1e-6]),
    )
    assert carrying(found) == (found[0], spring("wrist_1_joint", "carried", both, [3e-5]))
