"""What readers without effects are given: the geometry that is best alone, not the one that fits only beside effects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from cells import samples_of

from modcal_core.calibration.cell import Cell, fit_cell, free_cell
from modcal_core.calibration.final_fit import finalise
from modcal_core.calibration.fit import identify
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.evaluation import evaluate
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.report.report import calibration_files
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import joint_origins, read_chain

URDF = (Path(__file__).resolve().parents[2] / "examples" / "robots" / "ur10.urdf").read_text(encoding="utf-8")
ELBOW = 2


def recorded(rng: np.random.Generator, count: int) -> Samples:
    """Exact poses; the elbow is off by something that is half a joint zero and half a curve."""
    chain = read_chain(URDF, tip="tool0")
    q = rng.uniform(-1.5, 1.5, (count, 6))
    bent = q.copy()
    bent[:, ELBOW] += 2e-3 * np.cos(0.5 * q[:, ELBOW])
    base, tool = se3.exp([1.0, 2.0, 0.3, 0.2, -0.4, 1.0]), se3.exp([0.05, 0.03, 0.12, 0.2, 0.0, 0.3])
    return samples_of(chain, q, base @ chain_forward(chain, bent) @ tool)


def test_robot_description_and_kinematics_hold_the_geometry_that_is_best_alone(rng: np.random.Generator) -> None:
    chain, samples = read_chain(URDF, tip="tool0"), recorded(rng, 120)
    nominal = fit_cell(chain, samples, Cell())
    choice = choose_parameters(nominal.model, views_of(samples))
    choice = replace(choice, parameters=free_cell(choice.parameters, Cell()))
    curve = Effect("gear_harmonic", "elbow_joint", AXIS, "position:elbow_joint", Shape("sine", {"cycles": 0.5}))
    start = nominal.model.with_effects((curve.started(np.zeros(2)),))
    made = finalise(samples, chain, choice, Cell(), None, identify(start, samples, choice.parameters))
    others = recorded(rng, 60)

    def missed(T: Array) -> float:
        return float(np.sqrt(np.mean(np.sum((T[:, :3, 3] - others.reading) ** 2, axis=1))))

    beside = made.calibrated.with_effects(())
    assert missed(made.geometric.predict(others.q)) < 0.5 * missed(beside.predict(others.q))
    files = calibration_files(made, evaluate(made, others, rng), chain, URDF, page=False)
    corrected = read_chain(files["calibrated.urdf"], tip="tool0")
    model = replace(made.geometric, chain=corrected)
    assert missed(model.predict(others.q)) == pytest.approx(missed(made.geometric.predict(others.q)), rel=1e-6)
    kinematics = yaml.safe_load(files["kinematics.yaml"])["kinematics"]
    origin = joint_origins(files["calibrated.urdf"])["elbow_joint"]
    assert [kinematics["forearm"][axis] for axis in "xyz"] == pytest.approx(origin[:3, 3], abs=1e-12)
