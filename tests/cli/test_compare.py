"""``modcal compare``: its file, exit codes, and refusals that write nothing."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from cli.conftest import Refused

from modcal_nodes.cli.main import run

pytestmark = pytest.mark.slow


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
