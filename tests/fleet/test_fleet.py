"""``modcal fleet``: the same as ``modcal calibrate`` of each, nothing twice, nothing lost, and drift where there is some."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from fleet.killing import killed_once
from fleet.robots import write_fleet

from modcal_nodes.cli.main import run
from modcal_nodes.fleet.pool import run_here
from modcal_nodes.fleet.run import plan
from modcal_nodes.fleet.run import run as run_fleet
from modcal_nodes.io.options import Options

pytestmark = pytest.mark.slow

Row = dict[str, Any]
GOOD = {"robot_1/week_0", "robot_1/week_1", "robot_1/week_3", "robot_2/week_0", "robot_2/week_2"}
REPORT = {"report.json", "report.html", "calibration.yaml", "calibrated.urdf", "kinematics.yaml"}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet") / "recordings"
    write_fleet(folder)
    return folder


@pytest.fixture(scope="module")
def results(recordings: Path) -> Path:
    """The first call, on two processes; one of the bags is of no use."""
    out = recordings.parent / "fleet"
    assert run(["fleet", str(recordings), "--out", str(out), "--geometry-only", "--jobs", "2"]) == 2
    return out


def rows(path: Path) -> dict[str, Row]:
    return {row["name"]: row for row in pq.read_table(path).to_pylist()}


def times(out: Path) -> dict[str, int]:
    return {p.parent.relative_to(out).as_posix(): p.stat().st_mtime_ns for p in out.glob("*/*/fleet.json")}


def test_each_bag_has_what_calibrate_writes(recordings: Path, results: Path, tmp_path: Path) -> None:
    assert run(["calibrate", f"{recordings}/robot_1/week_1", "--geometry-only", "--out", str(tmp_path / "alone")]) == 0
    of_fleet = results / "robot_1" / "week_1"
    assert {p.name for p in of_fleet.iterdir()} == REPORT | {"samples.npz", "fleet.json"}
    for name in REPORT:
        assert (of_fleet / name).read_bytes() == (tmp_path / "alone" / name).read_bytes(), name


def test_the_table_says_what_the_reports_say(results: Path) -> None:
    table = rows(results / "fleet.parquet")
    assert set(table) == GOOD | {"robot_2/week_5"}
    for name in GOOD:
        row, report = table[name], json.loads((results / name / "report.json").read_text())
        assert row["state"] == "done"
        assert row["robot"] == name.partition("/")[0]
        assert row["model"] == "ur10"
        assert row["stations"] == report["recording"]["stations"]
        for stage in ("nominal", "geometric", "final"):
            for size in ("rms", "p95"):
                assert row[f"{stage}_{size}_mm"] == report["error_mm"][stage][size]
        assert row["parameters"] == report["parameters"]
        assert row["verdict"] == report["verdict"]
        assert row["started"].timestamp() == pytest.approx(1.7e9 + 604800.0 * int(name[-1]), abs=1e-3)


def test_an_unusable_bag_is_refused_and_stops_nobody(
    recordings: Path, results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    row = rows(results / "fleet.parquet")["robot_2/week_5"]
    assert row["state"] == "refused"
    assert row["final_rms_mm"] is None
    bag = str(recordings / "robot_2" / "week_5")
    assert run(["calibrate", bag, "--geometry-only", "--out", str(recordings.parent / "never")]) == 2
    assert capsys.readouterr().err == f"modcal: {row['said']}\n"
    assert not (results / "robot_2" / "week_5" / "report.json").exists()


def test_a_base_that_rises_is_found_and_a_still_one_is_not(results: Path) -> None:
    drift = pq.read_table(results / "drift.parquet").to_pylist()
    named = [row for row in drift if row["named"]]
    assert [(row["robot"], row["parameter"], row["unit"]) for row in named] == [("robot_1", "base/z", "m")]
    (base,) = named
    assert base["per_week"] == pytest.approx(1e-4, abs=3.0 * base["per_week_std"])
    assert base["change"] == pytest.approx(3e-4, abs=3.0 * base["change_std"])
    assert base["per_week_std"] < 1e-5
    assert base["recordings"] == 3
    still = [row for row in drift if row["robot"] == "robot_2"]
    assert len(still) == 30
    assert np.sqrt(np.mean([(row["change"] / row["change_std"]) ** 2 for row in still])) < 1.8
    table = rows(results / "fleet.parquet")
    assert "base z +0.1" in table["robot_1/week_0"]["drift"]
    assert table["robot_2/week_2"]["drift"].startswith("still since 2023-11-14")
    # the first calibration misses by what the base has moved since, and by its own noise
    assert table["robot_1/week_0"]["frozen_rms_mm"] is None
    assert table["robot_1/week_3"]["frozen_rms_mm"] > 0.25
    assert table["robot_2/week_2"]["frozen_rms_mm"] < 0.15


def test_a_second_call_does_only_what_is_missing_or_changed(recordings: Path, results: Path, tmp_path: Path) -> None:
    bags, out = tmp_path / "recordings", tmp_path / "results"
    shutil.copytree(recordings, bags)  # keeps times, so that all of it is known
    shutil.copytree(results, out)
    before = times(out)
    again = ["fleet", str(bags), "--out", str(out), "--geometry-only", "--jobs", "1"]
    assert run(again) == 2
    assert times(out) == before
    assert rows(out / "fleet.parquet").keys() == before.keys()
    shutil.rmtree(out / "robot_1" / "week_3")
    bag = next((bags / "robot_2" / "week_5").glob("*.mcap"))
    os.utime(bag, (1.0, 1.0))
    assert run(again) == 2
    changed = {name for name, at in times(out).items() if at != before.get(name)}
    assert changed == {"robot_1/week_3", "robot_2/week_5"}
    assert len(plan([str(bags)], out, Options(geometry_only=True)).missing) == 0
    assert len(plan([str(bags)], out, Options(geometry_only=True), again=True).missing) == 6
    assert len(plan([str(bags)], out, Options(geometry_only=True, seed=1)).missing) == 6


def test_a_calibration_that_is_killed_is_done_again(recordings: Path, results: Path, tmp_path: Path) -> None:
    bag = tmp_path / "robot_1" / "week_1"
    shutil.copytree(recordings / "robot_1" / "week_1", bag)
    planned = plan([str(bag)], tmp_path / "out", Options(geometry_only=True))
    run_fleet(planned, partial(run_here, jobs=1, work=killed_once), "folder")
    assert Path(f"{bag}.tried").exists()
    assert rows(tmp_path / "out" / "fleet.parquet")["robot_1/week_1"]["state"] == "done"
    for name in REPORT:
        there, here = (folder / "robot_1" / "week_1" / name for folder in (results, tmp_path / "out"))
        assert there.read_bytes() == here.read_bytes()


def test_ctrl_c_keeps_what_is_finished(recordings: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "modcal_nodes.cli.main", "fleet", str(recordings), "--out", str(out)]
    command += ["--geometry-only", "--jobs", "1"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True)
    for _ in range(8000):
        if times(out) or process.poll() is not None:
            break
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=180)
    finished = set(times(out))
    assert finished
    assert finished < GOOD | {"robot_2/week_5"}, "it was interrupted too late for this test"
    assert (process.returncode, error.strip()) == (130, b"")  # click ends the line that shows ^C
    assert set(rows(out / "fleet.parquet")) == finished
    left = plan([str(recordings)], out, Options(geometry_only=True)).missing
    assert {task.name for task in left} == (GOOD | {"robot_2/week_5"}) - finished
    assert not list(out.glob("*/.*"))


def test_the_documents_example_runs(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (Path(__file__).resolve().parents[2] / "docs" / "fleet.md").read_text()
    monkeypatch.chdir(results.parent)
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(compile(program, "docs/fleet.md", "exec"), {})
    assert capsys.readouterr().out.startswith("robot_1 base/z: +0.1")


def test_every_column_is_documented(results: Path) -> None:
    text = (Path(__file__).resolve().parents[2] / "docs" / "fleet.md").read_text()
    named = set(re.findall(r"`(\w+)`", text)) | {f"geometric_{s}_mm" for s in ("rms", "p95")}
    named |= {f"final_{s}_mm" for s in ("rms", "p95")}
    assert set(pq.read_schema(results / "fleet.parquet").names) <= named


def test_json_is_quiet_otherwise(
    recordings: Path, results: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    assert run(["fleet", str(recordings), "--out", str(results), "--geometry-only", "--json"]) == 2
    said = capsys.readouterr()
    data = json.loads(said.out)
    assert data["states"] == {"done": 5, "refused": 1}
    assert data["kept"] == 6
    assert {row["name"] for row in data["recordings"]} == GOOD | {"robot_2/week_5"}
    assert said.err.startswith("modcal: 1 of 6 recordings were not calibrated; robot_2/week_5 refused: ")
    assert run(["fleet", f"{recordings}/robot_1", "--out", str(results), "--geometry-only"]) == 0
    said = capsys.readouterr()
    assert "base z" in said.out
    assert said.err == ""


def test_nothing_else_is_written_over(recordings: Path) -> None:
    """Results in the folder of the recordings would stand where the bags do."""
    before = sorted(recordings.rglob("*"))
    assert run(["fleet", str(recordings), "--out", str(recordings)]) == 2
    assert sorted(recordings.rglob("*")) == before
