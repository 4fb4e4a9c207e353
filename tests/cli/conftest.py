"""A recording and its calibration, made once for all tests of verbs, and how a refusal looks."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from cli.recordings import stations

from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

Refused = Callable[..., str]


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``bag``, of 80 stations, and ``a``, its calibration of geometry alone, with a certificate."""
    here = tmp_path_factory.mktemp("verbs")
    write_recording(stations(80), here / "bag")
    (here / "cell.yaml").write_text("certificate: {robot: cell 3, instrument: AT960 no. 7}\n")
    asked = ["--tolerance-mm", "5", "--certificate", "--serial", "SN-4711", "--cell", str(here / "cell.yaml")]
    assert run(["calibrate", str(here / "bag"), "--geometry-only", *asked, "--out", str(here / "a")]) == 0
    return here


@pytest.fixture
def refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> Refused:
    """Asserts that a verb refuses in one line of these words (a pattern), and leaves what is in tmp_path as it was."""

    def check(arguments: list[str], said: str) -> str:
        before = sorted(path.name for path in tmp_path.iterdir())
        capfd.readouterr()
        assert run(arguments) == 2
        out, line = capfd.readouterr()
        assert (out, line.count("\n")) == ("", 1)
        assert line.startswith("modcal: ")
        assert re.search(said, line), line
        assert sorted(path.name for path in tmp_path.iterdir()) == before
        return line

    return check
