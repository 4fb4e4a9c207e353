"""Stations for a Delta, and which of its constants matter: as for an arm, of postures that its platform can take."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from deltas import FILE, nominal

from modcal_core.planning.planner import PlanRequest, plan
from modcal_core.planning.sensitivity_study import array_postures, sobol_postures
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
