"""docs/report.md names every field of report.json, and its example runs."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from report.judged import everything
from report.reports import delta, warm_cell

from modcal_core.calibration.known_distances import KnownDistance
from modcal_core.diagnosis.choice import EffectChoice
from modcal_core.outcome.contents import STAGES
from modcal_core.report.as_json import to_json_data

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "report.md").read_text()


def paths(data: Any, at: str = "") -> set[str]:
    """Where the numbers and texts of nested data stand, in the notation of the document."""
    if isinstance(data, dict):
        if at.endswith((".parameters", ".dropped", "apply_within")):
            return {path for value in data.values() for path in paths(value, f"{at}.NAME")}
        return {path for key, value in data.items() for path in paths(value, f"{at}.{key}" if at else key)}
    if at == "unproved" and data:  # entries as in effects
        return {"unproved[]"}
    if isinstance(data, list):
        return {path for value in data for path in paths(value, f"{at}[]")}
    return {re.sub(rf"\.({'|'.join(STAGES)})\b", ".STAGE", at)} if data is not None else set()


@pytest.mark.slow
def test_every_field_is_documented_and_every_documented_field_exists() -> None:
    report = warm_cell()
    assert report.identifiability is not None
    assert report.model is not None
    open_ended = replace(
        report,
        left=EffectChoice(report.model.effects[0], 1e-4, ("something else",), 0.5),
        identifiability=replace(report.identifiability, unobservable=("a",), weak=(("b with c", 0.4),)),
        notes=("A note.",),
        distances=(KnownDistance("a to b", 0.05, 5e-5, -1e-6, 0.05, 1e-4),),
    )
    named = tuple(replace(f, same_as=("another",)) for f in report.effects)
    rivals = replace(report, effects=named, unproved=report.effects[:1])
    assert report.claim is not None
    held = replace(report, claim=replace(report.claim, unshown_mm=1e3, ranges={"a": (-1.0, 1.0)}))
    found = set.union(*(paths(to_json_data(r)) for r in (report, open_ended, rivals, held, everything(), delta())))
    fields = TEXT.split("## Fields of report.json")[1]
    documented = re.findall(r"^\| `([^`]+)` \|", fields, re.MULTILINE)
    assert len(documented) == len(set(documented))
    assert set(documented) == found


@pytest.mark.slow
def test_the_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (program,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    data = to_json_data(warm_cell())
    (tmp_path / "report.json").write_text(json.dumps(data))
    monkeypatch.chdir(tmp_path)
    exec(compile(program, "docs/report.md", "exec"), {})
    assert len(capsys.readouterr().out.splitlines()) == len(data["steps"])
