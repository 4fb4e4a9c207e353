"""With instruments that give no positions a clean arm comes out clean, and what a joint does is still traced to it.

The truth is MuJoCo's; joints do not repeat exactly, so that what is left is not white for any instrument.
"""

from __future__ import annotations

import numpy as np
import pytest
from cells import ur10
from instruments import worlds
from instruments.test_recovery import CELLS

from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.outcome.contents import Outcome
from modcal_core.report.as_json import to_json_data

REPEATABILITY = 2e-5  # rad
COUNT = 120
ELBOW = "elbow_joint"


def gear(q: Array) -> Array:
    """The elbow's gear, 0.3 mrad, 101 times a turn."""
    out = np.zeros_like(q)
    out[:, 2] = 3e-4 * np.sin(101.0 * q[:, 2] + 0.4)
    return out


def report_of(name: str, seed: int, planted: bool) -> Outcome:
    devices, cell = CELLS[name]
    rng = np.random.default_rng(seed)
    w = worlds.world(seed)
    q = worlds.postures(ur10(), COUNT, rng)
    poses = w.tool_in_base(q + planted * gear(q) + REPEATABILITY * rng.standard_normal(q.shape))
    samples: Samples = worlds.together(
        [worlds.samples_of(ur10(), q, poses, d.frame, d.kind, d.read, d.noise, rng) for d in devices]
    )
    return calibrate(samples, ur10(), np.random.default_rng(0), cell).report


@pytest.mark.slow
@pytest.mark.parametrize("name", ["three wires", "tracker, wire of its own hook, theodolite"])
def test_a_clean_recording_comes_out_clean(name: str) -> None:
    report = report_of(name, 3, planted=False)
    assert report.effects == ()
    assert report.left is None
    nominal, final = report.size_mm("nominal"), report.size_mm("final")
    assert nominal is not None
    assert final is not None
    assert final.rms < 0.2 * nominal.rms


@pytest.mark.slow
@pytest.mark.parametrize("name", ["three wires", "two theodolites"])
def test_a_planted_gear_is_found(name: str) -> None:
    report = report_of(name, 3, planted=True)
    assert [(f.family, f.place, f.driver) for f in report.effects] == [("gear_harmonic", ELBOW, f"position:{ELBOW}")]
    found = report.effects[0].parameters
    for name_of, planted in (("amplitude", 3e-4), ("cycles_per_turn", 101.0)):
        value, std, _ = found[name_of]
        assert abs(value - planted) < 4.0 * std
    assert report.left is None


@pytest.mark.slow
def test_bearings_come_out_clean_and_the_report_says_what_they_cannot_see() -> None:
    report = report_of("two theodolites", 3, planted=False)
    assert report.effects == ()
    data = to_json_data(report)
    said = " ".join(data["notes"])
    assert data["claim_mm"]["open"] == "the scale"
    assert "One known distance shows it" in data["claim_mm"]["remedy"]
    assert "scatter about the model by" in said
    assert data["recording"]["measurement"] == "bearing"
    assert data["identifiability"]["rank"] == data["identifiability"]["parameters"] - 1
    assert data["noise_floor_mm"] is None
