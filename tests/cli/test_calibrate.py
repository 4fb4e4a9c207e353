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


def calibrated(bag: Path, out: Path, *more: str) -> dict[str, Any]:
    assert run(["calibrate", str(bag), "--geometry-only", *more, "--out", str(out)]) == 0
    return report(out)


@pytest.mark.slow
def test_two_recordings_are_one_calibration(tmp_path: Path) -> None:
    whole = stations(100)
    for name, recording in (("all", whole), ("one", part(whole, slice(60))), ("two", part(whole, slice(60, 100)))):
        write_recording(recording, tmp_path / name)
    once = calibrated(tmp_path / "all", tmp_path / "a")
    together = calibrated(tmp_path / "one", tmp_path / "b", "--also", str(tmp_path / "two"))
    assert together["recording"]["stations"] == 100
    assert together["error_mm"] == once["error_mm"]


@pytest.mark.slow
def test_geometry_only_looks_no_further(tmp_path: Path) -> None:
    """The elbow has a gear error, which every calibration of effects finds."""
    whole = stations(100)
    q = whole.joints[0].position.copy()
    q[:, 2] -= 3e-4 * np.sin(60.0 * q[:, 2])
    write_recording(with_joints(whole, position=q), tmp_path / "bag")
    geometry = calibrated(tmp_path / "bag", tmp_path / "out")
    assert geometry["effects"] == []
    assert geometry["error_mm"]["final"] == geometry["error_mm"]["geometric"]
    assert "not looked for" in geometry["verdict"]
