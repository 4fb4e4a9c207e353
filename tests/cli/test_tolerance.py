"""``--tolerance-mm`` and ``--certificate``, what is stated of arm and instrument, and what a report is traced back to."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from cli.conftest import Refused

from modcal_msgs_py.descriptions import digest
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
    assert "was made from this very recording" in (tmp_path / "out" / "certificate.html").read_text()
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
