"""An arm that MuJoCo moves, watched: what is planted is named, what is not planted is not."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from sentinel.worlds import NONE, ArmWorld, Change

from modcal_core.errors import BadTable, NotEnoughData
from modcal_core.measurements import JointTrack, Recording
from modcal_core.robots import read_inertias
from modcal_core.sentinel import ArmJudge, ArmVerdict, BagHistory, Cells, MonitoredArm, Normal, cells_of
from modcal_core.sentinel.predictive import Number, Scatter, Spoken
from modcal_msgs_py import episodes_of, write_recording
from modcal_nodes.cli.main import run

SECONDS, DAYS = 30.0, 12
WORLD = ArmWorld("ur10", 3, tag=True)
ARM = MonitoredArm(WORLD.chain.names, WORLD.chain, read_inertias(WORLD.urdf, WORLD.chain))
ELBOW, WRIST = ARM.names[2], ARM.names[3]


@cache
def cells(day: int, change: Change = NONE, task: int = 0) -> Cells:
    return cells_of(WORLD.record(day, SECONDS, task, change), ARM.names, f"day {day}")


@pytest.fixture(scope="module")
def normal() -> ArmJudge:
    return ArmJudge(Normal.fit([cells(day) for day in range(DAYS)], ARM))


def by(judge: ArmJudge, *bags: Cells, other_payload: bool = False) -> ArmVerdict:
    return judge.judged([judge.hear(one, other_payload) for one in bags])


def judged(normal: ArmJudge, change: Change = NONE, days: tuple[int, ...] = (20,), task: int = 0) -> ArmVerdict:
    return by(normal, *(cells(day, change, task) for day in days))


@pytest.mark.parametrize(
    ("change", "label", "size"),
    [
        (Change("zero", 2, np.radians(1.0)), f"zero of {ELBOW}", 17.45),
        (Change("latency", -1, 0.02), "latency of all joints", 20.0),
        (Change("payload", -1, 0.8), "payload", 0.8),
        (Change("camera", -1, 0.005), "camera", None),
    ],
)
def test_a_change_is_named_with_its_size(normal: ArmJudge, change: Change, label: str, size: float | None) -> None:
    found = judged(normal, change)
    assert found.status == "changed"
    named = found.changes[0]
    assert label == named.label
    if size is not None:
        assert abs(named.sizes[0].value - size) < 0.25 * size


def test_nothing_is_named_where_nothing_changed(normal: ArmJudge) -> None:
    found = judged(normal, days=(20, 21))
    assert (found.status, found.changes) == ("unchanged", ())
    assert f"zero of {ARM.names[0]}" not in found.noticed or found.noticed[f"zero of {ARM.names[0]}"][0] > 1.0
    assert found.noticed[f"zero of {ELBOW}"][0] < 35.0


def test_other_work_and_a_declared_payload_are_no_alarms(normal: ArmJudge) -> None:
    assert judged(normal, days=(20,), task=5).status in ("unchanged", "cannot_tell")
    heavy = cells(20, Change("payload", -1, 2.0))
    assert by(normal, heavy).status == "changed"
    assert not by(normal, heavy, other_payload=True).changes


def test_what_another_change_explains_leaves_no_evidence_of_rounding() -> None:
    """Of information of 1e6 on two changes that are alike rounding is left, and of what it says a little more."""
    rng, told = np.random.default_rng(0), np.array([[1.0, 1.0], [1.0, 1.0 + 1e-13]])
    every = [Spoken(("a", "b"), told, told @ rng.normal(size=2)) for _ in range(8)]
    beside = [one.beside(np.eye(2)[:, :1]) for one in every]
    found = Scatter.of(np.eye(2)[:, 1:], every).number(replace(beside[0], vector=np.array([0.0, 1e-3])))
    assert (found.square, found.directions) == (0.0, 0)
    assert Scatter.of(np.eye(2)[:, 1:], beside).freedom == 0


@pytest.mark.parametrize(("m", "k"), [(4, 1), (12, 1), (12, 6), (40, 3)])
def test_evidence_is_an_e_value_whatever_the_recordings_scatter_by(m: int, k: int) -> None:
    """Numbers that scatter by more than the model says, and more in one direction than in another: of new ones without
    a change the mean Bayes factor is one at most, and as many are beyond a limit as Markov's inequality allows.
    """
    rng, sizes, factors = np.random.default_rng(m + k), 2.0 ** np.arange(1.0, 12.0), []
    far = rng.uniform(1.0, 4.0, k)
    for _ in range(400):
        told = [Spoken((), np.eye(k), far * rng.normal(size=k)) for _ in range(m)]
        scatter = Scatter.of(np.eye(k), told)
        factors += [
            scatter.number(Spoken((), np.eye(k), far * z)).log_factor(sizes, False) for z in rng.normal(size=(50, k))
        ]
    e = np.exp(np.array(factors)).mean(axis=1)
    assert e.mean() < 1.1
    assert (e > 100.0).mean() < 0.01


def test_a_growing_change_is_not_below_zero() -> None:
    up = Number(50.0, 1, True, 11).log_factor(np.array([8.0]), True)
    assert up - Number(50.0, 1, False, 11).log_factor(np.array([8.0]), True) > 8.0
    assert abs(up - Number(50.0, 1, True, 11).log_factor(np.array([8.0]), False) - np.log(2.0)) < 1e-3


def test_a_change_is_dated(normal: ArmJudge) -> None:
    bags = [cells(20), cells(21), cells(22, Change("zero", 1, np.radians(1.0)))]
    (change, *_) = by(normal, *bags).changes
    assert (change.kind, change.place, change.since) == ("joint_zero", ARM.names[1], "day 22 of 2001-10-01 01:46")


def test_the_last_recording_is_what_is_judged(normal: ArmJudge) -> None:
    away = cells(21)
    away = replace(away, columns={**away.columns, "q": away["q"] + 3.0, "tag_q": away["tag_q"] + 3.0})
    assert by(normal, cells(20), away).status == "cannot_tell"


def test_following_alone_shows_latency_and_says_what_it_does_not(normal: ArmJudge) -> None:
    arm = MonitoredArm(ARM.names)
    plain = ArmJudge(Normal.fit([cells(day) for day in range(4)], arm))
    found = by(plain, cells(20, Change("latency", -1, 0.02)))
    assert [c.label for c in found.changes][:1] == ["latency of all joints"]
    assert not any(label.startswith("zero of") for label in found.noticed)


def test_a_payload_shows_in_what_joints_yield_by_where_efforts_are_not_reported() -> None:
    def silent(one: Cells) -> Cells:
        kept = {k: x for k, x in one.columns.items() if not k.startswith("tag")}
        return replace(one, columns={**kept, "effort": np.full_like(one["effort"], np.nan)})

    judge = ArmJudge(Normal.fit([silent(cells(day)) for day in range(DAYS)], ARM))
    heavy = silent(cells(20, Change("payload", -1, 2.0)))
    (change, *_) = by(judge, heavy).changes
    assert change.label == "payload"
    assert abs(change.sizes[0].value - 2.0) < 0.5
    assert not by(judge, heavy, other_payload=True).changes
    assert any("without efforts" not in name for name in by(judge, cells(20)).untold) is False
    assert by(judge, cells(20)).status == "cannot_tell"  # efforts came: another signal


def test_a_dock_shows_a_zero_without_any_efforts() -> None:
    world = ArmWorld("ur10", 3, dock=True)

    def docked(day: int, change: Change = NONE) -> Cells:
        made = cells_of(world.record(day, 60.0, 0, change), ARM.names, f"day {day}")
        kept = {k: x for k, x in made.columns.items() if not k.startswith("apart")}
        return replace(made, columns={**kept, "effort": np.full_like(made["effort"], np.nan)})

    judge = ArmJudge(Normal.fit([docked(day) for day in range(DAYS)], ARM))
    assert by(judge, docked(20)).status == "unchanged"
    found = by(judge, docked(20, Change("zero", 2, np.radians(1.0))))
    assert found.changes[0].label == f"zero of {ELBOW}"
    assert abs(found.changes[0].sizes[0].value - 17.45) < 1.5


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
    for day, change in [(d, Change()) for d in range(8)] + [(9, Change("zero", 2, np.radians(2.0)))]:
        made = WORLD.record(day, 14.0, 0, change)
        write_recording(made, tmp_path / f"day{day}")
    reference = [word for day in range(8) for word in ("--reference", str(tmp_path / f"day{day}"))]
    folder, out = ["--history", str(tmp_path / "kept")], ["--out", str(tmp_path / "out"), "--json"]
    assert run(["sentinel", str(tmp_path / "day3"), *reference, *folder, *out]) == 0
    capsys.readouterr()
    assert run(["sentinel", str(tmp_path / "day9"), *folder, *out]) == 3
    said = json.loads(capsys.readouterr().out)
    assert f"zero of {ELBOW}" in [said["changes"][0]["label"], *said["changes"][0]["same_as"]]
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"sentinel.html", "sentinel.json", "stations.csv"}
    assert run(["sentinel", str(tmp_path / "day9")]) == 2
    assert "--reference" in capsys.readouterr().err


def test_tables_are_read_by_a_mapping(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for day, late in [(0, 0.0), (1, 0.0), (2, 0.0), (3, 0.0), (20, 0.0), (21, 0.02)]:
        made = WORLD.record(day, 30.0, 0, Change("latency", -1, late))
        t, q, told = (made.joints[0].stamps % 86400.0, made.joints[0].position, made.commands[0].position)
        names = [*(f"actual {k}" for k in range(6)), *(f"target {k}" for k in range(6))]
        header = ",".join(["time", *names])
        np.savetxt(tmp_path / f"run_{day}.csv", np.column_stack([t, q, told]), "%.7g", ",", header=header, comments="")
    joints = {"unit": "rad", "columns": {n: f"actual {k}" for k, n in enumerate(ARM.names)}}
    joints["commanded"] = {"columns": {n: f"target {k}" for k, n in enumerate(ARM.names)}}
    mapping = {"tables": [{"files": "*.csv", "time": {"seconds": "time", "unit": "s"}, "joints": joints}]}
    (tmp_path / "mapping.yaml").write_text(json.dumps(mapping))
    words = [word for day in range(4) for word in ("--reference", str(tmp_path / f"run_{day}.csv"))]
    words += ["--mapping", str(tmp_path / "mapping.yaml"), "--out", str(tmp_path / "out"), "--json"]
    assert run(["sentinel", str(tmp_path / "run_20.csv"), *words]) == 0
    capsys.readouterr()
    assert run(["sentinel", str(tmp_path / "run_21.csv"), *words]) == 3
    assert json.loads(capsys.readouterr().out)["changes"][0]["label"] == "latency of all joints"


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
