"""``--tolerance-mm`` and what is stated of arm and instrument: exit codes, and what the report is traced back to."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from cli.recordings import stations

from modcal_msgs_py.descriptions import digest
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of 100 stations, and its calibration."""
    here = tmp_path_factory.mktemp("tolerance")
    write_recording(stations(100), here / "bag")
    assert run(["calibrate", str(here / "bag"), "--geometry-only", "--out", str(here / "frozen")]) == 0
    return here


def report(folder: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return data


@pytest.mark.slow
@pytest.mark.parametrize("of", ["mean", "max"])
def test_a_tolerance_that_is_not_met_ends_with_3(folder: Path, tmp_path: Path, of: str) -> None:
    """Readings scatter by 20 µm along each axis, so no model is within 1 µm of them."""
    arguments = [str(folder / "frozen"), str(folder / "bag"), "--out", str(tmp_path / "out")]
    assert run(["evaluate", *arguments, "--tolerance-mm", "0.001", "--tolerance-of", of]) == 3
    met = report(tmp_path / "out")["tolerance"]
    assert met["result"] == "FAIL"
    assert (met["asked_mm"], met["statistic"]) == (0.001, of)
    assert met["ci95"][0] > 0.001


@pytest.mark.slow
def test_a_tolerance_that_cannot_be_told_ends_with_3(folder: Path, tmp_path: Path) -> None:
    arguments = [str(folder / "frozen"), str(folder / "bag"), "--out", str(tmp_path / "out")]
    assert run(["evaluate", *arguments, "--tolerance-mm", "100", "--tolerance-of", "max"]) == 3
    assert report(tmp_path / "out")["tolerance"]["result"] == "CANNOT TELL"


def test_without_a_tolerance_it_ends_with_0(folder: Path) -> None:
    assert report(folder / "frozen")["tolerance"] is None


@pytest.mark.slow
def test_calibrate_takes_a_tolerance_too(folder: Path, tmp_path: Path) -> None:
    arguments = [str(folder / "bag"), "--geometry-only", "--out", str(tmp_path / "out"), "--tolerance-mm", "0.001"]
    assert run(["calibrate", *arguments]) == 3
    assert report(tmp_path / "out")["tolerance"]["result"] == "FAIL"


def test_what_cannot_be_asked_or_stated_is_refused(folder: Path, tmp_path: Path) -> None:
    for options in (
        ["--tolerance-mm", "0"],
        ["--tolerance-mm", "1", "--tolerance-of", "median"],
        ["--repeatability-mm", "-1"],
        ["--repeatability-mm", "0.02", "--repeatability-iso", "0.05"],
        ["--instrument-mm", "1e6"],
    ):
        arguments = [str(folder / "frozen"), str(folder / "bag"), "--out", str(tmp_path / "out")]
        assert run(["evaluate", *arguments, *options]) == 2, options
    assert not (tmp_path / "out").exists()


def test_a_report_is_traced_back_to_its_recording(folder: Path) -> None:
    trace = report(folder / "frozen")["trace"]
    assert trace["date"] == "2023-11-14T22:13:20.000Z"  # 1.7e9 s
    assert trace["robot"] == "ur10"
    assert trace["instrument"] == "pose on /tracker/pose in tracker"
    listed = sorted(p for p in (folder / "bag").iterdir())
    lines = "".join(f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.name}\n" for p in listed)
    assert trace["bag_sha256"] == hashlib.sha256(lines.encode()).hexdigest()
    assert digest(listed[0]) == hashlib.sha256(listed[0].read_bytes()).hexdigest()


@pytest.mark.slow
def test_two_runs_write_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert run(["evaluate", str(folder / "frozen"), str(folder / "bag"), "--out", str(tmp_path / name)]) == 0
    for name in ("report.json", "report.html"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
