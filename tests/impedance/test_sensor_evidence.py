"""When a force sensor may be believed: what it told while the tool went on, and whether the servos agree.

The leads here are e = l v + F / k with noise; of what judges them they know nothing.
"""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.impedance.tool_force import SensorEvidence
from modcal_core.impedance.unfelt_force import ServoModel

LEAST, TRUE = np.full(3, 2000.0), np.full(3, 4000.0)  # N m/rad
LEVERS = np.array([0.5, 0.3, 0.1])  # m
USUAL, EXPLORING, CREEP = 0.06, 0.03, 0.01  # m/s


def learned(share: float, rng: np.random.Generator, moments: int = 40) -> tuple[float, float] | None:
    """What a sensor that tells a share of the force makes servos seem to yield, of what they may."""
    model = ServoModel(np.full(3, 1e-3), 0.03)
    for _ in range(moments):
        load, speed = rng.uniform(2.0, 10.0) * LEVERS, rng.uniform(0.0, 0.1, 3)
        lead = 0.025 * speed + load / TRUE + rng.normal(0.0, 2e-5, 3)
        model.learn(np.stack([speed, share * load + rng.normal(0.0, 0.02, 3), np.ones(3), lead], axis=1))
    model.solve()
    return model.softness(LEVERS, LEAST)


def going_on(evidence: SensorEvidence, force: float, way: float, since: float = 0.0) -> None:
    for at in np.linspace(since, since + way, 20):
        evidence.take(force, float(at), False)


def test_what_is_felt_while_the_tool_stands_tells_nothing() -> None:
    """In a jam any sensor tells something in the end, and fingers yield by some millimetres."""
    jam, free = SensorEvidence(known=False), SensorEvidence(known=False)
    going_on(jam, 12.0, 2.5e-3)
    going_on(free, 12.0, 4e-3)
    assert not jam.told
    assert free.told
    assert jam.exploring(0.1, EXPLORING, CREEP) < free.exploring(0.1, EXPLORING, CREEP) == EXPLORING


def test_a_sensor_that_repeats_itself_has_told_nothing() -> None:
    evidence = SensorEvidence(known=False)
    going_on(evidence, 12.0, 4e-3)
    evidence.take(12.0, 0.01, True)
    assert not evidence.told


def test_a_sensor_that_tells_all_is_corroborated_by_servos_that_are_stiffer_than_the_softest(
    rng: np.random.Generator,
) -> None:
    evidence = SensorEvidence(known=True)
    going_on(evidence, 5.0, 4e-3)
    assert not evidence.corroborated
    evidence.learned(learned(1.0, rng))
    assert evidence.corroborated
    assert evidence.refused() is None
    assert evidence.following(USUAL, EXPLORING, CREEP) == USUAL


@pytest.mark.parametrize("share", [0.1, 0.2, 0.35])
def test_a_sensor_that_tells_a_part_makes_servos_softer_than_they_may_be(
    share: float, rng: np.random.Generator
) -> None:
    evidence = SensorEvidence(known=True)
    going_on(evidence, 5.0, 4e-3)
    softness = learned(share, rng)
    evidence.learned(softness)
    assert softness is not None
    assert softness[0] == pytest.approx(LEAST[0] / TRUE[0] / share, rel=0.15)
    assert not evidence.corroborated
    assert evidence.following(USUAL, EXPLORING, CREEP) == EXPLORING
    assert "max_joint_lead_rad" in str(evidence.refused())


def test_few_moments_neither_corroborate_nor_refuse(rng: np.random.Generator) -> None:
    evidence = SensorEvidence(known=True)
    going_on(evidence, 5.0, 4e-3)
    evidence.learned(learned(0.2, rng, moments=3))
    assert not evidence.corroborated
    assert evidence.refused() is None


def test_where_joints_cannot_be_judged_a_sensor_that_has_told_is_enough() -> None:
    evidence = SensorEvidence(known=False)
    assert evidence.following(USUAL, EXPLORING, CREEP) == EXPLORING
    going_on(evidence, 5.0, 4e-3)
    assert evidence.following(USUAL, EXPLORING, CREEP) == USUAL


def test_an_arm_that_is_stiffer_than_usual_is_led_slower_until_then() -> None:
    assert SensorEvidence(known=True).following(USUAL, EXPLORING, 0.5 * CREEP) == 0.5 * EXPLORING
