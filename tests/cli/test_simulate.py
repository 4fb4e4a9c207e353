"""``modcal simulate``: a bag that says what the node would say, and what happens in it at the moment it was told to."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from cli.conftest import Refused

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import Recording
from modcal_core.preprocess import prepare
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_msgs_py.mcap_read import read_recording
from modcal_nodes.cli.main import run
from modcal_nodes.io.inputs import read_delta
from modcal_nodes.simulation.plant import make_world

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
URDF = ROBOTS / "ur10.urdf"
CHAIN = read_chain(URDF.read_text())


def simulated(folder: Path, *options: str, robot: Path = URDF) -> Recording:
    few = ("-p", "stations=8", "-p", "joint_rate_hz=50", "-p", "tracker_rate_hz=25")
    assert run(["simulate", str(robot), "--out", str(folder / "bag"), *few, *options]) == 0
    return read_recording(folder / "bag")


def still(recording: Recording) -> tuple[Array, Array, Array]:
    """(stamps (k,), postures (k, n), readings (k, 4, 4)) in the dwells."""
    samples = prepare(recording, CHAIN).samples
    return samples.stamps, samples.q, se3.transform(samples.R, samples.reading)


def test_it_says_what_the_true_cell_of_that_seed_shows(tmp_path: Path) -> None:
    recording = simulated(tmp_path, "-p", "seed=7", "-p", "joint_compliance_rad_per_nm=2e-6", "-p", "payload_kg=3")
    world = make_world(CHAIN, np.random.default_rng(7), 5e-4, 1e-3, read_inertias(URDF.read_text(), CHAIN), 2e-6)
    world.carry(3.0)
    _, q, T = still(recording)
    assert len(q) == 8
    off = se3.log(se3.inverse(world.tool_in_tracker(q)) @ T)
    assert np.abs(off[:, :3]).max() < 5.0 * 2e-5
    # and that is not what the drawing says: neither in form nor in how it gives way
    nominal = chain_forward(CHAIN, q)
    assert np.abs(np.diff(T[:, 0, 3]) - np.diff(nominal[:, 0, 3])).max() > 1e-3
    assert recording.robot_description == URDF.read_text()


def test_another_visit_finds_the_same_cell(tmp_path: Path) -> None:
    world = make_world(CHAIN, np.random.default_rng(1), 5e-4, 1e-3)
    seen = []
    for visit in ("0", "1"):
        (tmp_path / visit).mkdir()
        _, q, T = still(simulated(tmp_path / visit, "-p", f"visit={visit}"))
        off = se3.log(se3.inverse(world.tool_in_tracker(q)) @ T)
        assert np.abs(off[:, :3]).max() < 5.0 * 2e-5
        seen.append((q, off))
    assert np.abs(seen[0][0] - seen[1][0]).max() > 0.1
    assert not np.array_equal(seen[0][1], seen[1][1])


def test_what_happens_happens_then(tmp_path: Path) -> None:
    bump = (3e-3, 0.0, -4e-3)
    recording = simulated(tmp_path, "--at", "5", f"tool_bump_m={list(bump)}", "-p", "clock_start_s=2000")
    world = make_world(CHAIN, np.random.default_rng(1), 5e-4, 1e-3)
    stamps, q, T = still(recording)
    moved = np.linalg.norm((se3.inverse(world.tool_in_tracker(q)) @ T)[:, :3, 3], axis=1)
    before = stamps < 2005.0
    assert 0 < before.sum() < len(stamps)
    assert moved[before].max() < 1e-4
    assert np.allclose(moved[~before], 5e-3, atol=1e-4)


def test_a_link_warms_up_and_its_thermometer_says_so(tmp_path: Path) -> None:
    recording = simulated(tmp_path, "-p", "warm_up_link=forearm_link", "-p", "warm_up_m=4e-4", "-p", "warm_up_s=5")
    (track,) = [s for s in recording.signals if s.name == "temperature:forearm_link"]
    felt = track.values[:, 0]
    assert felt[-1] - felt[0] > 10.0
    assert np.all(np.diff(felt) > -1.0)


def test_points_efforts_and_a_delta(tmp_path: Path) -> None:
    (tmp_path / "arm").mkdir()
    recording = simulated(tmp_path / "arm", "-p", "measurement=point", "-p", "publish_effort=true")
    assert recording.readings[0].kind == "point"
    assert np.isfinite(recording.joints[0].effort).all()
    recording = simulated(tmp_path, robot=ROBOTS / "delta.yaml")
    assert recording.joints[0].names == read_delta(ROBOTS / "delta.yaml").names
    assert recording.robot_description is None


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["-p", "colour=red"], "modcal: -p colour=red: is not a NAME=VALUE of the simulated cell: names are base, tip, seed"),
        (["-p", "urdf=other.urdf"], "modcal: -p urdf=other.urdf: is not a NAME=VALUE of the simulated cell"),
        (["-p", "stations"], "modcal: -p stations: is not a NAME=VALUE"),
        (["-p", "stations=many"], "modcal: -p stations=many: is no int: write one"),
        (["-p", "noise_m=.nan"], "modcal: -p noise_m=.nan: is no float: write one"),
        (["-p", "noise_m=2"], "modcal: -p noise_m=2: 0 to 0.1 is allowed: choose a value between"),
        (["-p", "gear_joint=knee"], "modcal: gear_joint 'knee': joints are shoulder_pan_joint"),
        (["--at", "5", "seed=2"], "modcal: --at 5 seed: cannot change in time: use one of tool_bump_m"),
        (["--at", "500", "payload_kg=2"], "modcal: --at 500 payload_kg: the last posture is reached at 132 s"),
        (["--at", "5", "tool_bump_m=[1, 2]"], "modcal: --at 5 tool_bump_m: tool_bump_m takes three finite numbers"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(tmp_path: Path, options: list[str], said: str, refused: Refused) -> None:
    refused(["simulate", str(URDF), "--out", str(tmp_path / "bag"), *options], re.escape(said))


def test_a_folder_that_exists_is_not_touched(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "bag").mkdir()
    refused(["simulate", str(URDF), "--out", str(tmp_path / "bag")], "exists: name another folder")
    assert not list((tmp_path / "bag").iterdir())
