"""``modcal`` on a Delta: from a bag and the drawing's file to a report, and back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cells import joint_track
from cli.conftest import Refused
from deltas import FILE, LINEAR, NOISE_M, RecordedDelta, record_delta

from modcal_core.calibration import Pairs, objective
from modcal_core.measurements.recording import ReadingTrack, Recording
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run
from modcal_nodes.io.inputs import read_delta


def write(cell: RecordedDelta, bag: Path) -> None:
    """A bag of joint_states and tracker/point, a finished station each."""
    s = cell.samples
    joints = joint_track(s.names, s.stamps, s.q)
    points = ReadingTrack("point", "tracker", s.stamps, s.reading, s.stamps)
    write_recording(Recording((joints,), (points,), source="made"), bag)


@pytest.mark.slow
def test_from_a_bag_to_a_report_and_a_corrected_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cell = record_delta(2, 130, gear=(1, 60.0, 3e-4))
    write(cell, tmp_path / "bag")
    out = tmp_path / "out"
    assert run(["calibrate", str(tmp_path / "bag"), "--delta", str(FILE), "--out", str(out)]) == 0
    assert {p.name for p in out.iterdir()} == {
        "report.json",
        "report.html",
        "calibration.yaml",
        "calibrated_delta.yaml",
    }
    report = json.loads((out / "report.json").read_text())
    assert report["recording"]["joints"] == ["arm_1", "arm_2", "arm_3", "shaft"]
    assert report["recording"]["measurement"] == "point"
    (gear,) = report["effects"]
    assert (gear["place"], gear["direction"], gear["driver"]) == ("arm_2", "axis", "position:arm_2")
    assert report["error_mm"]["final"]["rms"] < 0.7 * report["error_mm"]["geometric"]["rms"]
    assert "tool/z" in report["identifiability"]["left_out"]

    # the corrected file is a drawing again, nearer to the truth: distances between its points are the true ones
    corrected = read_delta(out / "calibrated_delta.yaml")
    pairs = Pairs.of_points(cell.world.tool_in_base(cell.samples.q)[:, :3, 3])
    nominal = objective(cell.nominal, cell.samples.q, pairs)
    assert objective(corrected, cell.samples.q, pairs) < 0.3 * nominal

    # another recording of the same robot, through the frozen calibration
    fresh = record_delta(2, 90, gear=(1, 60.0, 3e-4))
    write(fresh, tmp_path / "again")
    assert run(["evaluate", str(out), str(tmp_path / "again"), "--out", str(tmp_path / "score")]) == 0
    scored = json.loads((tmp_path / "score" / "report.json").read_text())
    assert scored["error_mm"]["final"]["rms"] < 0.08
    assert run(["info", str(tmp_path / "bag"), "--delta", str(FILE)]) == 0
    said = capsys.readouterr().out
    assert "base → tip, 4 joints" in said
    assert "calibration from 130 finished stations (points)" in said


def test_from_a_table_to_distances_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Carriages in mm; what annealing and least squares make of distances, on points that neither has seen."""
    cell = record_delta(4, 90, linear=True)
    q = cell.samples.q * np.where(cell.nominal.revolute, np.degrees(1.0), 1e3)
    header = ",".join([*cell.nominal.names, "X_mm", "Y_mm", "Z_mm"])
    np.savetxt(tmp_path / "t.csv", np.c_[q, 1e3 * cell.samples.reading], delimiter=",", header=header, comments="")
    monkeypatch.chdir(tmp_path)
    assert run(["import", "t.csv", "--delta", str(LINEAR), "--out", "bag"]) == 0
    asked = ["--geometry-only", "--by-distances", "--out", "out"]
    assert run(["calibrate", "bag", "--delta", str(LINEAR), *asked]) == 0
    report = json.loads(Path("out/report.json").read_text())
    nominal, annealed, polished, direct = report["by_distances"]["methods"]
    assert annealed["held_out_rms_mm"] < 0.9 * nominal["held_out_rms_mm"]
    assert direct["held_out_rms_mm"] == pytest.approx(polished["held_out_rms_mm"], rel=0.01)
    assert direct["held_out_rms_mm"] == pytest.approx(report["error_mm"]["geometric"]["rms"], rel=0.2)
    assert direct["held_out_rms_mm"] < 0.5 * annealed["held_out_rms_mm"]
    assert direct["held_out_rms_mm"] < 1.3 * 1e3 * NOISE_M * np.sqrt(3.0)  # 16 of 24 parameters, from 45 points
    assert direct["evaluations"] < 0.1 * annealed["evaluations"]
    assert "By distances alone" in Path("out/report.html").read_text()


@pytest.mark.parametrize(
    ("text", "arguments", "said"),
    [
        ("modcal_delta: 1\n", [], "'joints' is not stated"),
        ("arms: [1", [], "is not YAML"),
        (None, ["--urdf", str(FILE)], "cannot be combined with --urdf"),
        (None, ["--tip", "tool0"], "cannot be combined with --urdf"),
        (FILE.read_text().replace("shaft", "wrist"), [], "joint wrist"),
        (FILE.read_text().replace("distal_m: 0.80", "distal_m: 0.42"), [], "no platform fits"),
    ],
)
def test_what_is_refused_writes_nothing(
    text: str | None, arguments: list[str], said: str, tmp_path: Path, refused: Refused
) -> None:
    write(record_delta(1, 40), tmp_path / "bag")
    file = FILE
    if text is not None:
        file = tmp_path / "delta.yaml"
        file.write_text(text)
    out = tmp_path / "out"
    refused(["calibrate", str(tmp_path / "bag"), "--delta", str(file), *arguments, "--out", str(out)], said)


def test_without_its_file_a_bag_of_a_delta_has_no_robot(tmp_path: Path, refused: Refused) -> None:
    write(record_delta(1, 20), tmp_path / "bag")
    refused(["calibrate", str(tmp_path / "bag"), "--out", str(tmp_path / "out")], "--delta")
