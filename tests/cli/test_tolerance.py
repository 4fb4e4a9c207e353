"""Tolerances, certificates and what a report is traced back to; ``modcal compare``; options of ``modcal calibrate``."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.conftest import Refused
from cli.recordings import part, stations, with_joints

from modcal_msgs_py.messages import digest
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

pytestmark = pytest.mark.slow


def report(folder: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return data


@pytest.mark.parametrize(("mm", "of", "result"), [("0.001", "mean", "FAIL"), ("100", "max", "CANNOT TELL")])
def test_a_tolerance_that_is_not_met_or_cannot_be_told_ends_with_3(
    folder: Path, tmp_path: Path, mm: str, of: str, result: str
) -> None:
    """Readings scatter by 20 µm along each axis, so no model is within 1 µm of them."""
    arguments = [str(folder / "a"), str(folder / "bag"), "--out", str(tmp_path / "out")]
    assert run(["evaluate", *arguments, "--tolerance-mm", mm, "--tolerance-of", of, "--certificate"]) == 3
    met = report(tmp_path / "out")["tolerance"]
    assert (met["result"], met["asked_mm"], met["statistic"]) == (result, float(mm), of)
    assert (met["ci95"][0] > met["asked_mm"]) == (result == "FAIL")
    assert "are of the calibration&#39;s own recording" in (tmp_path / "out" / "certificate.html").read_text()
    assert "<title>a, evaluated on bag</title>" in (tmp_path / "out" / "report.html").read_text()


def test_calibrate_takes_a_tolerance_too(folder: Path, tmp_path: Path) -> None:
    arguments = [str(folder / "bag"), "--geometry-only", "--out", str(tmp_path / "out"), "--tolerance-mm", "0.001"]
    assert run(["calibrate", *arguments]) == 3
    assert report(tmp_path / "out")["tolerance"]["result"] == "FAIL"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--tolerance-mm", "0"], "0.0 is not in the range"),
        (["--tolerance-mm", "1", "--tolerance-of", "median"], "median"),
        (["--repeatability-mm", "-1"], "not in the range"),
        (["--repeatability-mm", "0.02", "--repeatability-iso", "0.05"], "repeatability"),
        (["--instrument-mm", "1e6"], "instrument"),
        (["--certificate"], "--certificate: has no tolerance"),
        (["--serial", "1"], "--serial: is printed on a certificate only"),
    ],
)
@pytest.mark.parametrize("verb", ["evaluate", "check"])
def test_what_cannot_be_asked_or_stated_is_refused(
    verb: str, options: list[str], said: str, folder: Path, refused: Refused
) -> None:
    refused([verb, str(folder / "a"), str(folder / "bag"), *options], said)


def test_the_certificate_names_robot_serial_instrument_and_hashes(folder: Path) -> None:
    page = (folder / "a" / "certificate.html").read_text()
    for text in (
        "cell 3",
        "SN-4711",
        "AT960 no. 7",
        "PASS, with reservations",
        report(folder / "a")["trace"]["bag_sha256"],
    ):
        assert text in page


def test_a_report_is_traced_back_to_its_recording(folder: Path) -> None:
    trace = report(folder / "a")["trace"]
    assert trace["date"] == "2023-11-14T22:13:20.000Z"  # 1.7e9 s
    assert trace["robot"] == "ur10"
    assert trace["instrument"] == "pose on /tracker/pose in tracker"
    listed = sorted(p for p in (folder / "bag").iterdir())
    lines = "".join(f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.name}\n" for p in listed)
    assert trace["bag_sha256"] == hashlib.sha256(lines.encode()).hexdigest()
    assert digest(listed[0]) == hashlib.sha256(listed[0].read_bytes()).hexdigest()


def test_comparing_says_and_writes_what_differs(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(["compare", str(folder / "a"), str(folder / "a"), "--tolerance-mm", "1", "--out", str(out)]) == 0
    said = capfd.readouterr().out
    assert "No difference is shown" in said
    assert re.search(r"^  ±: one standard deviation; .*shown: ", said, re.MULTILINE)
    assert said.endswith(f"Comparison: {out}/comparison.json\n")
    assert json.loads((out / "comparison.json").read_text())["result"] == "same"
    assert [p.name for p in out.iterdir()] == ["comparison.json"]
    assert run(["compare", str(folder / "a"), str(folder / "a"), "--tolerance-mm", "1e-6", "--out", str(out)]) == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "is not JSON"),
        ("[]", "is not a mapping"),
        ('{"modcal_report": 2}', "is not one of 1"),
        ('{"modcal_report": 1, "error_mm": {"final": {"rms": "x"}}}', "report.json"),
    ],
)
def test_a_damaged_report_is_refused(folder: Path, tmp_path: Path, text: str, said: str, refused: Refused) -> None:
    (tmp_path / "report.json").write_text(text)
    refused(["compare", str(folder / "a"), str(tmp_path / "report.json"), "--out", str(tmp_path / "out")], said)


def calibrated(bag: Path, out: Path, *more: str) -> dict[str, Any]:
    assert run(["calibrate", str(bag), "--geometry-only", *more, "--out", str(out)]) == 0
    return report(out)


def test_two_recordings_are_one_calibration(tmp_path: Path) -> None:
    whole = stations(100)
    for name, recording in (("all", whole), ("one", part(whole, slice(60))), ("two", part(whole, slice(60, 100)))):
        write_recording(recording, tmp_path / name)
    once = calibrated(tmp_path / "all", tmp_path / "a")
    together = calibrated(tmp_path / "one", tmp_path / "b", "--also", str(tmp_path / "two"))
    assert together["recording"]["stations"] == 100
    assert together["error_mm"] == once["error_mm"]


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
