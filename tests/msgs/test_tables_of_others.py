"""Tables as people have them: a bad row, joints counted otherwise, several targets, files without a common column."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgs.exported import BASE, CHAIN, TOOL, postures, written

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.measurements import Recording
from modcal_core.robots import forward
from modcal_msgs_py.tables import MeasuredArm, Proposal, find, import_tables

J = tuple(CHAIN.names)


def seen(q: np.ndarray, tool: np.ndarray = TOOL, zeros: np.ndarray | float = 0.0) -> np.ndarray:
    """Poses of an arm whose zeros are off by a milliradian and what is given."""
    off = 1e-3 * np.array([1.0, -1.2, 0.8, 1.5, -1.0, 0.7])
    return BASE @ forward(CHAIN, q + off + zeros) @ tool


def columns(q: np.ndarray, p: np.ndarray, **more: Any) -> dict[str, Any]:
    """Joints in degrees and a position in mm, as a pendant and a tracker show them."""
    joints = {f"J{k + 1}": np.degrees(q[:, k]) for k in range(CHAIN.n)}
    return {**joints, **dict(zip("XYZ", 1e3 * p.T, strict=True)), **more}


def proposed(folder: Path, table: dict[str, Any]) -> tuple[Proposal, dict[str, Any], Recording]:
    made = find([written(folder, table)], CHAIN)
    assert not made.open
    (entry,) = made.mapping["tables"]
    return made, entry, import_tables(dict(made.mapping), folder, "m")


def test_one_repeated_row_changes_no_unit_and_is_named(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng)
    p = seen(q)[:, :3, 3].copy()
    p[17] = p[16]
    made, entry, _ = proposed(tmp_path, {"Point": [f"P{k}" for k in range(len(q))], **columns(q, p)})
    assert entry["point"]["unit"] == "mm"
    (said,) = [s for s in made.assumed if "fits the arm in no way" in s]
    assert said.startswith("line 19 (P17) ")
    assert "line 18 (P16)" in said


def test_a_zero_that_is_five_degrees_off_is_no_refusal(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng)
    _, entry, recording = proposed(tmp_path, columns(q, seen(q, zeros=np.radians([0, 0, 0, 5, 0, 0]))[:, :3, 3]))
    assert entry["point"]["unit"] == "mm"
    assert not {"sign", "offset", "coupled"} & set(entry["joints"])
    assert np.abs(recording.joints[0].position - q).max() < 1e-6


@pytest.mark.parametrize(
    ("told", "stated"),
    [
        (lambda q: q - [0, np.pi / 2, 0, 0, 0, 0], {"offset": {J[1]: 90.0}}),
        (lambda q: q * [1, 1, 1, 1, -1, 1] - np.outer(q[:, 1], [0, 0, 1, 0, 0, 0]), {"coupled": {J[2]: {J[1]: 1.0}}, "sign": {J[4]: -1.0}}),
    ],
)  # fmt: skip
def test_joints_that_are_counted_otherwise_are_stated(
    told: Any, stated: dict[str, Any], tmp_path: Path, rng: np.random.Generator
) -> None:
    q = postures(rng)
    made, entry, recording = proposed(tmp_path, columns(told(q), seen(q)[:, :3, 3]))
    assert {key: entry["joints"].get(key) for key in stated} == stated
    assert any("counted otherwise" in said for said in made.proved)
    assert np.abs(recording.joints[0].position - q).max() < 1e-6


def test_how_joints_are_counted_goes_for_speeds_and_torques_too(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("a,b,va,vb,ta,tb,x\n10,20,1,2,5,7,0\n")
    joints = {
        "unit": "deg",
        "columns": {"a": "a", "b": "b"},
        "sign": {"a": -1},
        "offset": {"a": 90},
        "coupled": {"b": {"a": 1}},
        "velocity": {"unit": "deg/s", "columns": {"a": "va", "b": "vb"}},
        "effort": {"columns": {"a": "ta", "b": "tb"}},
    }
    point = {"frame": "f", "unit": "m", "position": ["x", "x", "x"]}
    entry = {"files": "t.csv", "time": {"order": {"period_s": 1}}, "joints": joints, "point": point}
    (track,) = import_tables({"tables": [entry]}, tmp_path, "m").joints
    assert np.degrees(track.position[0]) == pytest.approx([80.0, 30.0])
    assert np.degrees(track.velocity[0]) == pytest.approx([-1.0, 3.0])
    assert track.effort[0] @ track.velocity[0] == pytest.approx(np.radians(5.0 * 1 + 7.0 * 2))  # the same power


def test_a_column_tells_which_target_was_measured(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng)
    which = rng.integers(1, 4, len(q))
    tools = [TOOL @ se3.transform(p=p) for p in ([0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.0, 0.12, 0.08])]
    p = np.array([seen(q[[i]], tools[k - 1])[0, :3, 3] for i, k in enumerate(which)])
    _, entry, recording = proposed(tmp_path, columns(q, p, SMR=[str(k) for k in which]))
    assert entry["point"]["target"] == "SMR"
    first = list(dict.fromkeys(which))
    order = np.argsort([first.index(k) for k in which], kind="stable")
    assert np.abs(recording.joints[0].position - q[order]).max() < 1e-6
    changes = np.searchsorted(recording.joints[0].stamps, recording.tool_changes)
    assert changes.tolist() == np.cumsum([int((which == k).sum()) for k in first])[:-1].tolist()


def test_files_of_equal_length_are_joined_by_row_where_the_arm_then_fits(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    q = postures(rng)
    table = columns(q, seen(q)[:, :3, 3])
    robot = written(tmp_path, {k: v for k, v in table.items() if k[0] == "J"}, "robot.csv", header=False)
    tracker = written(tmp_path, {k: v for k, v in table.items() if k in "XYZ"}, "tracker.csv", header=False)
    made = find([robot, tracker], CHAIN)
    assert not made.open
    assert made.mapping["tables"][0]["joined"][0]["by"] == "row"
    recording = import_tables(dict(made.mapping), tmp_path, "m")
    assert np.abs(recording.joints[0].position - q).max() < 1e-6
    with pytest.raises(BadTable, match="no columns are found"):
        find([robot, written(tmp_path, {k: rng.permutation(table[k]) for k in "XYZ"}, "other.csv")], CHAIN)


def test_ten_rows_are_enough(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng, 10)
    _, entry, _ = proposed(tmp_path, columns(q, seen(q)[:, :3, 3]))
    assert (entry["joints"]["unit"], entry["point"]["unit"]) == ("deg", "mm")


def test_rows_that_are_asked_for(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("a,x,SMR,state\n1,1,1,ok\n2,2,2,ok\n3,3,1,bad\n4,4,3.0,ok\n")
    point = {"frame": "f", "unit": "m", "position": ["x", "x", "x"]}
    joints = {"unit": "rad", "columns": {"a": "a"}}
    entry = {"files": "t.csv", "time": {"order": {"period_s": 1}}, "joints": joints, "point": point}
    made = import_tables({"tables": [{**entry, "rows": {"SMR": [1, 3], "state": "ok"}}]}, tmp_path, "m")
    assert made.joints[0].position[:, 0].tolist() == [1.0, 4.0]
    with pytest.raises(BadTable, match="no row of t.csv is as stated"):
        import_tables({"tables": [{**entry, "rows": {"SMR": 7}}]}, tmp_path, "m")


def test_a_workbook(tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    q = postures(rng, 20)
    table = columns(q, seen(q)[:, :3, 3])
    book = openpyxl.Workbook()
    book.active.append(["Cell 7", "tracker", "robot"])
    sheet = book.create_sheet("Points")
    sheet.append(["measured", "today"])
    sheet.append(list(table))
    for row in zip(*table.values(), strict=True):
        sheet.append([float(v) for v in row])
    book.save(tmp_path / "cell.xlsx")
    made = find([tmp_path / "cell.xlsx"], CHAIN)
    assert made.mapping["tables"][0]["sheet"] == "Points"
    assert np.abs(import_tables(dict(made.mapping), tmp_path, "m").joints[0].position - q).max() < 1e-6
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(BadTable, match="is a workbook, and openpyxl is not installed"):
        find([tmp_path / "cell.xlsx"], CHAIN)


def test_cells_that_name_their_numbers(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng, 30)
    table = columns(q, seen(q)[:, :3, 3])
    path = written(tmp_path, {k: [f"{k} = {v:.6f}" for v in column] for k, column in table.items()}, header=False)
    made = find([path], CHAIN)
    assert made.mapping["tables"][0]["point"]["position"] == ["X", "Y", "Z"]
    assert np.abs(import_tables(dict(made.mapping), tmp_path, "m").joints[0].position - q).max() < 1e-6


def test_numbers_with_their_unit_and_with_groups_of_thousands(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng, 30)
    table = columns(q, seen(q)[:, :3, 3])
    table = {k: [f"{v:.6f}°" if k[0] == "J" else f"{v:,.6f} mm" for v in column] for k, column in table.items()}
    made = find([written(tmp_path, table, marks=(";", "."))], CHAIN)
    assert not made.open
    (entry,) = made.mapping["tables"]
    assert (entry["joints"]["unit"], entry["point"]["unit"]) == ("deg", "mm")
    assert np.abs(import_tables(dict(made.mapping), tmp_path, "m").joints[0].position - q).max() < 1e-6
    table["X"][4] = "1.2 m"
    with pytest.raises(BadTable, match="column 6 holds numbers in m and in mm"):
        find([written(tmp_path, table, marks=(";", "."))], CHAIN)


def test_a_comma_that_may_be_the_decimal_sign_groups_no_thousands(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng, 30)
    cells = {k: [f"{v:.3f}".replace(".", ",") for v in c] for k, c in columns(q, seen(q)[:, :3, 3]).items()}
    made = find([written(tmp_path, cells, marks=(";", ","))], CHAIN)
    assert made.mapping["tables"][0]["point"]["unit"] == "mm"


@pytest.mark.parametrize(("name", "step_s"), [("Date", 3600.0), ("Timestamp", 20.0)])
def test_days_of_a_spreadsheet(name: str, step_s: float, tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng, 20)
    stamps = 1_700_000_000.0 + step_s * np.arange(20)
    _, entry, recording = proposed(tmp_path, {name: stamps / 86400.0 + 25569.0, **columns(q, seen(q)[:, :3, 3])})
    assert entry["time"] == {"seconds": name, "unit": "excel"}
    assert recording.joints[0].stamps == pytest.approx(stamps, abs=2e-3)


def test_axes_that_are_left_handed_are_named(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng)
    p = seen(q)[:, :3, 3][:, [1, 0, 2]]
    with pytest.raises(BadTable, match="X, Y, Z are left-handed: with one of the axes turned round"):
        find([written(tmp_path, columns(q, p))], CHAIN)


@pytest.mark.parametrize(
    "form", ["%d/%m/%Y %H:%M:%S", "%Y.%m.%d_%H-%M-%S", "%d-%b-%Y %I:%M:%S %p", "%Y-%m-%dT%H:%M:%S.%f000Z"]
)
def test_dates_in_many_formats(form: str, tmp_path: Path, rng: np.random.Generator) -> None:
    from datetime import UTC, datetime

    q = postures(rng, 20)
    stamps = [1_700_000_000 + 60 * 60 * 7 * k for k in range(len(q))]
    cells = [datetime.fromtimestamp(stamp, UTC).strftime(form) for stamp in stamps]
    _, _, recording = proposed(tmp_path, {"Time Stamp": cells, **columns(q, seen(q)[:, :3, 3])})
    assert recording.joints[0].stamps == pytest.approx(stamps, abs=1e-3)


def test_a_time_that_is_not_understood_is_mentioned(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng, 20)
    made, entry, _ = proposed(tmp_path, {"Time Stamp": ["week 7"] * 20, **columns(q, seen(q)[:, :3, 3])})
    assert "order" in entry["time"]
    assert any("'week 7' is in no format that is known" in said for said in made.assumed)


def test_every_column_is_used_or_mentioned(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng, 30)
    more = {f"range {k}": rng.uniform(1.0, 2.0, 30) for k in range(15)}
    more |= {"operator": ["me"] * 30, "lot": np.full(30, 7.0), "Air pressure": rng.uniform(1.0, 2.0, 30)}
    more |= {"Temp 1": rng.uniform(20.0, 21.0, 30)}
    made, entry, _ = proposed(tmp_path, columns(q, seen(q)[:, :3, 3], **more))
    assert entry["signals"]["air_pressure"] == "Air pressure"
    assert "Temp 1" in entry["temperature"].values()
    said = f"{entry} {made.assumed}"
    assert [name for name in more if name not in said] == []


def test_other_joints_of_the_robot_description_stay_joints(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng, 30)
    more = {"left_elbow": rng.uniform(-40.0, 40.0, 30), "rail [mm]": rng.uniform(0.0, 900.0, 30)}
    path = written(tmp_path, columns(q, seen(q)[:, :3, 3], **more))
    made = find([path], MeasuredArm(CHAIN, bystanders={"left_elbow": True, "rail": False, "gripper": False}))
    assert not made.open
    (track,) = import_tables(dict(made.mapping), tmp_path, "m").joints
    assert track.names == (*J, "left_elbow", "rail")
    assert track.position[:, 6] == pytest.approx(np.radians(more["left_elbow"]), abs=1e-6)
    assert track.position[:, 7] == pytest.approx(1e-3 * more["rail [mm]"], abs=1e-6)
