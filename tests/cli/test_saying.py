"""Verbs speak to people on a terminal, to programs as JSON, and leave nothing half written when they are interrupted."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest
from cli.recordings import stations

from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

ROOT = Path(__file__).resolve().parents[2]
MODCAL = ROOT / ".venv" / "bin" / "modcal"
BAG = ROOT / "bags" / "ur10_cell"


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("said") / "bag"
    write_recording(stations(60), folder)
    return folder


def test_a_program_gets_the_report_and_nothing_else(
    bag: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(["calibrate", str(bag), "--geometry-only", "--out", str(out), "--json"]) == 0
    said = capfd.readouterr()
    assert json.loads(said.out) == json.loads((out / "report.json").read_text())
    assert said.err == ""
    assert run(["evaluate", str(out), str(bag), "--out", str(tmp_path / "again"), "--json"]) == 0
    assert json.loads(capfd.readouterr().out) == json.loads((tmp_path / "again" / "report.json").read_text())
    assert run(["info", str(bag), "--json"]) == 0
    seen = json.loads(capfd.readouterr().out)
    assert seen["robot"]["tip"] == "tool0"
    assert {t["topic"]: t["count"] for t in seen["topics"]} == {"/joint_states": 60, "/tracker/pose": 60}


def test_every_stage_is_said_when_it_is_asked_for(bag: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["calibrate", str(bag), "--geometry-only", "--out", str(tmp_path / "out"), "-v"]) == 0
    lines = capfd.readouterr().err.splitlines()
    stages = [re.fullmatch(r"(.*): \d+\.\d s", line)[1] for line in lines]  # type: ignore[index]
    assert stages == ["reading bag", "fitting the geometry", "writing the report"]


def test_a_terminal_sees_progress_and_is_left_clean(bag: Path, tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    done = subprocess.Popen(
        [MODCAL, "calibrate", bag, "--geometry-only", "--out", tmp_path / "out"],
        stdout=subprocess.PIPE, stderr=theirs, env={**os.environ, "TERM": "xterm", "COLUMNS": "100"},
    )  # fmt: skip
    os.close(theirs)
    seen = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        seen += part
    result, _ = done.communicate(timeout=60)
    os.close(ours)
    assert done.returncode == 0
    assert b"the geometry" in seen
    assert b"Report: " in result
    assert b"the geometry" not in result
    assert seen.rstrip().endswith((b"\x1b[2K", b"\x1b[?25h"))  # wiped, and the cursor is back


def test_an_interrupted_calibration_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with subprocess.Popen([MODCAL, "calibrate", BAG, "--out", out, "-v"], stderr=subprocess.PIPE, text=True) as done:
        assert done.stderr is not None
        assert done.stderr.readline().startswith("reading ur10_cell: ")  # it is fitting now
        time.sleep(0.3)
        done.send_signal(signal.SIGINT)
        assert done.wait(60) == 130
        assert "Traceback" not in done.stderr.read()
    assert not list(tmp_path.iterdir())
