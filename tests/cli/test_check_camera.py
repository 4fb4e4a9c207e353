"""``modcal check`` of a calibration that a camera and a sheet made: by a tracker, and by the camera again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera.scenes import PANDA, CameraScene, scene

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.store import Calibration
from modcal_core.claim.claim import claim_at_tool
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording
from modcal_core.measurements.samples import Samples
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

pytestmark = pytest.mark.slow
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
    T = T.copy()
    T[:, :3, 3] += 2e-5 * rng.standard_normal((len(T), 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(2e-5 * rng.standard_normal((len(T), 3)))
    t, unknown = 1.7e9 + 2.0 * np.arange(len(q)), np.full_like(q, np.nan)
    values = se3.to_pose(T) if kind == "pose" else T[:, :3, 3]
    recording = Recording(
        joints=(JointTrack(made[0].chain.names, t, q, unknown, unknown, t),),
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


@pytest.mark.parametrize("kind", ["pose", "point"])
def test_a_tracker_with_a_target_of_its_own(made: tuple[CameraScene, Path], tmp_path: Path, kind: str) -> None:
    """The tracker's target is a tool elsewhere, as a note says; the arm itself is what it was."""
    q = postures(made[0], 9)
    data = checked(made, tmp_path, q, TRACKER @ made[0].truth(q) @ PROBE, "tracker", kind)
    assert [c["kind"] for c in data["changes"]] == ["tool"]
    assert any("a moved tool is that target" in note for note in data["notes"])
    assert not any("keeps no covariance" in note for note in data["notes"])


def test_a_zero_is_named_by_a_tracker(made: tuple[CameraScene, Path], tmp_path: Path) -> None:
    q = postures(made[0], 9)
    moved = q + 0.01 * np.eye(q.shape[1])[3]
    data = checked(made, tmp_path, q, TRACKER @ made[0].truth(moved) @ PROBE, "tracker", "pose")
    assert {(c["kind"], c["place"]) for c in data["changes"]} == {("tool", "tool"), ("joint_zero", "panda_joint4")}


@pytest.mark.parametrize("frame", ["camera_optical_frame"])
def test_the_camera_again(made: tuple[CameraScene, Path], tmp_path: Path, frame: str) -> None:
    """The board in the camera, as a detector writes it: the inverse, whatever its frame is called."""
    q = postures(made[0], 9)
    data = checked(made, tmp_path, q, se3.inverse(made[0].truth(q)), frame, "pose")
    assert data["convention"] == "pose inverted"
    assert data["status"] == "unchanged"
    assert data["changes"] == []
    bumped = se3.inverse(made[0].truth(q) @ se3.exp(np.array([8e-3, -4e-3, 2e-3, 0.02, 0.0, 0.0])))
    (tmp_path / "later").mkdir()
    data = checked(made, tmp_path / "later", q, bumped, frame, "pose")
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
