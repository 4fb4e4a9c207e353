"""What a table may hold besides joints and a pose, and what becomes of cells that are missing or wrong."""

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
from modcal_msgs_py.tables import import_tables, read_tables

ENTRY: dict[str, Any] = {
    "files": "t.csv",
    "time": {"seconds": "t"},
    "joints": {"unit": "deg", "columns": {"a": "a"}},
    "point": {"frame": "tracker", "unit": "mm", "position": ["x", "y", "z"]},
}


def read(folder: Path, text: str, **changes: Any) -> Any:
    (folder / "t.csv").write_text(text)
    entry = {key: value for key, value in {**ENTRY, **changes}.items() if value is not None}
    return read_tables({"tables": [entry]}, folder, "m.yaml")


ROWS = "t,a,x,y,z\n1,10,1000,0,0\n2,20,nan,0,0\n3,30,1000,0,\n4,40,1000,0,7\n"


def test_rows_that_lack_something_are_skipped_and_counted_if_that_is_stated(tmp_path: Path) -> None:
    recording = read(tmp_path, ROWS, missing="skip").recording
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
    tables = read(tmp_path, text, joints=joints, signals={"plc/pressure": "p"})
    write_recording(tables.recording, tmp_path / "bag", commanded=tables.commanded)
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
    reading = read(tmp_path, text, point=None, pose=pose).recording.readings[0]
    assert np.abs(se3.from_pose(reading.values)[:, :3, :3] - R).max() < 3e-6
    with pytest.raises(BadTable, match="line 3, column r0: the nine numbers are not a rotation"):
        read(
            tmp_path, text.replace(f"{flat[1, 4]:.6f}", "5.0"), point=None, pose={**pose, "matrix": {"columns": names}}
        )


def test_a_quaternion_of_zeros_is_a_lost_reading_where_those_are_skipped(tmp_path: Path) -> None:
    text = "t,a,x,y,z,i,j,k,w\n1,0,1,2,3,0,0,0,1\n2,0,0,0,0,0,0,0,0\n"
    pose = {**ENTRY["point"], "quaternion": {"columns": ["i", "j", "k", "w"]}}
    assert len(read(tmp_path, text, point=None, pose=pose, missing="skip").recording.readings[0].stamps) == 1
    with pytest.raises(BadTable, match="line 3, column i: a quaternion of zeros"):
        read(tmp_path, text, point=None, pose=pose)


def test_deviations_go_with_the_readings(tmp_path: Path) -> None:
    text = "t,a,x,y,z,s,r\n1,0,1,2,3,0.1,0.01\n2,0,1,2,4,0.2,0.02\n"
    point = {**ENTRY["point"], "std": {"position": "s"}}
    recording = read(tmp_path, text, point=point).recording
    write_recording(recording, tmp_path / "bag")
    (back,) = read_recording(tmp_path / "bag").readings
    assert back.kind == "point"
    assert back.stated is not None
    assert back.stated[:, 0] == pytest.approx(np.sqrt(3.0) * np.array([1e-4, 2e-4]))


def test_ranges_bearings_planes(tmp_path: Path) -> None:
    text = "t,a,d,az,el,h\n1,0,1500,90,0,2\n2,0,1600,0,45,3\n"
    recording = read(
        tmp_path, text, point=None,
        range={"frame": "wire", "unit": "mm", "column": "d"},
        bearing={"frame": "station", "unit": "deg", "azimuth": "az", "elevation": "el"},
        plane=[{"frame": "plate", "unit": "mm", "column": "h"}, {"frame": "touched"}],
    ).recording  # fmt: skip
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
    found = se3.from_pose(read(tmp_path, text, point=None, targets=stated).recording.readings[0].values)
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
    recording = read(
        tmp_path, "station,t,x,y,z\n1,1,1,2,3\n2,2,1,2,3\n3,3,1,2,3\n", joined=[joined], missing="skip"
    ).recording
    assert recording.joints[0].position[:, 0] == pytest.approx(np.radians([10.5, 30.5]))
    assert recording.joints[0].stamps.tolist() == [1.0, 3.0]


def test_units_of_time_and_two_columns_of_a_date(tmp_path: Path) -> None:
    text = "t,d,h,a,x,y,z\n1700000000123,01.02.2024,12:00:00,0,1,2,3\n1700000000223,01.02.2024,12:00:05,0,1,2,3\n"
    stamps = read(tmp_path, text, time={"seconds": "t", "unit": "ms"}).recording.joints[0].stamps
    assert stamps == pytest.approx([1700000000.123, 1700000000.223])
    dates = read(tmp_path, text, time={"column": ["d", "h"], "format": "%d.%m.%Y %H:%M:%S"}).recording.joints[0].stamps
    assert dates.tolist() == [1706788800.0, 1706788805.0]


def test_joints_and_readings_in_tables_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "joints.csv").write_text("t,a\n0,1\n1,2\n2,3\n")
    (tmp_path / "tracker.csv").write_text("t,x,y,z\n0.5,1,2,3\n")
    joints = {"files": "joints.csv", "time": {"seconds": "t"}, "joints": ENTRY["joints"]}
    tracker = {"files": "tracker.csv", "time": {"seconds": "t"}, "point": ENTRY["point"]}
    recording = import_tables({"tables": [joints, tracker]}, tmp_path, "m")
    assert (len(recording.joints[0].stamps), len(recording.readings[0].stamps)) == (3, 1)


def test_what_was_not_decided_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadTable, match="undecided: mm or m: correct what is below it, and remove the line"):
        import_tables({"undecided": ["mm or m"], "tables": [ENTRY]}, tmp_path, "m")


def test_examples_are_what_the_schema_says() -> None:
    from modcal_msgs_py.tables.convert import require_mapping

    for path in sorted((Path(__file__).parents[2] / "examples" / "import").glob("*.yaml")):
        data = yaml.safe_load(path.read_text())
        if "tables" in data:
            require_mapping(data, path.name)
