"""What differs between a serial arm and a Delta stands in ``robots/mechanism.py``; few files ask which of the two it is."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from deltas import nominal

from modcal_core.robots import mechanism
from modcal_core.robots.urdf import read_chain

ROOT = Path(__file__).resolve().parents[2]
CORE = ROOT / "ros2_ws" / "src" / "modcal_core" / "modcal_core"
# What is written, drawn or named in one way for each kind of robot, and `is_serial_arm` itself.
ASK = {"robot.py", "report/report.py", "calibration/parameters.py", "calibration/store.py"}
ASK |= {"robots/mechanism.py"}


def robots() -> list[mechanism.Mechanism]:
    return [read_chain((ROOT / "examples" / "robots" / "ur10.urdf").read_text()), nominal(True)]


def asks(source: str) -> bool:
    """Whether a file asks if something is a Chain or a Delta."""
    calls = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.Call) and ast.unparse(n.func) == "isinstance"]
    return any({"Chain", "Delta"} & {n.id for n in ast.walk(c.args[1]) if isinstance(n, ast.Name)} for c in calls)


@pytest.mark.slow
def test_few_files_ask_what_kind_of_robot_it_is() -> None:
    assert asks("if not isinstance(a.b, Chain): pass")
    assert asks("isinstance(a, int | Delta)")
    assert not asks("isinstance(a, int)")
    assert {str(f.relative_to(CORE)) for f in CORE.rglob("*.py") if asks(f.read_text())} == ASK


@pytest.mark.parametrize("robot", robots(), ids=["chain", "delta"])
def test_limits_and_errors_change_what_they_name_only(robot: mechanism.Mechanism) -> None:
    narrow = robot.with_limits(np.full(robot.n, -0.1), np.full(robot.n, 0.2))
    assert (narrow.lower == -0.1).all()
    assert (narrow.upper == 0.2).all()
    assert narrow.digits() == robot.digits()
    q = mechanism.random_postures(narrow, 50, np.random.default_rng(0))
    assert q.shape == (50, robot.n)
    assert (np.abs(q - 0.05) <= 0.15).all()
    same = robot.with_errors(np.tile(np.eye(4), (robot.n, 1, 1)), np.zeros((robot.n, 6)))
    assert np.abs(mechanism.forward(same, q) - mechanism.forward(robot, q)).max() < 1e-12
    off = robot.with_errors(np.tile(np.eye(4), (robot.n, 1, 1)), np.full((robot.n, 6), 1e-3))
    assert (off.digits() != robot.digits()) == robot.closed  # a chain has no constants of its joints
