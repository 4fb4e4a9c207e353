"""Processes that are killed take nothing along but their own task, which is tried once more."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from fleet.killing import quick

from modcal_nodes.fleet.pool import run_here
from modcal_nodes.fleet.room import Room, room
from modcal_nodes.fleet.task import DONE, FAILED, Task
from modcal_nodes.io.options import Options


def tasks(folder: Path, *names: str) -> list[Task]:
    return [Task(name, folder / name, Options()) for name in names]


@pytest.mark.slow
def test_a_killed_process_loses_nothing(tmp_path: Path) -> None:
    names = ["a", "once_1", "b", "always", "c", "once_2", "d"]
    outcomes = {o.name: o for o in run_here(tasks(tmp_path, *names), 2, quick)}
    assert sorted(outcomes) == sorted(names)
    assert {name for name, o in outcomes.items() if o.state == DONE} == set(names) - {"always"}
    assert outcomes["always"].state == FAILED
    assert outcomes["always"].said == "its process was ended 2 times, the last time by signal 9"


def test_processes_are_used_again_and_have_one_thread_each(tmp_path: Path) -> None:
    before = os.environ.get("OMP_NUM_THREADS")
    outcomes = list(run_here(tasks(tmp_path, *"abcdefgh"), 2, quick))
    assert os.environ.get("OMP_NUM_THREADS") == before
    assert {o.row["threads"] for o in outcomes} == {"1"}
    assert len({o.row["process"] for o in outcomes}) <= 2
    assert os.getpid() not in {o.row["process"] for o in outcomes}


def test_giving_up_ends_the_processes(tmp_path: Path) -> None:
    running = run_here(tasks(tmp_path, *"abcd"), 2, quick)
    process = next(running).row["process"]
    running.close()
    assert not Path(f"/proc/{process}").exists()


def test_memory_limits_how_many_run() -> None:
    assert Room(8, 3.5e9).jobs == 3
    assert Room(8, 1e8).jobs == 1
    assert Room(8, None).jobs == 8
    assert Room(2, 1e12).jobs == 2
    assert "too many" in Room(8, 3.5e9).said(5)
    assert "too many" not in Room(8, 3.5e9).said(3)
    assert room().cores >= 1
    assert room().jobs >= 1
