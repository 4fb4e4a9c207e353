"""What no arm has is named, and not used."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10

from modcal_core.calibration.model import place_model
from modcal_core.geometry import se3
from modcal_core.loop import calibrate
from modcal_core.robots.urdf_inertias import Inertias
from modcal_core.verdict.contradicted import long_tool, sane_inertias

CHAIN = ur10()
SANE = Inertias(np.full(6, 3.0), np.tile([0.1, 0.0, 0.1], (6, 1)), np.zeros((6, 3, 3)))


@pytest.mark.parametrize(
    ("mass", "com", "said"),
    [
        (3.0, [500.0, 0.0, 0.0], "centre of mass 500 m away"),
        (1e6, [0.1, 0.0, 0.0], "a mass of 1e\\+06 kg"),
        (-1.0, [0.1, 0.0, 0.0], "a mass of -1 kg"),
        (np.nan, [0.1, 0.0, 0.0], "a mass of nan kg"),
    ],
)
def test_absurd_masses_are_named_and_not_used(mass: float, com: list[float], said: str) -> None:
    masses, centres = SANE.mass.copy(), SANE.com.copy()
    masses[2], centres[2] = mass, com
    used, sentences = sane_inertias(replace(SANE, mass=masses, com=centres), CHAIN)
    assert used is None
    (sentence,) = sentences
    assert re.search(f"behind elbow_joint .*{said}", sentence), sentence


def test_sane_ones_are_used() -> None:
    assert sane_inertias(SANE, CHAIN) == (SANE, ())
    assert sane_inertias(None, CHAIN) == (None, ())


@pytest.mark.slow
def test_a_calibration_says_so() -> None:
    centres = SANE.com.copy()
    centres[1] = [0.0, 500.0, 0.0]
    result = calibrate(
        record(1, 80).samples, CHAIN, np.random.default_rng(0),
        inertias=replace(SANE, com=centres), look_for_effects=False,
    )  # fmt: skip
    assert any("centre of mass 500 m" in said for said in result.report.grounds.contradictions)
    assert result.calibration.calibrated.arm is not None
    assert not result.calibration.calibrated.arm.weighed


def test_a_tool_longer_than_the_arm_is_named() -> None:
    model = place_model(CHAIN, ("tracker",))
    assert long_tool(model) == ()
    (said,) = long_tool(replace(model, T_tip_tool=se3.transform(p=[0.0, 3.0, 0.0])))
    assert "3.00 m from tool0" in said
