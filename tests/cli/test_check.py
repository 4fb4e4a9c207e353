"""``modcal check``: its files, exit codes and refusals, by bags and by a folder of calibrate."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from cells import NOISE_M, record
from cli.conftest import Refused
from cli.recordings import START, recorded, with_joints

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

pytestmark = pytest.mark.slow
BUMP = se3.exp([4e-4, -3e-4, 3e-4, 0.0, 0.0, 0.0])


def later(folder: Path, change: Array, count: int = 10, twist: float = 0.0, scale: float = 1.0) -> Path:
    """A bag of a few stations of the cell of seed 1, a day later. twist: of the fourth joint, another at every one."""
    world = record(1, 1).world
    rng = np.random.default_rng(8)
    q = rng.uniform(-2.5, 2.5, (count, 6))
    T = world.tool_in_tracker(q + np.outer(twist * rng.standard_normal(count), np.eye(6)[3])) @ change
    T[:, :3, 3] = scale * (T[:, :3, 3] + NOISE_M * rng.standard_normal((count, 3)))
    t = START + 86400.0 + 2.0 * np.arange(count)
    write_recording(recorded(t, q, t, se3.to_pose(T)), folder)
    return folder


def test_a_bumped_tool_is_named_repaired_and_certified(folder: Path, tmp_path: Path) -> None:
    bag, out = later(tmp_path / "bag", BUMP), tmp_path / "out"
    options = ["--tolerance-mm", "1", "--certificate", "--serial", "SN-1"]
    assert run(["check", str(folder / "a"), str(bag), *options, "--out", str(out)]) == 0
    data = json.loads((out / "check.json").read_text())
    assert [c["kind"] for c in data["changes"]] == ["tool"]
    assert data["changes"][0]["moved_mm"]["rms"] == pytest.approx(0.583, rel=0.1)
    assert data["action"] == "use_repaired"
    assert data["tolerance"]["result"] == "PASS"
    assert data["date"].startswith("20")
    assert {
        "check.html",
        "report.json",
        "calibration.yaml",
        "calibrated.urdf",
        "kinematics.yaml",
    } <= {p.name for p in out.iterdir()}
    page = (out / "check.html").read_text()
    assert "The tool or the target has moved" in page
    assert "<title>a, checked by bag</title>" in page
    # a tool that moved leaves the arm as it was
    chains = [read_chain((one / "calibrated.urdf").read_text(), None, "tool0") for one in (folder / "a", out)]
    assert np.abs(chains[0].origins - chains[1].origins).max() < 1e-12
    # the repaired folder can be checked like any other
    assert run(["check", str(out), str(bag), "--out", str(tmp_path / "again"), "--tolerance-mm", "0.001"]) == 3
    assert json.loads((tmp_path / "again" / "check.json").read_text())["status"] == "unchanged"


def test_nothing_changed_writes_no_model(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = later(tmp_path / "bag", np.eye(4))
    assert run(["check", str(folder / "a" / "calibration.yaml"), str(bag), "--out", str(tmp_path / "out")]) == 0
    assert "Nothing has changed, by 10 stations." in capsys.readouterr().out
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"check.html", "check.json", "report.html", "report.json"}


def test_stations_to_add_are_a_table(folder: Path, tmp_path: Path) -> None:
    bag = later(tmp_path / "bag", np.eye(4), twist=1.5e-3)
    assert run(["check", str(folder / "a"), str(bag), "--out", str(tmp_path / "out")]) == 0
    data = json.loads((tmp_path / "out" / "check.json").read_text())
    assert [(c["kind"], c["place"]) for c in data["changes"]] == [("gear", "wrist_1_joint")]
    rows = list(csv.reader((tmp_path / "out" / "stations.csv").read_text().splitlines()))
    assert tuple(rows[0]) == tuple(data["stations_to_add"][0])
    assert len(rows) == len(data["stations_to_add"]) + 1
    assert not (tmp_path / "out" / "calibration.yaml").exists()


def test_another_unit_is_refused(folder: Path, tmp_path: Path, refused: Refused) -> None:
    bag = later(tmp_path / "bag", np.eye(4), scale=1e-3)
    refused(["check", str(folder / "a"), str(bag), "--out", str(tmp_path / "out")], "millimetres")


def test_a_recording_of_another_robot_is_refused_by_its_joints(folder: Path, tmp_path: Path, refused: Refused) -> None:
    other = recorded(START + np.arange(10.0), np.zeros((10, 6)), START + np.arange(10.0), np.zeros((10, 7)))
    renamed = with_joints(other, names=tuple(f"panda_joint{k}" for k in range(1, 7)))
    write_recording(renamed, tmp_path / "bag")
    for verb in ("check", "evaluate"):
        said = r"joint shoulder_pan_joint, .* of the calibration: not among the joint states \(panda_joint1"
        line = refused([verb, str(folder / "a"), str(tmp_path / "bag"), "--out", str(tmp_path / "out")], said)
        assert "give a recording of the arm that was calibrated (base_link → tool0)" in line
        assert "--base" not in line
