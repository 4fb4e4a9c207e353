"""``modcal plan``: stations that a controller and the other verbs take, and one line where there are none."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import yaml
from planning.arms import IRB1410, irb1410
from planning.sites import HALL
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_nodes.cli.main import run

pytestmark = pytest.mark.slow


@pytest.fixture
def site_file(tmp_path: Path) -> Path:
    path = tmp_path / "site.yaml"
    path.write_text(yaml.safe_dump(HALL))
    return path


def test_stations_in_every_form(site_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    arguments = ["--stations", "24", "--candidates", "80", "--starts", "1", "--speed", "0.8", "--dwell", "1.5"]
    assert run(["plan", str(IRB1410), "--site", str(site_file), *arguments, "--out", str(out)]) == 0
    told = " ".join(capfd.readouterr().out.split())
    assert "24 stations. To be claimed of a usual arm: 95 % of the errors over the workspace are below" in told
    assert "6 of them are visited twice, from different sides: 30 stops in all" in told
    assert "drawn at random" in told
    written = {"plan.yaml", "stations.csv", "trajectory.yaml", "report.html"}
    assert {p.name for p in out.iterdir()} == written
    plan = yaml.safe_load((out / "plan.yaml").read_text())
    q = np.array([s["position"] for s in plan["stations"]])
    assert q.shape == (30, 6)  # six of them a second time
    assert len(np.unique(q, axis=0)) == 24
    assert len(plan["returns"]) == 6
    assert all(np.array_equal(q[first - 1], q[second - 1]) for first, second in plan["returns"])
    assert ((q > irb1410().lower) & (q < irb1410().upper)).all()
    assert 0.0 < plan["ratio_to_random"]["model_rms"] < 1.0
    assert 0.0 < plan["left_rms_mm"]["planned"] < plan["claim_mm"]["p95"]["ci95"][1]
    rows = list(csv.DictReader((out / "stations.csv").read_text().splitlines()))
    assert np.allclose([[float(row[j]) for j in plan["joints"]] for row in rows], q, atol=1e-8)
    check_trajectory(yaml.safe_load((out / "trajectory.yaml").read_text()), plan, q)


def check_trajectory(data: dict, plan: dict, q: np.ndarray) -> None:
    points = [JointTrajectoryPoint(positions=p["positions"], velocities=p["velocities"]) for p in data["points"]]
    message = JointTrajectory(joint_names=data["joint_names"], points=points)
    assert list(message.joint_names) == plan["joints"]
    at = np.array([p["positions"] for p in data["points"]])
    t = np.array([p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in data["points"]])
    assert t[0] == 0.0
    assert (np.diff(t) > 0.0).all()
    moved = np.abs(np.diff(at, axis=0)).max(axis=1)
    still = moved == 0.0
    assert np.allclose(np.diff(t)[still], 1.5)
    assert (1.5 * moved[~still] / np.diff(t)[~still] <= 0.8 + 1e-6).all()  # a cubic's peak
    visited = at[:-1][still]
    assert np.array_equal(visited, q[: len(visited)])
    if not plan["blocked_ways"]:
        assert len(visited) == 30


def test_the_plan_is_taken_by_sensitivity(site_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Stations that hold the wrist still are planned for an arm whose wrist is not asked about, and it is said."""
    data = {**HALL, "limits": {f"joint_{k}": [0.3, 0.300001] for k in (4, 5, 6)}}
    site_file.write_text(yaml.safe_dump(data))
    arguments = ["--stations", "24", "--candidates", "40", "--starts", "1", "--out", str(tmp_path / "out")]
    assert run(["plan", str(IRB1410), "--site", str(site_file), *arguments]) == 0
    plan = tmp_path / "out" / "plan.yaml"
    assert run(["sensitivity", str(IRB1410), "--measured", str(plan), "--out", str(tmp_path / "s")]) == 0
    told = " ".join(capfd.readouterr().out.split())
    assert "point/x matters" in told
    assert "these stations do not observe it" in told


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "is given neither a ROBOT nor --decide REPORT"),
        ([str(IRB1410), "--stations", "30", "--accuracy-mm", "0.1"], "cannot be combined with --accuracy-mm"),
        ([str(IRB1410), "--accuracy-mm", "0.001", "--candidates", "40"], "what the joints do not repeat alone makes"),
        ([str(IRB1410), "--decide", str(IRB1410)], "cannot be combined with ROBOT"),
    ],
)
def test_what_cannot_be(arguments: list[str], words: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert run(["plan", *arguments, "--out", str(out)]) == 2
    told = capfd.readouterr().err
    assert told.count("\n") == 1
    assert words in told
    assert not out.exists()
