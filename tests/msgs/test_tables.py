"""Tables into bags: what is stated is done, what is not stated is an error with its place; cells that are missing or wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_msgs_py.mcap_read import read_recording
from modcal_msgs_py.recording_write import write_recording
from modcal_msgs_py.tables import import_tables, require_mapping
from modcal_nodes.cli.main import run

TABLE = """time;j1;j2;x;y;z;a;b;c;t
20240101120000;90,0;-45,5;1000,5;0;2;30;20;10;21,5
20240101120000;91,0;-45,5;1001,5;0;2;30;20;10;21,5
20240101120007;92,0;-45,5;1002,5;0;2;30;20;10;21,6
"""
MAPPING = """
tables:
  - files: "*.csv"
    delimiter: ";"
    decimal: ","
    time: {column: time, format: "%Y%m%d%H%M%S"}
    joints: {unit: deg, columns: {joint_1: j1, joint_2: j2}}
    pose:
      frame: "{stem}"
      unit: mm
      position: [x, y, z]
      euler: {columns: [a, b, c], sequence: ZYX, unit: deg}
    temperature: {ambient: t}
"""


def mapping(**changes: Any) -> dict[str, Any]:
    data = yaml.safe_load(MAPPING)
    for key, value in changes.items():
        if value is None:
            del data["tables"][0][key]
        else:
            data["tables"][0][key] = value
    return data


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "cubes.csv").write_text(TABLE)
    return tmp_path


def test_units_angles_and_stamps(folder: Path) -> None:
    recording = import_tables(mapping(), folder, "m.yaml")
    joints, reading = recording.joints[0], recording.readings[0]
    assert joints.names == ("joint_1", "joint_2")
    assert joints.position[1] == pytest.approx(np.radians([91.0, -45.5]))
    assert reading.frame == "cubes"
    assert reading.values[2, :3] == pytest.approx([1.0025, 0.0, 0.002])
    R = Rotation.from_euler("ZYX", [30, 20, 10], degrees=True).as_matrix()
    assert np.abs(se3.from_pose(reading.values[0])[:3, :3] - R).max() < 1e-15
    assert np.array_equal(joints.stamps, reading.stamps)
    # two rows in one second are still two stations
    assert np.diff(reading.stamps) == pytest.approx([0.001, 6.999], abs=1e-6)
    assert reading.stamps[0] == 1704110400.0
    assert recording.signals[0].name == "temperature:ambient"


def test_other_conventions(folder: Path) -> None:
    pose = mapping()["tables"][0]["pose"]
    del pose["euler"]
    inverse = import_tables(mapping(pose={**pose, "inverse": True, "rotvec": {"columns": ["a", "b", "c"], "unit": "deg"}}),
                            folder, "m")  # fmt: skip
    T = se3.from_pose(inverse.readings[0].values[0])
    expected = se3.transform(Rotation.from_rotvec(np.radians([30, 20, 10])).as_matrix(), [1.0005, 0, 0.002])
    assert np.abs(T @ expected - np.eye(4)).max() < 1e-14
    point = {"frame": "t", "unit": "m", "position": ["x", "y", "z"]}
    assert import_tables(mapping(pose=None, point=point), folder, "m").readings[0].values[0, 0] == 1000.5
    twice = import_tables(mapping(pose=None, point={**point, "plus": ["x", "y", "z"]}), folder, "m")
    assert twice.readings[0].values[0, 0] == 2001.0
    none = import_tables(mapping(pose=None, point={**point, "minus": ["x", "y", "z"]}), folder, "m")
    assert not none.readings[0].values.any()
    socket = import_tables(mapping(pose=None, same_point={"frame": "s"}), folder, "m").readings[0]
    assert (socket.kind, socket.values.any()) == ("point", False)
    order = import_tables(mapping(time={"order": {"period_s": 10.0}}), folder, "m")
    assert np.diff(order.readings[0].stamps) == pytest.approx([10.0, 10.0])
    assert "has no clock" in order.warnings[0]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"joints": {"columns": {"a": "j1"}}}, "joints: 'unit' is not stated"),
        ({"joints": {"unit": "grad", "columns": {"a": "j1"}}}, "unit: 'grad' is not one of rad, deg"),
        ({"joints": {"unit": "rad", "columns": {"a": "j9"}}}, "cubes.csv: has no column j9: columns are time, j1"),
        ({"joints": {"unit": "rad", "columns": {"a": "time", "b": "note"}}}, "has no column note"),
        (
            {"pose": {"frame": "t", "unit": "mm", "position": ["x", "y", "z"]}},
            "0 of these ways are stated: euler or quaternion or rotvec or matrix",
        ),
        ({"pose": None, "joints": None}, "neither joints nor a reading are stated"),
        ({"files": "*.txt"}, "matches no file"),
        ({"time": {"column": "time", "format": "%d.%m.%Y"}}, "line 2, column time: '20240101120000' is not"),
        ({"colour": "red"}, "unknown key colour"),
        ({"decimal": "."}, "line 2, column j1: '90,0' is not a number"),
    ],
)
def test_what_is_missing_or_wrong_is_named(changes: dict[str, Any], said: str, folder: Path) -> None:
    with pytest.raises(BadTable) as caught:
        import_tables(mapping(**changes), folder, "m.yaml")
    assert said in str(caught.value)


def test_the_verb_writes_a_bag_or_nothing(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (folder / "m.yaml").write_text(MAPPING)
    assert run(["import", str(folder / "m.yaml"), "--out", str(folder / "bag")]) == 0
    assert len(read_recording(folder / "bag").readings[0].stamps) == 3
    (folder / "cubes.csv").write_text(TABLE + "20240101120010;oops\n")
    assert run(["import", str(folder / "m.yaml"), "--out", str(folder / "other")]) == 2
    assert "line 5" in capfd.readouterr().err
    assert not (folder / "other").exists()


ENTRY: dict[str, Any] = {
    "files": "t.csv",
    "time": {"seconds": "t"},
    "joints": {"unit": "deg", "columns": {"a": "a"}},
    "point": {"frame": "tracker", "unit": "mm", "position": ["x", "y", "z"]},
}


def read(folder: Path, text: str, **changes: Any) -> Any:
    (folder / "t.csv").write_text(text)
    entry = {key: value for key, value in {**ENTRY, **changes}.items() if value is not None}
    return import_tables({"tables": [entry]}, folder, "m.yaml")


ROWS = "t,a,x,y,z\n1,10,1000,0,0\n2,20,nan,0,0\n3,30,1000,0,\n4,40,1000,0,7\n"


def test_rows_that_lack_something_are_skipped_and_counted_if_that_is_stated(tmp_path: Path) -> None:
    recording = read(tmp_path, ROWS, missing="skip")
    assert recording.readings[0].stamps.tolist() == [1.0, 4.0]
    assert recording.joints[0].stamps.tolist() == [1.0, 2.0, 3.0, 4.0]  # of the joints nothing is missing
    assert any("1 row was left out: no number in column x" in note for note in recording.warnings)
    with pytest.raises(BadTable, match="line 3, column x: no number; line 4, column z: no number"):
        read(tmp_path, ROWS)


def test_all_faulty_rows_stand_in_one_message(tmp_path: Path) -> None:
    text = "t,a,x,y,z\n1,oops,1,2,3\n2,10,1,2,3\n3,no,1,2,3\n4,10,1,two,3\n"
    with pytest.raises(BadTable) as caught:
        read(tmp_path, text, missing="skip")
    said = str(caught.value)
    assert said.startswith("t.csv: 3 faulty rows:")
    assert "line 2, column a: 'oops' is not a number (also line 4)" in said
    assert "line 5, column y: 'two' is not a number" in said


def test_preamble_units_row_blanks_and_encoding(tmp_path: Path) -> None:
    text = "Größe: 5\n\nt   a   x y z\ns deg mm mm mm\n 1   10  1000  0 0\n2  11\t1000 0    0\n"
    (tmp_path / "t.csv").write_text(text, encoding="utf-16")
    form = {"preamble_rows": 2, "units_rows": 1, "delimiter": " ", "encoding": "utf-16"}
    recording = import_tables({"tables": [{**ENTRY, **form}]}, tmp_path, "m")
    assert recording.joints[0].position[:, 0] == pytest.approx(np.radians([10.0, 11.0]))
    assert recording.readings[0].values[0] == pytest.approx([1.0, 0.0, 0.0])


def test_velocity_effort_commanded_and_signals_reach_the_bag(tmp_path: Path) -> None:
    text = "t,a,v,e,c,x,y,z,p\n1,10,90,5,10.5,1,2,3,7\n2,20,-90,6,20.5,1,2,3,\n"
    joints = {
        "unit": "deg",
        "columns": {"a": "a"},
        "velocity": {"unit": "deg/s", "columns": {"a": "v"}},
        "effort": {"columns": {"a": "e"}},
        "commanded": {"columns": {"a": "c"}},
    }
    write_recording(read(tmp_path, text, joints=joints, signals={"plc/pressure": "p"}), tmp_path / "bag")
    back = read_recording(tmp_path / "bag")
    (track,) = [t for t in back.joints if t.topic == "/joint_states"]
    assert track.velocity[:, 0] == pytest.approx([np.pi / 2, -np.pi / 2])
    assert track.effort[:, 0].tolist() == [5.0, 6.0]
    named = {signal.name: signal for signal in back.signals}
    assert named["signal:/plc/pressure"].values.tolist() == [[7.0]]
    (told,) = back.commands
    assert told.topic == "/joint_commands"
    assert told.position[:, 0] == pytest.approx(np.radians([10.5, 20.5]))


@pytest.mark.parametrize("by_rows", [True, False])
def test_matrices(by_rows: bool, tmp_path: Path) -> None:
    R = Rotation.random(3, random_state=1).as_matrix()
    flat = (R if by_rows else np.swapaxes(R, 1, 2)).reshape(3, 9)
    names = [f"r{k}" for k in range(9)]
    order = names if by_rows else [names[3 * (k % 3) + k // 3] for k in range(9)]
    rows = [f"{i},0,1,2,3," + ",".join(f"{v:.6f}" for v in flat[i]) for i in range(3)]
    pose = {**ENTRY["point"], "matrix": {"columns": order}}
    text = f"t,a,x,y,z,{','.join(names)}\n" + "\n".join(rows)
    reading = read(tmp_path, text, point=None, pose=pose).readings[0]
    assert np.abs(se3.from_pose(reading.values)[:, :3, :3] - R).max() < 3e-6
    with pytest.raises(BadTable, match="line 3, column r0: the nine numbers are not a rotation"):
        read(
            tmp_path, text.replace(f"{flat[1, 4]:.6f}", "5.0"), point=None, pose={**pose, "matrix": {"columns": names}}
        )


def test_a_quaternion_of_zeros_is_a_lost_reading_where_those_are_skipped(tmp_path: Path) -> None:
    text = "t,a,x,y,z,i,j,k,w\n1,0,1,2,3,0,0,0,1\n2,0,0,0,0,0,0,0,0\n"
    pose = {**ENTRY["point"], "quaternion": {"columns": ["i", "j", "k", "w"]}}
    assert len(read(tmp_path, text, point=None, pose=pose, missing="skip").readings[0].stamps) == 1
    with pytest.raises(BadTable, match="line 3, column i: a quaternion of zeros"):
        read(tmp_path, text, point=None, pose=pose)


def test_deviations_go_with_the_readings(tmp_path: Path) -> None:
    text = "t,a,x,y,z,s,r\n1,0,1,2,3,0.1,0.01\n2,0,1,2,4,0.2,0.02\n"
    point = {**ENTRY["point"], "std": {"position": "s"}}
    recording = read(tmp_path, text, point=point)
    write_recording(recording, tmp_path / "bag")
    (back,) = read_recording(tmp_path / "bag").readings
    assert back.kind == "point"
    assert back.stated[:, 0] == pytest.approx(np.sqrt(3.0) * np.array([1e-4, 2e-4]))


def test_ranges_bearings_planes(tmp_path: Path) -> None:
    text = "t,a,d,az,el,h\n1,0,1500,90,0,2\n2,0,1600,0,45,3\n"
    recording = read(
        tmp_path, text, point=None,
        range={"frame": "wire", "unit": "mm", "column": "d"},
        bearing={"frame": "station", "unit": "deg", "azimuth": "az", "elevation": "el"},
        plane=[{"frame": "plate", "unit": "mm", "column": "h"}, {"frame": "touched"}],
    )  # fmt: skip
    by_frame = {r.frame: r for r in recording.readings}
    assert (by_frame["wire"].kind, by_frame["wire"].values.tolist()) == ("range", [[1.5], [1.6]])
    assert by_frame["station"].values == pytest.approx(np.array([[0, 1, 0], [0.5**0.5, 0, 0.5**0.5]]), abs=1e-12)
    assert by_frame["plate"].values[:, 0] == pytest.approx([2e-3, 3e-3])
    assert by_frame["touched"].values.tolist() == [[0.0], [0.0]]
    write_recording(recording, tmp_path / "bag")
    assert {r.kind for r in read_recording(tmp_path / "bag").readings} == {"range", "bearing", "touch"}


def test_three_targets_on_one_tool_are_a_pose(tmp_path: Path) -> None:
    shape = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.15]])
    T = se3.transform(Rotation.random(5, random_state=2).as_matrix(), np.random.default_rng(1).normal(size=(5, 3)))
    points = np.einsum("nij,kj->nki", T[:, :3, :3], shape) + T[:, None, :3, 3]
    names = [f"{axis}{k}" for k in range(4) for axis in "xyz"]
    text = f"t,a,{','.join(names)}\n" + "\n".join(
        f"{i},0," + ",".join(f"{v:.9f}" for v in points[i].ravel()) for i in range(5)
    )
    stated = {"frame": "tracker", "unit": "m", "points": {str(k): [f"x{k}", f"y{k}", f"z{k}"] for k in range(4)}}
    found = se3.from_pose(read(tmp_path, text, point=None, targets=stated).readings[0].values)
    tool = se3.inverse(T) @ found  # the same transform in every row
    assert np.abs(tool - tool[0]).max() < 1e-7


@pytest.mark.parametrize(("by", "within"), [({"station": "nr"}, None), ({"t": "clock"}, 0.2)])
def test_files_joined_by_a_station_or_by_the_nearest_time(
    by: dict[str, str], within: float | None, tmp_path: Path
) -> None:
    (tmp_path / "robot.csv").write_text("nr;clock;a\n3;3,1;30,5\n1;1,1;10,5\n")
    joined: dict[str, Any] = {"files": "robot.csv", "delimiter": ";", "decimal": ",", "by": by}
    if within:
        joined["within"] = within
    recording = read(tmp_path, "station,t,x,y,z\n1,1,1,2,3\n2,2,1,2,3\n3,3,1,2,3\n", joined=[joined], missing="skip")
    assert recording.joints[0].position[:, 0] == pytest.approx(np.radians([10.5, 30.5]))
    assert recording.joints[0].stamps.tolist() == [1.0, 3.0]


def test_units_of_time_and_two_columns_of_a_date(tmp_path: Path) -> None:
    text = "t,d,h,a,x,y,z\n1700000000123,01.02.2024,12:00:00,0,1,2,3\n1700000000223,01.02.2024,12:00:05,0,1,2,3\n"
    stamps = read(tmp_path, text, time={"seconds": "t", "unit": "ms"}).joints[0].stamps
    assert stamps == pytest.approx([1700000000.123, 1700000000.223])
    dates = read(tmp_path, text, time={"column": ["d", "h"], "format": "%d.%m.%Y %H:%M:%S"}).joints[0].stamps
    assert dates.tolist() == [1706788800.0, 1706788805.0]


def test_joints_and_readings_in_tables_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "joints.csv").write_text("t,a\n0,1\n1,2\n2,3\n")
    (tmp_path / "tracker.csv").write_text("t,x,y,z\n0.5,1,2,3\n")
    joints = {"files": "joints.csv", "time": {"seconds": "t"}, "joints": ENTRY["joints"]}
    tracker = {"files": "tracker.csv", "time": {"seconds": "t"}, "point": ENTRY["point"]}
    recording = import_tables({"tables": [joints, tracker]}, tmp_path, "m")
    assert (len(recording.joints[0].stamps), len(recording.readings[0].stamps)) == (3, 1)


def test_examples_are_what_the_schema_says() -> None:
    for path in sorted((Path(__file__).parents[2] / "examples" / "import").glob("*.yaml")):
        data = yaml.safe_load(path.read_text())
        if "tables" in data:
            require_mapping(data, path.name)
