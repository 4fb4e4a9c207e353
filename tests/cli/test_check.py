"""``modcal check``: its files, exit codes and refusals; of a calibration that a camera made, too."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera.scenes import PANDA, CameraScene, scene
from cells import NOISE_M, joint_track, noisy, record
from cli.conftest import Refused
from cli.recordings import START, recorded, with_joints

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.store import Calibration
from modcal_core.claim.claim import claim_at_tool
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import ReadingTrack, Recording
from modcal_core.measurements.samples import Samples
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

pytestmark = pytest.mark.slow
BUMP = se3.exp([4e-4, -3e-4, 3e-4, 0.0, 0.0, 0.0])


def later(folder: Path, change: Array, count: int = 10, twist: float = 0.0, scale: float = 1.0) -> Path:
    """A bag of a few stations of the cell of seed 1, a day later. twist: of the fourth joint, another at every one."""
    world = record(1, 1).world
    rng = np.random.default_rng(8)
    q = rng.uniform(-2.5, 2.5, (count, 6))
    T = world.tool_in_tracker(q + np.outer(twist * rng.standard_normal(count), np.eye(6)[3])) @ change
    T[:, :3, 3] = scale * (T[:, :3, 3] + NOISE_M * rng.standard_normal((count, 3)))
    t = START + 86400.0 + 2.0 * np.arange(count)
    write_recording(recorded(t, q, t, se3.to_pose(T)), folder)
    return folder


def test_a_bumped_tool_is_named_repaired_and_certified(folder: Path, tmp_path: Path) -> None:
    bag, out = later(tmp_path / "bag", BUMP), tmp_path / "out"
    options = ["--tolerance-mm", "1", "--certificate", "--serial", "SN-1"]
    assert run(["check", str(folder / "a"), str(bag), *options, "--out", str(out)]) == 0
    data = json.loads((out / "check.json").read_text())
    assert [c["kind"] for c in data["changes"]] == ["tool"]
    assert data["changes"][0]["moved_mm"]["rms"] == pytest.approx(0.583, rel=0.1)
    assert data["action"] == "use_repaired"
    assert data["tolerance"]["result"] == "PASS"
    assert data["date"].startswith("20")
    assert {
        "check.html",
        "report.json",
        "calibration.yaml",
        "calibrated.urdf",
        "kinematics.yaml",
    } <= {p.name for p in out.iterdir()}
    page = (out / "check.html").read_text()
    assert "The tool or the target has moved" in page
    assert "<title>a, checked by bag</title>" in page
    # a tool that moved leaves the arm as it was
    chains = [read_chain((one / "calibrated.urdf").read_text(), None, "tool0") for one in (folder / "a", out)]
    assert np.abs(chains[0].origins - chains[1].origins).max() < 1e-12
    # the repaired folder can be checked like any other
    assert run(["check", str(out), str(bag), "--out", str(tmp_path / "again"), "--tolerance-mm", "0.001"]) == 3
    assert json.loads((tmp_path / "again" / "check.json").read_text())["status"] == "unchanged"


def test_nothing_changed_writes_no_model(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = later(tmp_path / "bag", np.eye(4))
    assert run(["check", str(folder / "a" / "calibration.yaml"), str(bag), "--out", str(tmp_path / "out")]) == 0
    assert "Nothing has changed, by 10 stations." in capsys.readouterr().out
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"check.html", "check.json", "report.html", "report.json"}


def test_stations_to_add_are_a_table(folder: Path, tmp_path: Path) -> None:
    bag = later(tmp_path / "bag", np.eye(4), twist=1.5e-3)
    assert run(["check", str(folder / "a"), str(bag), "--out", str(tmp_path / "out")]) == 0
    data = json.loads((tmp_path / "out" / "check.json").read_text())
    assert [(c["kind"], c["place"]) for c in data["changes"]] == [("gear", "wrist_1_joint")]
    rows = list(csv.reader((tmp_path / "out" / "stations.csv").read_text().splitlines()))
    assert tuple(rows[0]) == tuple(data["stations_to_add"][0])
    assert len(rows) == len(data["stations_to_add"]) + 1
    assert not (tmp_path / "out" / "calibration.yaml").exists()


def test_another_unit_is_refused(folder: Path, tmp_path: Path, refused: Refused) -> None:
    bag = later(tmp_path / "bag", np.eye(4), scale=1e-3)
    refused(["check", str(folder / "a"), str(bag), "--out", str(tmp_path / "out")], "millimetres")


def test_a_recording_of_another_robot_is_refused_by_its_joints(folder: Path, tmp_path: Path, refused: Refused) -> None:
    other = recorded(START + np.arange(10.0), np.zeros((10, 6)), START + np.arange(10.0), np.zeros((10, 7)))
    renamed = with_joints(other, names=tuple(f"panda_joint{k}" for k in range(1, 7)))
    write_recording(renamed, tmp_path / "bag")
    for verb in ("check", "evaluate"):
        said = r"joint shoulder_pan_joint, .* of the calibration: not among the joint states \(panda_joint1"
        line = refused([verb, str(folder / "a"), str(tmp_path / "bag"), "--out", str(tmp_path / "out")], said)
        assert "give a recording of the arm that was calibrated (base_link → tool0)" in line
        assert "--base" not in line


TRACKER = se3.exp(np.array([1.2, -0.7, 0.4, 0.3, 0.5, -1.0]))
PROBE = se3.exp(np.array([0.05, -0.03, 0.1, 0.2, 0.1, 0.4]))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[CameraScene, Path]:
    """A cell with a camera on the tip, and the folder of its calibration from forty images' corners."""
    where = tmp_path_factory.mktemp("camera")
    s = scene(5, True, 40)
    rows = ["image,id,u,v,width,height"]
    for i, v in enumerate(s.views):
        rows += [f"{i},{k},{x:.4f},{y:.4f},1280,720" for k, (x, y) in zip(v.ids, v.pixels, strict=True)]
    (where / "corners.csv").write_text("\n".join(rows) + "\n")
    joints = [",".join([str(i), *map(repr, map(float, q))]) for i, q in enumerate(s.q)]
    (where / "joints.csv").write_text("\n".join([",".join(["image", *s.chain.names]), *joints]) + "\n")
    target = ["target", "--charuco", "7x5", "--square", "30mm", "--marker", "22mm", "--out", str(where / "target")]
    assert run(target) == 0
    assert run(["target", "--measured", "210x150", "--out", str(where / "target")]) == 0
    files = {"--images": "corners.csv", "--joints": "joints.csv", "--target": "target/target.yaml", "--out": "a"}
    call = ["calibrate", *(t for option, name in files.items() for t in (option, str(where / name)))]
    assert run([*call, "--urdf", str(PANDA), "--tip", "panda_link8", "--geometry-only"]) == 0
    return s, where / "a"


def checked(made: tuple[CameraScene, Path], folder: Path, q: Array, T: Array, frame: str, kind: str) -> dict[str, Any]:
    """What a check says of readings T (N, 4, 4) in this frame, with a good tracker's noise."""
    rng = np.random.default_rng(1)
    T = noisy(T, 2e-5, 2e-5, rng)
    t = 1.7e9 + 2.0 * np.arange(len(q))
    values = se3.to_pose(T) if kind == "pose" else T[:, :3, 3]
    recording = Recording(
        joints=(joint_track(made[0].chain.names, t, q),),
        readings=(ReadingTrack(kind, frame, t, values, t),),
        robot_description=PANDA.read_text(),
        source="made",
    )
    write_recording(recording, folder / "bag")
    assert run(["check", str(made[1]), str(folder / "bag"), "--out", str(folder / "out")]) == 0
    return dict(json.loads((folder / "out" / "check.json").read_text()))


def postures(s: CameraScene, seed: int) -> Array:
    """Twelve postures near those of the images."""
    rng = np.random.default_rng(seed)
    q = s.q[rng.permutation(len(s.q))[:12]] + rng.normal(0.0, 0.05, (12, s.chain.n))
    return np.clip(q, s.q.min(axis=0), s.q.max(axis=0))


def test_a_tracker_with_a_target_of_its_own(made: tuple[CameraScene, Path], tmp_path: Path) -> None:
    """The tracker's target is a tool elsewhere, as a note says; the arm itself is what it was."""
    q = postures(made[0], 9)
    data = checked(made, tmp_path, q, TRACKER @ made[0].truth(q) @ PROBE, "tracker", "point")
    assert [c["kind"] for c in data["changes"]] == ["tool"]
    assert any("a moved tool is that target" in note for note in data["notes"])
    assert not any("keeps no covariance" in note for note in data["notes"])


def test_a_zero_is_named_by_a_tracker(made: tuple[CameraScene, Path], tmp_path: Path) -> None:
    q = postures(made[0], 9)
    moved = q + 0.01 * np.eye(q.shape[1])[3]
    data = checked(made, tmp_path, q, TRACKER @ made[0].truth(moved) @ PROBE, "tracker", "pose")
    assert {(c["kind"], c["place"]) for c in data["changes"]} == {("tool", "tool"), ("joint_zero", "panda_joint4")}


def test_the_camera_again(made: tuple[CameraScene, Path], tmp_path: Path) -> None:
    """The board in the camera, as a detector writes it: the inverse, whatever its frame is called."""
    q = postures(made[0], 9)
    data = checked(made, tmp_path, q, se3.inverse(made[0].truth(q)), "camera_optical_frame", "pose")
    assert data["convention"] == "pose inverted"
    assert data["status"] == "unchanged"
    assert data["changes"] == []
    bumped = se3.inverse(made[0].truth(q) @ se3.exp(np.array([8e-3, -4e-3, 2e-3, 0.02, 0.0, 0.0])))
    (tmp_path / "later").mkdir()
    data = checked(made, tmp_path / "later", q, bumped, "camera_optical_frame", "pose")
    assert [c["kind"] for c in data["changes"]] == ["tool"]


def test_what_it_knows_of_itself(made: tuple[CameraScene, Path]) -> None:
    """The calibrated arm is not farther off than is claimed of it, and not far nearer."""
    s, folder = made
    calibration = Calibration.load(folder)
    q = postures(s, 3)
    truth = s.truth(q)
    samples = replace(Samples.from_arrays(q, poses=truth, names=s.chain.names), frames=("target",))
    claim = claim_at_tool(calibration, samples, Cell(), q, frozen="whole")
    miss = 1e3 * np.percentile(np.linalg.norm((calibration.predict(q) - truth)[:, :3, 3], axis=1), 95)
    assert miss < claim.mm["p95"].ci95[1] < 10.0 * miss
