"""An arm that MuJoCo moves, watched: what is planted is named, what is not planted is not."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from sentinel.worlds import NONE, ArmWorld, Change

from modcal_core.errors import BadTable, NotEnoughData
from modcal_core.measurements import JointTrack, Recording
from modcal_core.robots import read_inertias
from modcal_core.sentinel import ArmVerdict, BagHistory, Cells, MonitoredArm, Normal, cells_of, judge_bags
from modcal_msgs_py import episodes_of, write_recording
from modcal_nodes.cli.main import run

SECONDS, DAYS = 30.0, 6
WORLD = ArmWorld("ur10", 3, tag=True)
ARM = MonitoredArm(WORLD.chain.names, WORLD.chain, read_inertias(WORLD.urdf, WORLD.chain))
ELBOW, WRIST = ARM.names[2], ARM.names[3]


def cells(day: int, change: Change = NONE, task: int = 0) -> Cells:
    return cells_of(WORLD.record(day, SECONDS, task, change), ARM.names, f"day {day}")


@pytest.fixture(scope="module")
def normal() -> Normal:
    return Normal.fit([cells(day) for day in range(DAYS)], ARM)


def judged(normal: Normal, change: Change = NONE, days: tuple[int, ...] = (20,), task: int = 0) -> ArmVerdict:
    return judge_bags(normal, [cells(day, change, task) for day in days])


@pytest.mark.parametrize(
    ("change", "label", "size"),
    [
        (Change("zero", 2, np.radians(1.0)), f"zero of {ELBOW}", 17.45),
        (Change("latency", -1, 0.02), "latency of all joints", 20.0),
        (Change("payload", -1, 0.8), "payload", 0.8),
        (Change("camera", -1, 0.005), "camera", None),
    ],
)
def test_a_change_is_named_with_its_size(normal: Normal, change: Change, label: str, size: float | None) -> None:
    found = judged(normal, change)
    assert found.status == "changed"
    named = found.changes[0]
    assert label == named.label
    if size is not None:
        assert abs(named.sizes[0].value - size) < 0.25 * size


def test_nothing_is_named_where_nothing_changed(normal: Normal) -> None:
    found = judged(normal, days=(20, 21))
    assert (found.status, found.changes) == ("unchanged", ())
    assert f"zero of {ARM.names[0]}" not in found.noticed or found.noticed[f"zero of {ARM.names[0]}"][0] > 1.0
    assert found.noticed[f"zero of {ELBOW}"][0] < 35.0


def test_other_work_and_a_declared_payload_are_no_alarms(normal: Normal) -> None:
    assert judged(normal, days=(20,), task=5).status in ("unchanged", "cannot_tell")
    heavy = cells(20, Change("payload", -1, 2.0))
    assert judge_bags(normal, [heavy]).status == "changed"
    assert not judge_bags(normal, [heavy], [heavy.name]).changes


def test_a_change_is_dated(normal: Normal) -> None:
    bags = [cells(20), cells(21), cells(22, Change("zero", 1, np.radians(1.0)))]
    (change, *_) = judge_bags(normal, bags).changes
    assert (change.kind, change.place, change.since) == ("joint_zero", ARM.names[1], "day 22")


def test_following_alone_shows_latency_and_says_what_it_does_not(normal: Normal) -> None:
    arm = MonitoredArm(ARM.names)
    plain = Normal.fit([cells(day) for day in range(4)], arm)
    found = judge_bags(plain, [cells(20, Change("latency", -1, 0.02))])
    assert [c.label for c in found.changes][:1] == ["latency of all joints"]
    assert not any(label.startswith("zero of") for label in found.noticed)


def test_a_history_keeps_what_it_has(tmp_path: Path) -> None:
    day = cells(0)
    kept = BagHistory(tmp_path, ARM)
    kept.add([day], "reference")
    kept.add([day], "reference")
    ((again, other),) = kept.read("reference")
    assert (again.name, other, len(kept.read("later"))) == (day.name, False, 0)
    assert all(np.allclose(again[key], day[key], atol=1e-3, equal_nan=True) for key in day.columns)
    with sqlite3.connect(tmp_path / "sentinel.db") as store, pytest.raises(sqlite3.IntegrityError, match="rows are"):
        store.execute("DELETE FROM bags")
    with pytest.raises(BadTable, match="another arm"):
        BagHistory(tmp_path, MonitoredArm(("a", "b")))


def test_the_verb_reads_bags_and_goes_on_with_a_history(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for day, change in [(d, Change()) for d in range(4)] + [(9, Change("zero", 2, np.radians(2.0)))]:
        made = WORLD.record(day, 14.0, 0, change)
        write_recording(made, tmp_path / f"day{day}", commanded=made.commands[0])
    reference = [word for day in range(4) for word in ("--reference", str(tmp_path / f"day{day}"))]
    folder, out = ["--history", str(tmp_path / "kept")], ["--out", str(tmp_path / "out"), "--json"]
    assert run(["sentinel", str(tmp_path / "day3"), *reference, *folder, *out]) == 0
    capsys.readouterr()
    assert run(["sentinel", str(tmp_path / "day9"), *folder, *out]) == 3
    said = json.loads(capsys.readouterr().out)
    assert f"zero of {ELBOW}" in [said["changes"][0]["label"], *said["changes"][0]["same_as"]]
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"sentinel.html", "sentinel.json", "stations.csv"}
    assert run(["sentinel", str(tmp_path / "day9")]) == 2
    assert "--reference" in capsys.readouterr().err


def test_too_little_is_refused() -> None:
    with pytest.raises(NotEnoughData, match="4 are needed"):
        Normal.fit([cells(0)], ARM)
    t, q = np.arange(100) / 250.0, np.zeros((100, 1))
    with pytest.raises(NotEnoughData, match="10 s are needed"):
        cells_of(Recording((JointTrack(("a",), t, q, q, q, t),)), ("a",), "short")


def test_a_data_set_of_lerobot_is_a_leader_and_a_follower(tmp_path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    named = {"names": ["shoulder.pos", "elbow.pos"]}
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(
        json.dumps({"features": {"action": named, "observation.state": named}})
    )
    (tmp_path / "data" / "chunk-000").mkdir(parents=True)
    t = np.tile(np.arange(30) / 30.0, 2)
    state = np.stack([40.0 * np.sin(t), 20.0 * np.cos(t)], axis=1)
    table = {"observation.state": state.tolist(), "action": (state + 1.0).tolist(), "timestamp": t.tolist()}
    table["episode_index"] = [0] * 30 + [1] * 30
    pyarrow.parquet.write_table(pyarrow.table(table), tmp_path / "data" / "chunk-000" / "file-000.parquet")
    episodes = episodes_of(tmp_path)
    assert len(episodes) == 2
    (follower,), (leader,) = episodes[1][1].joints, episodes[1][1].commands
    assert follower.names == ("shoulder", "elbow")
    assert np.allclose(leader.position - follower.position, np.radians(1.0))
