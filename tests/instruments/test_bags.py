"""From a bag with the contract's topics to a calibration, and what a cell file says of instruments."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cells import joint_track, ur10
from cli.recordings import URDF
from instruments import worlds
from instruments.test_recovery import CELLS, LASER, Device, postures

from modcal_core.calibration import Calibration
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.recording import ReadingTrack, Recording
from modcal_msgs_py.mcap_read import read_recording
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run
from modcal_nodes.io.inputs import read_cell


def recording(devices: list[Device], count: int = 100, seed: int = 1) -> Recording:
    """Stations with readings of several instruments, each finished by a joint state of the same stamp."""
    rng = np.random.default_rng(seed)
    w = worlds.world(seed)
    q = postures(w, devices, count, rng)
    poses = w.tool_in_base(q)
    t = 1.7e9 + 2.0 * np.arange(count)
    return Recording(
        joints=(joint_track(ur10().names, t, q),),
        readings=tuple(_track(d, t, poses, rng) for d in devices),
        robot_description=URDF.read_text(),
        source="made",
    )


def _track(device: Device, t: Array, poses: Array, rng: np.random.Generator) -> ReadingTrack:
    values = np.array([device.read(T) for T in poses])
    values = values + device.noise * rng.standard_normal(values.shape)
    if device.kind == "bearing":
        values /= np.linalg.norm(values, axis=1, keepdims=True)
    return ReadingTrack(device.kind, device.frame, t, values, t, f"/{kinds()[device.kind].topic}")


def test_readings_come_back_from_a_bag(tmp_path: Path) -> None:
    devices = [*CELLS["three wires"][0], *CELLS["two theodolites"][0], *CELLS["three planes"][0]]
    made = recording(devices, 10)
    write_recording(made, tmp_path / "bag")
    read = {(r.kind, r.frame): r for r in read_recording(tmp_path / "bag").readings}
    assert len(read) == len(devices)
    for track in made.readings:
        found = read[track.kind, track.frame]
        assert found.topic == track.topic
        assert np.abs(found.values - track.values).max() < (1e-6 if track.values.shape[1] == 1 else 1e-15)  # float32
        assert np.abs(found.stamps - track.stamps).max() < 1e-6


@pytest.mark.slow
def test_mixed_instruments_in_one_calibration(tmp_path: Path) -> None:
    """A tracker, a wire with a hook of its own and a theodolite; then the frozen calibration on the same cell again."""
    devices, _ = CELLS["tracker, wire of its own hook, theodolite"]
    cell = tmp_path / "cell.yaml"
    cell.write_text("own_target: [wire_0]\n")
    for name, count in (("bag", 100), ("again", 70)):
        write_recording(recording(devices, count), tmp_path / name)
    options = ["--cell", str(cell), "--geometry-only"]
    assert run(["calibrate", str(tmp_path / "bag"), *options, "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["recording"]["measurement"] == "mixed"
    assert report["error_mm"]["final"]["rms"] < 0.2 * report["error_mm"]["nominal"]["rms"]
    assert "instrument wire_0/target_x" in [p["name"] for p in report["parameters"]]
    assert {p["unit"] for p in report["parameters"] if p["name"].startswith("instrument wire_0")} == {"m"}
    calibration = Calibration.load(tmp_path / "out")
    assert [i.kind for i in calibration.calibrated.instruments] == ["range", "bearing"]
    assert calibration.noise.others["range"] == pytest.approx(2e-4, rel=0.3)
    out = ["--out", str(tmp_path / "scored")]
    assert run(["evaluate", str(tmp_path / "out"), str(tmp_path / "again"), *out]) == 0
    scored = json.loads((tmp_path / "scored" / "report.json").read_text())
    assert scored["error_mm"]["final"]["rms"] < 1.2 * report["error_mm"]["final"]["rms"]
    assert run(["evaluate", str(tmp_path / "out"), str(tmp_path / "again"), *out, "--refit-base"]) == 0
    again = json.loads((tmp_path / "scored" / "report.json").read_text())
    assert again["error_mm"]["final"]["rms"] < 1.3 * report["error_mm"]["final"]["rms"]


@pytest.mark.slow
def test_a_gripper_sensor_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_recording(recording([LASER], 120), tmp_path / "bag")
    assert run(["info", str(tmp_path / "bag")]) == 0
    assert "calibration from 120 finished stations (readings of ray)" in " ".join(capsys.readouterr().out.split())
    assert run(["calibrate", str(tmp_path / "bag"), "--geometry-only", "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["recording"]["measurement"] == "ray"
    assert "tool/z" in report["identifiability"]["left_out"]


def test_a_cell_file_says_what_is_known_of_frames(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(
        """
distances:
  - {stamps: [1700000000.0, 1700000008.0], distance_m: 0.3}
known:
  - {frame: laser, in: tracker, plane: {normal: [0.0, 0.0, 1.0], offset_m: 0.2}}
  - {frame: wire_0, in: base, position_m: [1.5, 0.3, 0.2]}
own_target: [wire_0]
"""
    )
    cell = read_cell(path)
    assert cell.own_target == ("wire_0",)
    assert cell.kept == ("frame wire_0",)
    # a point of the plane, in the tracker, has no height above it
    assert (cell.known[0].T_frame_to @ [0.7, -0.4, 0.2, 1.0])[2] == pytest.approx(0.0)
    assert np.allclose(cell.known[1].T_frame_to @ [1.5, 0.3, 0.2, 1.0], [0.0, 0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "known: [{frame: a, in: b, plane: {normal: [0, 0, 2], offset_m: 0}}]",
            "its normal has length 2: give one of length one",
        ),
        ("known: [{frame: a, in: b, place: 3}]", "unknown key place"),
        ("known: [{frame: a}]", "'in' is not stated"),
        ("distances: [{stamps: [1.0], distance_m: 0.2}]", "stamps: it has 1 entries, 2 are allowed"),
        ("distances: [{stamps: [1.0, 2.0], distance_m: 200}]", "distance_m: 200 is out of range, at most 50.0"),
        ("planes: []", "unknown key planes"),
    ],
)
def test_a_cell_file_that_cannot_be_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    (tmp_path / "cell.yaml").write_text(text)
    write_recording(recording(CELLS["one wire"][0], 10), tmp_path / "bag")
    out = tmp_path / "out"
    assert run(["calibrate", str(tmp_path / "bag"), "--cell", str(tmp_path / "cell.yaml"), "--out", str(out)]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert not out.exists()
