"""``modcal calibrate``: what its options do."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.recordings import part, stations, with_joints

from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run


def report(folder: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return data


@pytest.mark.slow
def test_two_recordings_are_one_calibration(tmp_path: Path) -> None:
    whole = stations(100)
    for name, recording in (("all", whole), ("one", part(whole, slice(60))), ("two", part(whole, slice(60, 100)))):
        write_recording(recording, tmp_path / name)
    assert run(["calibrate", str(tmp_path / "all"), "--out", str(tmp_path / "a")]) == 0
    also = ["--also", str(tmp_path / "two")]
    assert run(["calibrate", str(tmp_path / "one"), *also, "--out", str(tmp_path / "b")]) == 0
    together, once = report(tmp_path / "b"), report(tmp_path / "a")
    assert together["recording"]["stations"] == 100
    assert together["error_mm"] == once["error_mm"]


@pytest.mark.slow
def test_geometry_only_looks_no_further(tmp_path: Path) -> None:
    whole = stations(100)
    q = whole.joints[0].position.copy()
    q[:, 2] -= 3e-4 * np.sin(60.0 * q[:, 2])
    write_recording(with_joints(whole, position=q), tmp_path / "bag")
    assert run(["calibrate", str(tmp_path / "bag"), "--out", str(tmp_path / "all")]) == 0
    assert run(["calibrate", str(tmp_path / "bag"), "--geometry-only", "--out", str(tmp_path / "some")]) == 0
    everything, geometry = report(tmp_path / "all"), report(tmp_path / "some")
    assert [e["place"] for e in everything["effects"]] == ["elbow_joint"]
    assert geometry["effects"] == []
    assert geometry["error_mm"]["final"] == geometry["error_mm"]["geometric"]
    assert everything["error_mm"]["final"]["rms"] < 0.7 * geometry["error_mm"]["final"]["rms"]
