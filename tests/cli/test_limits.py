"""``modcal limits``: bounds of a URDF or a bag, in the terminal and as files, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli.conftest import Refused
from cli.recordings import stations
from robots.random_arms import Mujoco

from modcal_core.robots.acceleration import read_drives
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

ROOT = Path(__file__).resolve().parents[2]
URDF = ROOT / "examples" / "robots" / "ur10.urdf"
EFFORT = np.array([330.0, 330.0, 150.0, 54.0, 54.0, 54.0])


def test_one_posture(capfd: pytest.CaptureFixture[str]) -> None:
    """By MuJoCo: the inertias are the matrix's diagonal, and the drives are within their limits at the bounds."""
    assert run(["limits", str(URDF), "--at", "elbow_joint=1.2", "--at", "shoulder_lift_joint=-1", "--json"]) == 0
    data = json.loads(capfd.readouterr().out)
    assert data["modcal_limits"] == 1
    assert data["postures"] == 1
    joints = data["joints"]
    chain = read_chain(URDF.read_text())
    assert [j["name"] for j in joints] == list(chain.names)
    truth = Mujoco(URDF.read_text(), chain)
    q = np.array([0.0, -1.0, 1.2, 0.0, 0.0, 0.0])
    assert np.allclose([j["inertia"]["most"] for j in joints], np.diag(truth.matrix(q)), atol=1e-10)
    held = np.abs(truth.torque(q, 0 * q, 0 * q)) / EFFORT
    assert np.allclose([j["load_share"] for j in joints], held, atol=1e-10)
    for side in ("lower", "upper"):
        a = np.array([j["coupled"][side] for j in joints])
        assert (np.abs(truth.torque(q, 0 * q, a)) <= EFFORT * (1 + 1e-9)).all()
        assert [j["constant"][side] for j in joints] == pytest.approx(a, rel=1e-6)


def test_a_workspace_and_its_files(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "limits"
    arguments = ["--payload", "3", "--centre", "0", "0", "0.1", "--workspace", "60", "--rotor", "wrist_3_joint=0.1"]
    assert run(["limits", str(URDF), *arguments, "--out", str(out)]) == 0
    shown = capfd.readouterr().out
    assert "60 postures" in shown
    assert "wrist_3_joint" in shown
    assert {p.name for p in out.iterdir()} == {"limits.json", "joint_limits.yaml", "report.html"}
    data = json.loads((out / "limits.json").read_text())
    planner = yaml.safe_load((out / "joint_limits.yaml").read_text())["joint_limits"]
    for joint in data["joints"]:
        constant = joint["constant"]
        assert planner[joint["name"]]["max_acceleration"] == pytest.approx(min(-constant["lower"], constant["upper"]))
        assert planner[joint["name"]]["has_acceleration_limits"] is True
        assert joint["inertia"]["least"] <= joint["inertia"]["most"]
    wrist = data["joints"][-1]
    assert wrist["equivalent"]["upper"] < 54.0 / 0.1  # the rotor counts


def test_the_fastest_motion_along_a_path(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """By MuJoCo: it goes through the postures from rest to rest, and takes all of a drive's share but no more."""
    chain = read_chain(URDF.read_text())
    stops = np.array(
        [[0.0, -1.2, 1.6, -1.9, -1.57, 0.0], [0.6, -1.0, 1.2, -1.8, -1.57, 0.0], [1.2, -1.2, 1.6, -1.9, -1.57, 0.0]]
    )
    path = tmp_path / "path.csv"
    path.write_text("\n".join([",".join(chain.names), *(",".join(map(str, row)) for row in stops.tolist())]))
    out = tmp_path / "out"
    arguments = ["limits", str(URDF), "--path", str(path), "--share", "0.9", "--out", str(out), "--json"]
    assert run(arguments) == 0
    data = json.loads(capfd.readouterr().out)
    rows = np.loadtxt(out / "trajectory.csv", delimiter=",", skiprows=1)
    t, q, v = rows[:, 0], rows[:, 1:7], rows[:, 7:]
    assert t[-1] == pytest.approx(data["fastest_s"])
    assert np.abs(v[[0, -1]]).max() < 1e-6
    assert all(np.abs(q - stop).max(axis=1).min() < 0.01 for stop in stops)
    truth, a = Mujoco(URDF.read_text(), chain), np.gradient(v, t, axis=0)
    used = np.array([np.abs(truth.torque(*row)) / EFFORT for row in zip(q, v, a, strict=True)])[2:-2].max(axis=1)
    assert np.quantile(used, 0.95) < 0.93
    at_speed = np.abs(v) / read_drives(URDF.read_text(), chain).speed
    assert np.median(np.maximum(used, at_speed[2:-2].max(axis=1))) > 0.85
    assert run([*arguments, "--at", "elbow_joint=1"]) == 2


def test_a_bag(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    recording = stations(30)
    write_recording(recording, tmp_path / "bag")
    assert run(["limits", str(tmp_path / "bag"), "--payload", "2", "--json"]) == 0
    data = json.loads(capfd.readouterr().out)
    assert data["postures"] == 30
    truth = Mujoco(URDF.read_text(), read_chain(URDF.read_text()))
    most = np.max([np.diag(truth.matrix(q)) for q in recording.joints[0].position], axis=0)
    assert (np.array([j["inertia"]["most"] for j in data["joints"]]) > most).all()  # and the payload
    assert "30 of 30 joint states report no velocity" in data["notes"][-1]


def test_what_a_bag_does_not_say_is_counted(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    recording = stations(30)
    (track,) = recording.joints
    q = track.position.copy()
    q[3, 1] = np.nan
    moving = replace(track, position=q, velocity=np.zeros_like(q))
    write_recording(replace(recording, joints=(moving,)), tmp_path / "bag")
    assert run(["limits", str(tmp_path / "bag")]) == 0
    said = " ".join(capfd.readouterr().out.split())
    assert "1 of 30" in said
    assert "left out" in said
    assert "no velocity" not in said


def test_states_that_are_faster_than_the_arm_can_be_are_left_out(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """As of a simulation that jumps from posture to posture; where no others are left, the bag is refused."""
    recording = stations(30)
    (track,) = recording.joints
    chain = read_chain(URDF.read_text())
    fastest = read_drives(URDF.read_text(), chain).speed
    for rows, code in ((slice(0, 12), 0), (slice(None), 2)):
        speed = np.zeros_like(track.position)
        speed[rows, 2] = -4.0 * fastest[2]
        bag = tmp_path / f"bag{code}"
        write_recording(replace(recording, joints=(replace(track, velocity=speed),)), bag)
        assert run(["limits", str(bag), "--payload", "2", "--json"]) == code
        told = capfd.readouterr()
        said = f"{chain.names[2]} reaches {4.0 * fastest[2]:.3g} rad/s, {fastest[2]:.3g} is its limit"
        if code:
            assert f"all move faster than the URDF allows: {said}" in told.err
        else:
            data = json.loads(told.out)
            assert data["postures"] == 18
            assert f"12 of 30 joint states move faster than the URDF allows ({said})" in " ".join(data["notes"])


CASES = {
    "payload that the posture cannot hold": (["--payload", "60"], "joint elbow_joint: gravity, friction and speed need .* of the 150 N m"),
    "payload of less than nothing": (["--payload", "-1"], "payload: mass: -1 kg is not 0 or more"),
    "payload inertia of no body": (["--payload", "1", "--inertia", "1", "1", "3", "0", "0", "0"], "payload: inertia: .* is not physical"),
    "joint that is not there": (["--at", "elbow=1"], "--at elbow: is not a joint of this arm: name one of shoulder_pan_joint"),
    "joint beyond its limits": (["--at", "elbow_joint=9"], "--at elbow_joint: 9 is outside its limits, -3.14159 to 3.14159"),
    "joint without a number": (["--at", "elbow_joint"], "--at elbow_joint: is not JOINT=NUMBER"),
    "share of the torque above 1": (["--share", "1.5"], "share of the torque: 1.5 is not above 0 and at most 1"),
    "torque of 0": (["--torque", "elbow_joint=0"], "torque of joint elbow_joint: is 0, not a number above 0"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_what_is_refused(case: str, tmp_path: Path, refused: Refused) -> None:
    arguments, said = CASES[case]
    refused(["limits", str(URDF), *arguments, "--out", str(tmp_path / "out")], said)


def test_a_description_without_efforts_or_masses(tmp_path: Path, refused: Refused) -> None:
    bare = tmp_path / "bare.urdf"
    bare.write_text(URDF.read_text().replace('effort="150"', 'effort="0"'))
    refused(["limits", str(bare)], "drive of joint elbow_joint: the robot description states no effort")
    assert run(["limits", str(bare), "--torque", "elbow_joint=150", "--json"]) == 0
    recording = stations(5)
    write_recording(replace(recording, robot_description=None), tmp_path / "bag")
    refused(["limits", str(tmp_path / "bag")], "holds no robot_description")
    write_recording(recording, tmp_path / "whole")
    refused(["limits", str(tmp_path / "whole"), "--at", "elbow_joint=1"], "and the postures of")
