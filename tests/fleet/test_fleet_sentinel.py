"""``modcal fleet --sentinel``: each robot by its own history."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from sentinel.worlds import NONE, ArmWorld, Change

from modcal_core.robots import read_inertias
from modcal_core.sentinel import BagHistory, MonitoredArm, cells_of
from modcal_msgs_py import write_recording
from modcal_nodes.cli.main import run

WORLD = ArmWorld("ur10", 3)
ARM = MonitoredArm(WORLD.chain.names, WORLD.chain, read_inertias(WORLD.urdf, WORLD.chain))
CHANGED = Change("friction", 1, 1.0)


@pytest.mark.slow
def test_each_robot_is_judged_by_its_own_history(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    days = [cells_of(WORLD.record(day, 30.0, 0), ARM.names, f"day {day}") for day in range(12)]
    for robot, change in (("sound", NONE), ("worn", CHANGED), ("new", NONE)):
        if robot != "new":
            BagHistory(tmp_path / "histories" / robot, ARM).add(days, "reference")
        made = WORLD.record(20, 30.0, 0, change)
        write_recording(made, tmp_path / "today" / robot / "morning")
    fleet = ["fleet", f"{tmp_path}/today", "--sentinel", str(tmp_path / "histories"), "--out", str(tmp_path / "out")]
    assert run([*fleet, "--jobs", "1"]) == 2
    assert "1 of 3 robots were not judged; new refused: reference: holds 0 recordings" in capsys.readouterr().err
    rows = {row["name"]: row for row in pq.read_table(tmp_path / "out" / "fleet.parquet").to_pylist()}
    assert (rows["sound"]["status"], rows["worn"]["status"], rows["new"]["status"]) == ("unchanged", "changed", None)
    assert f"friction of {ARM.names[1]}" in rows["worn"]["effects"]
    assert np.isfinite(rows["worn"]["started"].timestamp())
    assert {p.name for p in (tmp_path / "out" / "worn").iterdir()} == {"sentinel.html", "sentinel.json", "stations.csv"}
    assert run([*fleet, "--jobs", "1", "--geometry-only"]) == 2
    assert "--geometry-only: is no option of --sentinel" in capsys.readouterr().err
