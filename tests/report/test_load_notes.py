"""What a report says of what pulls on an arm, where the stations show that something does, and not what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from cells import record, ur10

from modcal_core.calibration.model import Model
from modcal_core.diagnosis.loads import FoundPayload, Loads
from modcal_core.effects.drivers import NominalArm
from modcal_core.geometry import se3
from modcal_core.outcome.entries import load_findings
from modcal_core.outcome.notes import load_notes
from modcal_core.report.as_json import loads_to_json

ARM = NominalArm(ur10())


def test_that_gravity_cannot_be_told_is_said_with_what_would() -> None:
    unknown = Loads(ARM, ARM, unknown=True)
    (note,) = load_notes(unknown)
    assert "cannot tell gravity" in note
    assert note.endswith("State gravity: in the cell file.")
    said = loads_to_json(unknown)
    assert said is not None
    assert said["gravity_unknown"] is True
    assert said["gravity"] is None
    assert said["payloads"] == []


def test_a_way_that_was_found_is_told_and_no_doubt_of_it() -> None:
    down = np.array([0.6, 0.0, -0.8])
    found = Loads(ARM, ARM, down=down, down_std=0.01, turned=float(np.arccos(0.8)))
    (note,) = load_notes(found)
    assert "[+0.600, +0.000, -0.800]" in note
    assert "± 1.1°" in note
    assert "36.9° from where the robot description says" in note
    said = loads_to_json(found)
    assert said is not None
    assert said["gravity_unknown"] is False


def test_masses_in_units_of_another_are_no_kilograms() -> None:
    payloads = (FoundPayload(0.0, 0.4, 0.01), FoundPayload(10.0, 1.0, 0.0))
    relative = Loads(ARM, ARM, payloads=payloads, relative=True)
    (note,) = load_notes(relative)
    assert "0.40 ± 0.02 of what the tip carries in the last one" in note
    model = Model(ur10(), ("tracker",), np.eye(4)[None], se3.exp([0.05, 0, 0.1, 0, 0.3, 0]))
    assert load_findings(relative, model, record(11, 20).samples) == ()
    (note,) = load_notes(replace(relative, relative=False))
    assert "carries 0.40 ± 0.02 kg, 1.00 ± 0 kg in the recordings, one after the other" in note


def test_nothing_is_said_of_nothing() -> None:
    assert load_notes(None) == ()
    assert loads_to_json(None) is None
