"""Stations for a Delta, and which of its constants matter: as for an arm, of postures that its platform can take."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from deltas import FILE, nominal, postures
from finite_differences import assert_jacobian

from modcal_core.calibration.linearisation import model_at
from modcal_core.calibration.parameters import View
from modcal_core.calibration.structure import choose_parameters
from modcal_core.geometry import se3
from modcal_core.planning.closed_chain import calibration_chain, one_frame_model
from modcal_core.planning.designs import array_postures, sobol_postures
from modcal_core.planning.planner import PlanRequest, plan
from modcal_core.planning.site import Site
from modcal_core.robots.mechanism import takes
from modcal_nodes.cli.main import run


@pytest.mark.slow
def test_stations_that_its_platform_can_take() -> None:
    delta = nominal()
    found = plan(delta, Site(), PlanRequest(24, None, candidates=150, starts=1), np.random.default_rng(0))
    assert takes(delta, found.q).all()
    assert found.distinct == 24
    assert found.expected.left < found.expected.at_random


def test_designs_hold_postures_that_exist() -> None:
    delta = nominal()
    q = sobol_postures(delta, 64, np.random.default_rng(0))
    assert q.shape == (64, delta.n)
    assert takes(delta, q).all()
    assert takes(delta, array_postures(delta, 5)).all()


def test_the_closed_chain_moves_as_its_model() -> None:
    delta = nominal()
    tool = se3.transform(p=[0.05, 0.0, -0.1])
    closed, model = calibration_chain(delta, T_tip_tool=tool), one_frame_model(delta, T_tip_tool=tool)
    parameters = choose_parameters(model, (View("point", 0),)).parameters
    assert {"arm_1/zero", "arm_2/distal"} <= set(closed.names)
    q = postures(delta, 6)
    J = closed.jacobian(q)[:, :3]
    of_arm = np.array([name.startswith("arm_") for name in closed.names])

    def moved(x: np.ndarray) -> np.ndarray:
        errors = np.zeros(len(closed.names))
        errors[of_arm] = x
        return np.asarray(model_at(model, parameters, errors).predict(q, np.zeros(len(q), int))[:, :3, 3]).ravel()

    assert_jacobian(moved, J[:, :, of_arm].reshape(-1, int(of_arm.sum())), np.zeros(int(of_arm.sum())), tolerance=2e-6)
    errors = np.full(int(of_arm.sum()), 1e-4)
    exact = moved(errors) - moved(0.0 * errors)
    assert np.abs((J[:, :, of_arm] @ errors).ravel() - exact).max() < 1e-3 * np.abs(exact).max()


@pytest.mark.slow
def test_verbs_take_a_delta(tmp_path: Path) -> None:
    out = tmp_path / "plan"
    asked = ["plan", str(FILE), "--stations", "24", "--candidates", "120", "--starts", "1", "--out", str(out)]
    assert run(asked) == 0
    assert (out / "report.html").exists()
    out = tmp_path / "sensitivity"
    assert run(["sensitivity", str(FILE), "--design", "sobol", "--postures", "16", "--out", str(out)]) == 0
    data = json.loads((out / "sensitivity.json").read_text())
    assert data["joints"] == list(nominal().names)
