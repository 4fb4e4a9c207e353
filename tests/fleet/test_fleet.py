"""``modcal fleet``: the same as ``modcal calibrate`` of each; a bad recording or a killed worker costs a row."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from fleet.robots import write_fleet

from modcal_core.errors import BadRecording, BadTable
from modcal_nodes.cli import fleet
from modcal_nodes.cli.fleet import find_bags, names_of
from modcal_nodes.cli.main import run
from modcal_nodes.io.options import Options

GOOD = {"robot_1/week_0", "robot_1/week_1", "robot_2/week_0"}
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


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    import dask
    from distributed import LocalCluster

    # a recording that kills its worker is given up after the second, not the fourth: each takes seconds to start, and
    # one that is killed while it starts may never come back, so there are two
    with dask.config.set({"distributed.scheduler.allowed-failures": 1}), LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", host="127.0.0.1"
    ) as cluster:  # fmt: skip
        yield cluster.scheduler_address


def rows(path: Path) -> dict[str, fleet.Row]:
    return {row["name"]: row for row in pq.read_table(path).to_pylist()}


@pytest.mark.slow
def test_each_bag_has_what_calibrate_writes(recordings: Path, results: Path, tmp_path: Path) -> None:
    assert run(["calibrate", f"{recordings}/robot_1/week_1", "--geometry-only", "--out", str(tmp_path / "alone")]) == 0
    of_fleet = results / "robot_1" / "week_1"
    assert {p.name for p in of_fleet.iterdir()} == REPORT
    for name in REPORT:
        assert (of_fleet / name).read_bytes() == (tmp_path / "alone" / name).read_bytes(), name


@pytest.mark.slow
def test_the_table_says_what_the_reports_say(results: Path) -> None:
    table = rows(results / "fleet.parquet")
    assert set(table) == GOOD | {"robot_2/week_5"}
    for name in GOOD:
        row, report = table[name], json.loads((results / name / "report.json").read_text())
        assert row["state"] == "done"
        assert row["robot"] == "ur10"
        for same in ("stations", "rejected", "measurement", "duration_s"):
            assert row[same] == report["recording"][same]
        for stage in ("nominal", "geometric", "final"):
            for size in ("rms", "p95"):
                assert row[f"{stage}_{size}_mm"] == report["error_mm"][stage][size]
        assert row["floor_mm"] == report["noise_floor_mm"]
        assert row["status"] == report["status"]
        assert row["verdict"] == report["verdict"]
        assert row["started"].timestamp() == pytest.approx(1.7e9 + 604800.0 * int(name[-1]), abs=1e-3)


@pytest.mark.slow
def test_an_unusable_bag_is_refused_and_stops_nobody(
    recordings: Path, results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    row = rows(results / "fleet.parquet")["robot_2/week_5"]
    assert row["state"] == "refused"
    assert row["final_rms_mm"] is None
    bag = str(recordings / "robot_2" / "week_5")
    assert run(["calibrate", bag, "--geometry-only", "--out", str(recordings.parent / "never")]) == 2
    assert capsys.readouterr().err == f"modcal: {row['said']}\n"
    assert [p.name for p in (results / "robot_2" / "week_5").iterdir()] == [fleet.NOT_CALIBRATED]


@pytest.mark.slow
def test_a_cluster_gives_what_this_machine_does(
    address: str, recordings: Path, results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    command = ["fleet", f"{recordings}/robot_*", "--out", str(out), "--geometry-only", "--csv", "--dask", address]
    assert run([*command, "--json"]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("modcal: 1 of 4 recordings were not calibrated; robot_2/week_5 refused: ")
    for file in (file for name in GOOD for file in (results / name).iterdir()):
        assert (out / file.relative_to(results)).read_bytes() == file.read_bytes(), file
    here = rows(results / "fleet.parquet")
    with (out / "fleet.csv").open(newline="") as file:
        written = {row["name"]: row for row in csv.DictReader(file)}
    assert written.keys() == here.keys()
    printed = {row["name"]: row for row in json.loads(said.out)["recordings"]}
    for name in GOOD:
        assert float(written[name]["final_rms_mm"]) == here[name]["final_rms_mm"] == printed[name]["final_rms_mm"]
        assert written[name]["verdict"] == here[name]["verdict"] == printed[name]["verdict"]


@pytest.mark.slow
def test_a_second_call_replaces_what_the_first_wrote(
    recordings: Path, results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stale = results / "robot_1" / "week_0" / "stale"
    stale.touch()
    one = ["fleet", f"{recordings}/robot_1/week_0", "--out", str(results), "--geometry-only", "--csv", "--jobs", "1"]
    assert run(one) == 0
    assert not stale.exists()
    said = capsys.readouterr()
    assert "robot_1/week_0" in said.out
    assert f"Table: {results}/fleet.csv" in said.out
    assert said.err == ""


def _killed(bag: Path, options: Options) -> tuple[fleet.Row, dict[str, bytes]]:
    """Done at once; the bags "once" and "always" take the worker along, the first time or always."""
    first = not Path(f"{bag}.tried").exists()
    Path(f"{bag}.tried").touch()
    if bag.name == "always" or (bag.name == "once" and first):
        os.kill(os.getpid(), signal.SIGKILL)
    if bag.name == "fault":
        raise ZeroDivisionError("a fault of ours")
    return {"state": "done"}, {"report.json": b""}


@pytest.mark.slow
def test_a_killed_worker_costs_a_row_at_most(address: str, tmp_path: Path) -> None:
    import cloudpickle
    from distributed import Client

    cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers need not find this file
    bags = {name: tmp_path / name for name in ("a", "always", "once", "fault", "z")}
    heard: list[fleet.Row] = []
    with Client(address, set_as_default=False) as client:
        done = fleet.map_bags(_killed, bags, tmp_path / "out", Options(), client, heard.append)
    assert sorted(row["name"] for row in heard) == [row["name"] for row in done] == sorted(bags)
    states = {row["name"]: row["state"] for row in done}
    assert states.pop("always") == states.pop("fault") == "failed"
    assert set(states.values()) == {"done"}
    assert {row["name"]: row.get("said") for row in done}["fault"] == "ZeroDivisionError: a fault of ours"
    said = (tmp_path / "out" / "always" / fleet.NOT_CALIBRATED).read_text()
    assert "KilledWorker" in said or "no worker is left" in said  # where what restarts the last one gives up
    assert (tmp_path / "out" / "z" / "report.json").exists()
    fleet.write_table(tmp_path / "fleet.parquet", done)
    assert len(rows(tmp_path / "fleet.parquet")) == len(bags)


@pytest.mark.slow
def test_no_cluster_is_one_line(recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["fleet", str(recordings), "--out", str(tmp_path / "out"), "--dask", "nonsense://here"]
    assert run(command) == 2
    error = capsys.readouterr().err
    assert error.startswith("modcal: --dask nonsense://here: no scheduler answers (")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_nothing_else_is_written_over(recordings: Path) -> None:
    """Results in the folder of the recordings would stand where the bags do."""
    before = sorted(recordings.rglob("*"))
    assert run(["fleet", str(recordings), "--out", str(recordings)]) == 2
    assert sorted(recordings.rglob("*")) == before


@pytest.mark.slow
def test_the_program_of_the_page_runs(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (Path(__file__).resolve().parents[2] / "docs" / "fleet.md").read_text()
    monkeypatch.chdir(results.parent)
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(compile(program, "docs/fleet.md", "exec"), {})
    assert "robot_2/week_5 refused" in capsys.readouterr().out


@pytest.mark.slow
def test_every_column_is_documented() -> None:
    text = (Path(__file__).resolve().parents[2] / "docs" / "fleet.md").read_text()
    assert set(fleet.SCHEMA.names) <= set(re.findall(r"`(\w+)`", text))


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    top = tmp_path / "recordings"
    for file in ("r1/monday/metadata.yaml", "r1/monday/monday_0.mcap", "r1/cut/cut_0.mcap", "r1/cut/cut_1.mcap",
                 "r2/a.mcap", "r2/b.mcap", ".old/x/x_0.mcap", "out/r1/monday/report.json", "r3/a.mcap"):  # fmt: skip
        (top / file).parent.mkdir(parents=True, exist_ok=True)
        (top / file).touch()
    return top


def test_folders_are_searched(tree: Path) -> None:
    found = find_bags([str(tree)], tree / "out")
    assert [str(p.relative_to(tree)) for p in found] == [
        "r1/cut", "r1/monday", "r2/a.mcap", "r2/b.mcap", "r3/a.mcap",
    ]  # fmt: skip
    assert find_bags([str(tree / "r1"), str(tree / "r1/monday")], tree / "out") == found[:2]


def test_patterns_are_matched(tree: Path) -> None:
    found = find_bags([f"{tree}/r*/a.mcap"], tree / "out")
    assert [p.parent.name for p in found] == ["r2", "r3"]


@pytest.mark.parametrize("name", ["nowhere", "no*where", "r1/monday/metadata.yaml/*", "out"])
def test_what_is_not_there_is_refused(tree: Path, name: str) -> None:
    with pytest.raises(BadRecording, match="holds no bag" if name == "out" else "does not exist"):
        find_bags([str(tree / name)], tree / "elsewhere")


def test_names_are_told_apart_and_stay(tmp_path: Path) -> None:
    one, two, other = (tmp_path / p for p in ("x/r/a.mcap", "y/r/a.mcap", "y/r/b.mcap"))
    for file in (one, two, other):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    out = tmp_path / "out"
    assert names_of([one], out) == {"r/a": one}
    names = names_of([one, two, other], out)
    assert len(names) == 3
    assert names["r/b"] == other
    assert names_of([two, one], out).items() <= names.items()


def test_a_bag_is_never_written_over(tmp_path: Path) -> None:
    """Not even one in whose folder somebody has put a report."""
    bag = tmp_path / "r" / "a"
    bag.mkdir(parents=True)
    (bag / "report.json").touch()
    assert names_of([bag], tmp_path / "out") == {"r/a": bag}
    with pytest.raises(BadTable, match="holds something other than results"):
        names_of([bag], tmp_path)
