"""Tables into bags: what is stated is done, what is not stated is an error with its place."""

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
from modcal_msgs_py.tables import import_tables
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
        ({"pose": {"frame": "t", "unit": "mm", "position": ["x", "y", "z"]}}, "angle convention is not stated"),
        (
            {
                "pose": None,
                "point": {"frame": "t", "unit": "m", **{k: ["x", "y", "z"] for k in ("position", "plus", "minus")}},
            },
            "point: plus and minus are both stated",
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
