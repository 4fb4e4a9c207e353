"""``modcal limits`` and ``modcal payload``: bounds, and what MuJoCo's arms carry, in the terminal and as files; refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli.conftest import Refused
from cli.recordings import stations
from robots.random_arms import Mujoco, inertial_link

from modcal_core.errors import BadRecording
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import JointTrack, Recording
from modcal_core.robots.acceleration import read_drives
from modcal_core.robots.bodies import Payload, Stands, weigh
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
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


ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
ARMS = ("ur10", "xarm7")


def loaded(text: str, chain: Chain, mass: float, centre: Array) -> str:
    """The description with one more link, bolted to the tip."""
    link = inertial_link("load", mass, centre, (0.0, 0.0, 0.0), (0.01, 0.01, 0.01, 0.0, 0.0, 0.0))
    bolt = f'<joint name="bolt" type="fixed"><parent link="{chain.tip}"/><child link="load"/></joint>'
    return text.replace("</robot>", link + bolt + "</robot>")


class Drives:
    """Torque constants that are off by 5 %, dry friction that holds a part of the torque at rest, and noise."""

    def __init__(self, joints: int, rng: np.random.Generator) -> None:
        self.factor = 1.0 + 0.05 * rng.standard_normal(joints)
        self.friction, self.rng = rng.uniform(0.2, 2.0, joints), rng

    def reported(self, truth: Mujoco, q: Array, side: Array) -> Array:
        held = np.array([truth.torque(x, 0.0 * x, 0.0 * x) for x in q])
        held += self.friction * side * self.rng.uniform(0.5, 1.0, q.shape)
        return (held + self.rng.normal(0.0, 0.05, q.shape)) / self.factor


def drawn(arm: str, seed: int) -> tuple[str, Chain, float, Array, Drives, np.random.Generator]:
    rng = np.random.default_rng(seed)
    text = (ROBOTS / f"{arm}.urdf").read_text()
    chain = read_chain(text)
    return text, chain, float(rng.uniform(0.5, 5.0)), rng.normal(0.0, 0.06, 3), Drives(chain.n, rng), rng


def postures(chain: Chain, count: int, rng: np.random.Generator) -> Array:
    return rng.uniform(np.maximum(chain.lower, -2.0), np.minimum(chain.upper, 2.0), (count, chain.n))


@pytest.mark.parametrize("arm", ARMS)
def test_payloads_lie_within_what_is_stated(arm: str) -> None:
    """Ten of each arm, alone and beside a recording without the payload: as sure as is stated."""
    off = []
    for seed in range(10):
        text, chain, mass, centre, drives, rng = drawn(arm, seed)
        stands = []
        for full, text_of in ((True, loaded(text, chain, mass, centre)), (False, text)):
            q = postures(chain, 15, rng)
            side = np.sign(rng.standard_normal(q.shape))
            stands.append(Stands(q, drives.reported(Mujoco(text_of, chain), q, side), side, full))
        for used in (stands, stands[:1]):
            found = weigh(chain, read_inertias(text, chain), used)
            off.append(np.r_[found.mass - mass, found.centre - centre] / found.std)
            if used is stands:
                assert found.std[0] < 0.1 * mass
    assert np.abs(off).max() < 4.0
    assert np.mean(np.abs(off) > 3.0) < 0.02
    assert np.sqrt(np.mean(np.square(off[::2]))) > 0.3


@pytest.mark.parametrize("arm", ARMS)
def test_efforts_that_hold_no_such_arm_are_refused(arm: str) -> None:
    """Currents in place of torques, torques of the other sign, one joint of the other sign; alone and beside a bag."""
    text, chain, mass, centre, drives, rng = drawn(arm, 1)
    one = np.where(np.arange(chain.n) == 1, -1.0, 1.0)
    stands = []
    for full, text_of in ((True, loaded(text, chain, mass, centre)), (False, text)):
        q = postures(chain, 15, rng)
        side = np.sign(rng.standard_normal(q.shape))
        stands.append(Stands(q, drives.reported(Mujoco(text_of, chain), q, side), side, full))
    for factor in (0.1, -1.0, one):
        for used in (stands, stands[:1]):
            told = [Stands(s.q, factor * s.effort, s.side, s.loaded) for s in used]
            with pytest.raises(
                BadRecording, match="holds the links of the robot description|check their sign and unit"
            ):
                weigh(chain, read_inertias(text, chain), told)


def recorded(text: str, chain: Chain, truth: Mujoco, drives: Drives | None, rng: np.random.Generator) -> Recording:
    """Joint states at 50 Hz of an arm that goes from posture to posture and stands for a second in each."""
    stops = postures(chain, 14, rng)
    ramp = np.linspace(0.0, 1.0, 50)[:, None]
    parts = [stops[:1].repeat(50, axis=0)]
    for a, b in pairwise(stops):
        parts += [a + ramp * (b - a), b[None].repeat(60, axis=0)]
    q = np.concatenate(parts)
    side = np.sign(np.diff(q, axis=0, prepend=q[:1]))
    for k in range(1, len(q)):
        side[k] = np.where(side[k] == 0.0, side[k - 1], side[k])
    efforts = np.full_like(q, np.nan) if drives is None else drives.reported(truth, q, side)
    t = 1.7e9 + 0.02 * np.arange(len(q))
    return Recording((JointTrack(chain.names, t, q, np.full_like(q, np.nan), efforts, t),), robot_description=text)


def test_two_bags(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    text, chain, mass, centre, drives, rng = drawn("ur10", 3)
    write_recording(
        recorded(text, chain, Mujoco(loaded(text, chain, mass, centre), chain), drives, rng), tmp_path / "a"
    )
    write_recording(recorded(text, chain, Mujoco(text, chain), drives, rng), tmp_path / "b")
    assert run(["payload", str(tmp_path / "a"), "--without", str(tmp_path / "b"), "--json"]) == 0
    data = json.loads(capfd.readouterr().out)
    assert data["mass_kg"] == pytest.approx(mass, abs=3.0 * data["mass_std_kg"])
    assert (np.abs(data["centre_m"] - centre) < 3.0 * np.array(data["centre_std_m"])).all()
    assert Payload.checked(data["mass_kg"], data["centre_m"]).mass < 1.1 * mass
    assert run(["payload", str(tmp_path / "b")]) == 0
    assert "cannot be told from nothing" in capfd.readouterr().out


def test_payloads_that_are_refused(tmp_path: Path, refused: Refused) -> None:
    text, chain, _, _, _, rng = drawn("ur10", 0)
    silent = recorded(text, chain, Mujoco(text, chain), None, rng)
    write_recording(silent, tmp_path / "silent")
    refused(["payload", str(tmp_path / "silent")], "joint states: report no effort")
    track = silent.joints[0]
    rows = slice(0, 300)
    few = JointTrack(
        track.names, *(x[rows] for x in (track.stamps, track.position, track.velocity, track.position, track.received))
    )
    write_recording(Recording((few,), robot_description=text), tmp_path / "few")
    refused(["payload", str(tmp_path / "few")], "3 postures at rest with the payload, 6 are needed")
