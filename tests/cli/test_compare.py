"""``modcal compare`` and ``--certificate``: files, exit codes, and refusals that write nothing."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from cli.recordings import stations

from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag, and its calibration with a certificate."""
    here = tmp_path_factory.mktemp("compare")
    write_recording(stations(60), here / "bag")
    cell = "certificate: {robot: cell 3, instrument: AT960 no. 7}\n"
    (here / "cell.yaml").write_text(cell)
    options = [
        "--geometry-only",
        "--tolerance-mm",
        "5",
        "--certificate",
        "--serial",
        "SN-4711",
        "--cell",
        str(here / "cell.yaml"),
    ]
    assert run(["calibrate", str(here / "bag"), *options, "--out", str(here / "a")]) == 0
    return here


def test_the_certificate_names_robot_serial_instrument_and_hashes(folder: Path) -> None:
    page = (folder / "a" / "certificate.html").read_text()
    trace = json.loads((folder / "a" / "report.json").read_text())["trace"]
    for text in ("cell 3", "SN-4711", "AT960 no. 7", "PASS, with reservations", trace["bag_sha256"]):
        assert text in page


def test_evaluating_the_own_recording_is_said(folder: Path, tmp_path: Path) -> None:
    arguments = ["evaluate", str(folder / "a"), str(folder / "bag"), "--out", str(tmp_path / "out")]
    assert run([*arguments, "--tolerance-mm", "5", "--certificate"]) == 3  # nothing is proven by what was fitted to
    page = (tmp_path / "out" / "certificate.html").read_text()
    assert "was made from this very recording" in page
    assert "<title>a, evaluated on bag</title>" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--certificate"], "--certificate: has no tolerance"),
        (["--serial", "1"], "--serial: is printed on a certificate only"),
    ],
)
def test_what_a_certificate_needs(
    folder: Path, tmp_path: Path, options: list[str], said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(["calibrate", str(folder / "bag"), *options, "--out", str(tmp_path / "out")]) == 2
    assert said in capfd.readouterr().err
    assert not (tmp_path / "out").exists()


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
def test_a_damaged_report_is_refused(
    folder: Path, tmp_path: Path, text: str, said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "report.json").write_text(text)
    arguments = ["compare", str(folder / "a"), str(tmp_path / "report.json"), "--out", str(tmp_path / "out")]
    assert run(arguments) == 2
    assert said in capfd.readouterr().err
    assert not (tmp_path / "out").exists()
