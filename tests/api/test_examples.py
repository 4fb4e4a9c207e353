"""The numbered examples run as they stand, need the public names only, and find what they planted."""

from __future__ import annotations

import ast
import json
import os
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import modcal

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9][0-9]_*.py"))
TOUR = ROOT / "examples" / "tour.ipynb"
ALLOWED = {"modcal", "numpy", "scipy"} | set(sys.stdlib_module_names)


def rms(result: modcal.Result, stage: str = "final") -> float:
    size = result.report.size_mm(stage)
    assert size is not None
    return size.rms


def arrays(ran: dict[str, Any], folder: Path) -> None:
    assert np.sqrt(np.mean(ran["missed"] ** 2)) < 1e-4
    assert rms(ran["result"], "nominal") > 1.0
    assert (folder / "out" / "calibrated.urdf").is_file()


def bag(ran: dict[str, Any], folder: Path) -> None:
    assert ran["result"].report.status == "at_floor"
    assert ran["result"].report.tolerance.result == "PASS"
    assert (folder / "out" / "report.json").is_file()


def evaluate(ran: dict[str, Any], folder: Path) -> None:
    # the tool is 5 cm longer than the frozen one; noise alone is 0.09 mm
    assert ran["as_it_was"].size_mm("final").rms == pytest.approx(50.0, abs=1.0)
    assert ran["refitted"].size_mm("final").rms < 0.15


def effects(ran: dict[str, Any], folder: Path) -> None:
    (found,) = ran["report"].effects
    assert (found.family, found.place) == ("gear_harmonic", "elbow_joint")
    cycles, std, _ = found.parameters["cycles_per_turn"]
    assert abs(cycles - ran["TEETH"]) < 4.0 * std + 1e-3
    amplitude, std, _ = found.parameters["amplitude"]
    assert abs(amplitude - ran["AMPLITUDE"]) < 4.0 * std


def door(ran: dict[str, Any], folder: Path) -> None:
    assert ran["choice"].kind == "revolute"
    assert ran["model"].radius == pytest.approx(ran["RADIUS"], rel=0.02)
    assert abs(ran["model"].axis[2]) > 0.999


def plan(ran: dict[str, Any], folder: Path) -> None:
    assert ran["left"] < ran["at_random"]
    assert np.loadtxt(folder / "stations.csv", delimiter=",").shape == ran["plan"].q.shape


def modules(ran: dict[str, Any], folder: Path) -> None:
    assert np.sqrt(np.mean(np.sum(ran["missed"] ** 2, axis=1))) < 5e-5
    assert rms(ran["result"], "nominal") > 0.3


def delta(ran: dict[str, Any], folder: Path) -> None:
    assert rms(ran["result"]) < 0.06
    assert rms(ran["result"], "nominal") > 0.3


FOUND: dict[str, Callable[[dict[str, Any], Path], None]] = {
    "01_arrays": arrays, "02_bag": bag, "03_evaluate": evaluate, "04_effects": effects, "05_door": door,
    "06_plan": plan, "07_modules": modules, "08_delta": delta,
}  # fmt: skip


def test_there_is_a_check_for_each() -> None:
    assert [path.stem for path in EXAMPLES] == list(FOUND)


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_finds_what_it_planted(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    ran = runpy.run_path(str(path))
    assert capsys.readouterr().out.strip()
    FOUND[path.stem](ran, tmp_path)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_needs_public_names_only(path: Path) -> None:
    source = path.read_text()
    assert len(source.splitlines()) <= 60
    assert ast.get_docstring(ast.parse(source))
    modules = [
        module
        for node in ast.walk(ast.parse(source))
        for module in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    ]
    assert "modcal" in modules
    assert {module.partition(".")[0] for module in modules} <= ALLOWED
    assert not [module for module in modules if module.startswith("modcal.")]


@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = json.loads(TOUR.read_text())
    assert data["nbformat"] == 4
    cells = [cell for cell in data["cells"] if cell["cell_type"] == "code"]
    assert len(cells) > 4
    assert not [cell for cell in cells if cell["outputs"] or cell["execution_count"] is not None]
    monkeypatch.chdir(ROOT / "examples")
    scope: dict[str, Any] = {"__name__": "__main__", "OUT": tmp_path}
    for i, cell in enumerate(cells):
        exec(compile("".join(cell["source"]), f"{TOUR.name}, cell {i}", "exec"), scope)
    assert scope["result"].report.effects
    assert os.listdir(tmp_path)
