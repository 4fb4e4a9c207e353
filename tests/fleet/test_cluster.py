"""A fleet on a Dask cluster: a scheduler and a worker, each a process of its own on this machine."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from fleet.killing import quick
from fleet.robots import robot, visit

from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run
from modcal_nodes.fleet.cluster import run_on_cluster
from modcal_nodes.fleet.run import plan
from modcal_nodes.fleet.task import DONE, REFUSED, Task
from modcal_nodes.fleet.work import do
from modcal_nodes.io.options import Options

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    from distributed import LocalCluster  # a second and a half that only these tests need

    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:  # fmt: skip
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cluster")
    for week, count in ((0, 50), (1, 4)):
        write_recording(visit(robot(5), week, week, count), folder / "robot_5" / f"week_{week}")
    return folder


def test_a_cluster_gives_what_this_machine_does(address: str, recordings: Path, tmp_path: Path) -> None:
    command = ["fleet", f"{recordings}/robot_5", "--out", str(tmp_path / "out"), "--geometry-only", "--dask", address]
    assert run(command) == 2
    table = {row["name"]: row for row in pq.read_table(tmp_path / "out" / "fleet.parquet").to_pylist()}
    assert {name: row["state"] for name, row in table.items()} == {"robot_5/week_0": DONE, "robot_5/week_1": REFUSED}
    (task,) = plan([f"{recordings}/robot_5/week_0"], tmp_path / "other", Options(geometry_only=True)).tasks
    for name, content in do(task).files.items():
        assert (tmp_path / "out" / "robot_5" / "week_0" / name).read_bytes() == content, name


def test_a_worker_that_is_killed_loses_nothing(address: str, tmp_path: Path) -> None:
    """Its process is killed in the middle of a task, which the scheduler then gives to the next one."""
    tasks = [Task(name, tmp_path / name, Options()) for name in ("a", "once", "b")]
    states = {outcome.name: outcome.state for outcome in run_on_cluster(tasks, address, quick)}
    assert states == dict.fromkeys(("a", "once", "b"), DONE)
    assert (tmp_path / "once.tried").exists()


def test_no_cluster_is_one_line(recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["fleet", str(recordings), "--out", str(tmp_path / "out"), "--dask", "nonsense://here"]
    assert run(command) == 2
    error = capsys.readouterr().err
    assert error.startswith("modcal: --dask nonsense://here: no scheduler answers (")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()
