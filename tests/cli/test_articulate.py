"""``modcal articulate``: from bags, joints and plain text to a joint that others can read."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from articulation.objects import Seen, ideal, noisy
from cells import joint_track
from cli.conftest import Refused
from cli.recordings import URDF

from modcal_core.articulation.urdf import frames, read
from modcal_core.geometry import se3, so3
from modcal_core.measurements.recording import ReadingTrack, Recording
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.mechanism import inverse
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.recording_write import write_recording
from modcal_msgs_py.tables.moments import read_track
from modcal_nodes.cli.main import run


def door(kind: str = "revolute", count: int = 80) -> Seen:
    rng = np.random.default_rng(5)
    a = np.linspace(0.0, 0.4 if kind == "prismatic" else 1.2, count)
    return noisy(ideal(kind, a, rng, 0.4), rng, 1e-3, 5e-3)


def poses(seen: Seen) -> np.ndarray:
    return se3.to_pose(se3.transform(seen.rotations, seen.positions))


def told(folder: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((folder / "articulation.json").read_text())
    return data


@pytest.mark.slow
def test_a_door_in_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seen, stamps = door(), 1.7e9 + 0.05 * np.arange(80)
    write_recording(
        Recording(readings=(ReadingTrack("pose", "camera", stamps, poses(seen), stamps),)), tmp_path / "bag"
    )
    assert run(["articulate", str(tmp_path / "bag"), "--out", str(tmp_path / "out")]) == 0
    assert "turned 6" in capsys.readouterr().out
    data = told(tmp_path / "out")
    assert (data["kind"], data["enough"], data["measurement"], data["frame"]) == ("revolute", True, "pose", "camera")
    assert data["joint"]["radius"] == pytest.approx(0.4, abs=0.005)
    assert data["probabilities"]["revolute"] > 0.9
    text = (tmp_path / "out" / "object.urdf").read_text()
    assert frames(text) == ("camera", "object_handle")
    assert abs(read(text).axis @ seen.axis) == pytest.approx(1.0, abs=1e-4)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "<svg" in page
    assert "src=" not in page


@pytest.mark.slow
@pytest.mark.parametrize(("columns", "separator"), [(7, ";"), (3, ", ")])
def test_a_drawer_in_a_text_file(columns: int, separator: str, tmp_path: Path) -> None:
    lines = [separator.join(f"{v:.9f}" for v in row[:columns]) for row in poses(door("prismatic"))]
    (tmp_path / "track.log").write_text("# seen by hand\n" + "\n".join(lines) + "\n\n")
    assert run(["articulate", str(tmp_path / "track.log"), "--out", str(tmp_path / "out")]) == 0
    data = told(tmp_path / "out")
    assert data["kind"] == "prismatic"
    assert data["measurement"] == ("point" if columns == 3 else "pose")
    assert data["configuration"]["upper"] - data["configuration"]["lower"] == pytest.approx(0.4, abs=0.01)


@pytest.mark.parametrize(
    ("head", "form"),
    [
        ("", "{t} {x} {y} {z} {qx} {qy} {qz} {qw}"),
        ("time,x,y,z,qx,qy,qz,qw", "{t},{x},{y},{z},{qx},{qy},{qz},{qw}"),
        ("Frame;Time (ms);Handle qw;Handle qx;Handle qy;Handle qz;Handle X [mm];Handle Y [mm];Handle Z [mm]",
         "{n};{ms};{qw};{qx};{qy};{qz};{mx};{my};{mz}"),
    ],
)  # fmt: skip
def test_a_table_of_a_handle_is_read_by_its_labels(head: str, form: str, tmp_path: Path) -> None:
    true = poses(door())
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    rows = [head] * bool(head)
    for n, pose in enumerate(true):
        cells = {name: f"{value:.9f}" for name, value in zip(names, pose, strict=True)}
        cells |= {f"m{name}": f"{1e3 * float(cells[name]):.6f}" for name in "xyz"}
        rows.append(form.format(n=n, t=f"{1.7e9 + 0.05 * n:.2f}", ms=50 * n, **cells))
    (tmp_path / "track.csv").write_text("\n".join(rows) + "\n")
    track = read_track(tmp_path / "track.csv")
    np.testing.assert_allclose(track.values, true, atol=1e-8)
    assert track.stamps is not None
    np.testing.assert_allclose(np.diff(track.stamps), 0.05, atol=1e-6)


def test_columns_of_angles_are_said_not_to_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [",".join(f"{v:.9f}" for v in pose[:3]) + f",0,0,{n}" for n, pose in enumerate(poses(door()))]
    (tmp_path / "track.csv").write_text("x,y,z,roll,pitch,yaw\n" + "\n".join(rows) + "\n")
    assert run(["articulate", str(tmp_path / "track.csv"), "--out", str(tmp_path / "out")]) == 0
    assert "Columns roll, pitch, yaw are not read" in capsys.readouterr().out
    assert told(tmp_path / "out")["measurement"] == "point"


def test_rows_in_which_a_tracker_saw_nothing_are_left_out_and_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [f"{n}," + ",".join(f"{v:.9f}" for v in pose[:3]) for n, pose in enumerate(poses(door()))]
    rows[3], rows[40] = "3,,,", "40,nan,nan,nan"
    (tmp_path / "track.csv").write_text("frame,x,y,z\n" + "\n".join(rows) + "\n")
    assert run(["articulate", str(tmp_path / "track.csv"), "--out", str(tmp_path / "out")]) == 0
    assert "2 of 80 rows hold no reading and are left out" in capsys.readouterr().out
    assert told(tmp_path / "out")["kind"] == "revolute"


@pytest.mark.slow
def test_an_arm_alone_and_a_tracker_see_the_same_object(tmp_path: Path) -> None:
    """An arm that holds a door by its encoders, and a camera that stands elsewhere and sees the hand, in one bag."""
    text, rng = URDF.read_text(), np.random.default_rng(8)
    chain = read_chain(text)
    q = np.array([0.0, -1.2, 1.9, -0.7, -1.57, 0.0])
    first = chain_forward(chain, q[None])[0]
    axis, hinge = np.array([0.0, 0.0, 1.0]), first[:3, 3] + [0.05, 0.34, 0.0]
    twist = np.concatenate([np.cross(hinge, axis), axis])
    held = se3.exp(np.linspace(0.0, -0.9, 60)[:, None] * twist) @ first
    path = []
    for T in held:
        q = inverse(chain, T, q, restarts=0)
        path.append(q)
    camera = se3.transform(so3.exp([0.4, -1.1, 2.0]), np.array([0.3, 1.2, 0.8]))  # the base in the camera
    seen = camera @ held
    seen[:, :3, 3] += rng.normal(0.0, 3e-4, (60, 3))
    t = 1.7e9 + 0.05 * np.arange(60)
    joints = (joint_track(chain.names, t, np.array(path)),)
    readings = (ReadingTrack("pose", "camera", t, se3.to_pose(seen), t),)
    write_recording(Recording(joints=joints, readings=readings, robot_description=text), tmp_path / "bag")
    found = {}
    for name, more in (("camera", []), ("arm", ["--topic", "joint_states"])):
        assert run(["articulate", str(tmp_path / "bag"), "--out", str(tmp_path / name), *more]) == 0
        found[name] = told(tmp_path / name)
    arm, cam = found["arm"], found["camera"]
    assert (arm["frame"], cam["frame"]) == (chain.base, "camera")
    assert arm["kind"] == cam["kind"] == "revolute"
    assert arm["enough"]
    assert cam["enough"]
    assert arm["joint"]["radius"] == pytest.approx(float(np.hypot(0.05, 0.34)), abs=1e-4)
    assert cam["joint"]["radius"] == pytest.approx(arm["joint"]["radius"], abs=2e-3)
    along = camera[:3, :3] @ np.array(arm["joint"]["axis"])
    assert abs(along @ np.array(cam["joint"]["axis"])) == pytest.approx(1.0, abs=1e-4)
    apart = camera[:3, :3] @ np.array(arm["joint"]["point"]) + camera[:3, 3] - np.array(cam["joint"]["point"])
    assert np.linalg.norm(apart - along * (along @ apart)) < 3e-3
    turned = [abs(one["configuration"]["upper"] - one["configuration"]["lower"]) for one in (arm, cam)]
    assert turned == pytest.approx([0.9, 0.9], abs=0.01)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no numbers"),
        ("1 2 3\n1 2\n", "changed from 3 to 2 at row 2"),
        ("0 0 0 10 0 5\n" * 9, "has 6 numbers in a row"),
        ("".join(f"{-x} 0 0 1\n" for x in range(30)), "has 4 numbers in a row, and the first is no time: it goes back"),
        ("time,u,v\n" + "1,2,3\n" * 9, "no columns x, y and z by its labels"),
        ("x,y,z,x,y,z\n" + "1,2,3,4,5,6\n" * 9, "has two columns labelled x"),
        ("a x,a y,a z,b x,b y,b z\n" + "1,2,3,4,5,6\n" * 9, "has 2 positions by its labels (a x, b x)"),
        ("n,x,y,z\n" + "1,1,2,3\n" * 6 + "0,,,\n" * 9, "9 of 15 rows without all numbers"),
        ("a b c\n", "is not numbers"),
        ("nan 0 0\n" * 9, "is not finite"),
        ("0 0 0\n" * 3, "4 are needed"),
        ("400 0 0\n" * 9, "not millimetres"),
        ("".join(f"{x} 0 0\n" for x in range(30)), "not centimetres"),
        ("0 0 0 0 0 0 3\n" * 9, "unit quaternions"),
    ],
)
def test_unusable_text_is_refused_in_one_line(text: str, words: str, tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "track.txt").write_text(text)
    refused(["articulate", str(tmp_path / "track.txt"), "--out", str(tmp_path / "out")], re.escape(words))


def test_quaternions_in_another_order_are_refused_by_name(tmp_path: Path, refused: Refused) -> None:
    """Of a plain door, and of the same door where they are as they should be."""
    seen = poses(door())
    for name, order in (("wxyz", [0, 1, 2, 6, 3, 4, 5]), ("xyzw", list(range(7)))):
        np.savetxt(tmp_path / f"{name}.txt", seen[:, order])
    arguments = ["articulate", str(tmp_path / "wxyz.txt"), "--out", str(tmp_path / "out")]
    refused(arguments, "read as w x y z a revolute one: give x y z w")
    assert run(["articulate", str(tmp_path / "xyzw.txt"), "--out", str(tmp_path / "out")]) == 0
    assert told(tmp_path / "out")["kind"] == "revolute"


def test_rotations_that_follow_nothing_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seen = poses(door())
    seen[:, 3:] = seen[0, 3:]
    np.savetxt(tmp_path / "track.txt", seen)
    assert run(["articulate", str(tmp_path / "track.txt"), "--out", str(tmp_path / "out")]) == 0
    assert "By positions alone: the measured rotations do not follow it" in capsys.readouterr().out
    assert told(tmp_path / "out")["kind"] == "revolute"


def test_a_topic_that_is_not_there_is_refused(tmp_path: Path, refused: Refused) -> None:
    stamps = 1.7e9 + 0.05 * np.arange(80)
    write_recording(
        Recording(readings=(ReadingTrack("pose", "camera", stamps, poses(door()), stamps),)), tmp_path / "bag"
    )
    refused(["articulate", str(tmp_path / "bag"), "--topic", "handle"], "use /tracker/pose")


def test_nothing_moved_is_an_answer(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    np.savetxt(tmp_path / "still.txt", 0.3 + 3e-4 * rng.standard_normal((50, 3)))
    assert run(["articulate", str(tmp_path / "still.txt"), "--out", str(tmp_path / "out")]) == 0
    assert told(tmp_path / "out")["kind"] == "rigid"
    assert read((tmp_path / "out" / "object.urdf").read_text()).kind == "rigid"
