"""``modcal plan`` and ``modcal sensitivity``: stations and tables that others take, and one line where there are none."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from cells import ur10
from planning.arms import IRB1410, irb1410
from planning.sites import HALL
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.geometry import se3
from modcal_core.robots.tables import to_cpc
from modcal_nodes.cli.main import run

pytestmark = pytest.mark.slow


@pytest.fixture
def site_file(tmp_path: Path) -> Path:
    path = tmp_path / "site.yaml"
    path.write_text(yaml.safe_dump(HALL))
    return path


def test_stations_in_every_form(site_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    arguments = ["--stations", "24", "--candidates", "80", "--speed", "0.8", "--dwell", "1.5"]
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
    arguments = ["--stations", "24", "--candidates", "40", "--out", str(tmp_path / "out")]
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


ROBOTS = IRB1410.parent


def test_tables_and_pictures_of_the_irb_1410(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    stations = tmp_path / "stations.csv"
    rng = np.random.default_rng(0)
    names = [f"joint_{k}" for k in (3, 2, 1, 4, 5, 6)]
    q = np.c_[rng.uniform(-1, 1, (30, 3)), np.tile([0.2, 0.4, -0.3], (30, 1))]
    stations.write_text(",".join(names) + "\n" + "\n".join(",".join(map(str, row)) for row in q) + "\n")
    out = tmp_path / "out"
    assert run(["sensitivity", str(IRB1410), "--measured", str(stations), "--out", str(out)]) == 0
    told = " ".join(capfd.readouterr().out.split())
    assert "All 18 translation parameters move the point by their own error, at every pose." in told
    assert "joint_5/d matters" in told
    assert "these stations do not observe it" in told
    assert {p.name for p in out.iterdir()} == {
        "sensitivity.json", "single_point.csv", "report.html",
    }  # fmt: skip
    data = json.loads((out / "sensitivity.json").read_text())
    assert data["postures"] == 25
    rows = {row["name"]: row for row in data["parameters"]}
    assert len(rows) == 33
    assert sum(row["share"] for row in rows.values()) == pytest.approx(1.0)
    assert rows["joint_2/a"]["rsfcdpe"] == pytest.approx(1.0)
    assert not rows["joint_2/theta"]["same_everywhere"]
    assert rows["joint_5/d"]["measured"]["matters_and_is_not_seen"]
    single = list(csv.DictReader((out / "single_point.csv").read_text().splitlines()))
    assert len(single) == 25
    assert float(single[3]["base/y"]) == pytest.approx(0.5)
    page = (out / "report.html").read_text()
    assert all(f'<th scope="row">{name}</th>' in page for name in rows)


@pytest.mark.parametrize(
    ("only", "base"),
    [("*/theta", "joint_1/theta"), ("*/alpha", "joint_1/alpha"), ("base/r?", "base/rx")],
    ids=["figure 4", "figure 5", "figure 6"],
)
def test_some_parameters_alone_are_as_among_all(
    only: str, base: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Of the published figures, each of one kind beside its first; these angles differ from pose to pose."""
    told = []
    for more in ([], ["--only", only]):
        assert (
            run(["sensitivity", str(IRB1410), "--base-factor", base, *more, "--json", "--out", str(tmp_path / "out")])
            == 0
        )
        told.append({row["name"]: row["rsfcdpe"] for row in json.loads(capfd.readouterr().out)["parameters"]})
    every, some = told
    assert len(some) == (3 if base == "base/rx" else 6)
    assert some == pytest.approx({name: every[name] for name in some})
    assert some[base] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["irb1410.yaml", "--levels", "4"], "the number is not a prime"),
        (["irb1410.yaml", "--base-factor", "joint_9/a"], "is not one of the chain's"),
        (["irb1410.yaml", "--only", "elbow/*"], "pattern 'elbow/*': matches no parameter"),
    ],
)
def test_what_no_sensitivity_can_be_of(
    arguments: list[str], words: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(["sensitivity", str(ROBOTS / arguments[0]), *arguments[1:], "--out", str(out)]) == 2
    told = capfd.readouterr().err
    assert told.count("\n") == 1
    assert words in told
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("stations.csv", "joint_1,joint_2\n0,1\n", "joint joint_3: is not named once"),
        ("stations.csv", "joint_1,joint_2,joint_3,joint_4,joint_5,joint_6\n0,1,2,3,4,x\n", "row 2: needs 6 finite numbers"),
        ("plan.yaml", "stations: []\n", "'modcal_plan' is not stated: give the plan.yaml that modcal plan wrote"),
    ],
)  # fmt: skip
def test_stations_that_cannot_be_read(
    name: str, text: str, words: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text(text)
    assert run(["sensitivity", str(IRB1410), "--measured", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 2
    assert re.search(words, capfd.readouterr().err)


def test_axes_that_dh_cannot_hold(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A calibrated arm: axes that were drawn parallel are so no more. The other parameters hold it."""
    scale = np.array([5e-4] * 3 + [1e-3] * 3)
    moved = ur10().origins @ se3.exp(scale * np.random.default_rng(0).standard_normal((7, 6)))
    file = tmp_path / "arm.yaml"
    file.write_text(yaml.safe_dump(to_cpc(ur10().with_origins(moved))))
    assert run(["sensitivity", str(file), "--out", str(tmp_path / "out")]) == 2
    assert "give --parameters calibration" in capfd.readouterr().err
    arguments = ["--parameters", "calibration", "--out", str(tmp_path / "out")]
    assert run(["sensitivity", str(file), *arguments]) == 0
    assert len(json.loads((tmp_path / "out" / "sensitivity.json").read_text())["parameters"]) == 27
