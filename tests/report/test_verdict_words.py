"""What a person and a program read of a verdict: the sentence, report.json and its page in docs."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.recordings import stations
from report.judged import CANNOT, FLOOR, OPEN, ROWS, WHY, everything
from report.reports import delta, page_of, points, warm_cell

from modcal_core.calibration.known_distances import KnownDistance
from modcal_core.diagnosis.choice import EffectChoice
from modcal_core.measurements.samples import cut_stations
from modcal_core.outcome.contents import STAGES, Outcome
from modcal_core.report.report import to_json_data
from modcal_core.report.tables import NOT_SOUGHT, REMEDY, account_tables, sentence
from modcal_core.verdict.floor import reading_scatter_mm
from modcal_core.verdict.tolerance import Asked
from modcal_core.verdict.verdict import Row, Verdict


def judged(report: Outcome, verdict: Verdict) -> Outcome:
    return replace(report, judged=verdict)


def test_no_verdict_is_calm_about_what_is_not_known() -> None:
    for verdict in (None, FLOOR, OPEN, CANNOT):
        said = sentence(replace(points(), judged=verdict))
        assert "noise" not in said
        assert "stands out from" not in said
    assert REMEDY in sentence(replace(points(), judged=None))


@pytest.mark.parametrize(
    ("verdict", "words"),
    [
        (FLOOR, "At the floor: the residual is as small as this arm and this instrument allow (0.055 mm, from"),
        (OPEN, "Open: 48 of 160 stations were rejected. A regressor predicts 20 % of the squared error. And 1 more"),
        (CANNOT, "Cannot tell whether the rest is the floor: no floor is known. Visit six of these postures twice."),
    ],
)
def test_the_sentence_by_status(verdict: Verdict, words: str) -> None:
    assert words in sentence(judged(warm_cell(), verdict))


def test_what_the_parameters_leave_is_not_said_to_be_the_arm() -> None:
    """Thirty points: 0.071 mm was left, and the sentence said that this was as small as 0.048 mm allow."""
    assert FLOOR.floor_mm is not None
    small, large = (
        (*ROWS, replace(ROWS[-1], what="estimation", value=share * FLOOR.floor_mm**2)) for share in (0.3, 1.0)
    )
    more = "more different postures would make it smaller"
    assert more not in sentence(judged(warm_cell(), replace(FLOOR, account_mm2=small)))
    said = sentence(judged(warm_cell(), replace(FLOOR, account_mm2=large)))
    assert f"tell the parameters, which leaves {FLOOR.floor_mm:.3f} mm by itself: {more}." in said


def test_the_source_of_a_floor_is_said_once_where_it_is_one() -> None:
    assert "(0.055 mm, from postures visited again and 0.004°, as stated)" in sentence(judged(warm_cell(), FLOOR))
    both = replace(FLOOR, repeatability_deg=FLOOR.repeatability_mm)
    assert "(0.055 mm and 0.004°, from postures visited again)" in sentence(judged(warm_cell(), both))


def test_the_sentence_counts_what_was_scored_and_what_was_not() -> None:
    """Three of the 120 stations are 8.7 mm off; how many of them were held out is up to the split."""
    report = warm_cell()
    rows = report.sets.held_out
    out = int(report.wrong[rows].sum())
    assert out == 1
    both, kept = report.residuals[rows], report.residuals[rows][~report.wrong[rows]]
    rms = [1e3 * float(np.sqrt(np.mean(m**2))) for m in (both, kept)]
    angle = report.size_deg("final")
    assert angle is not None
    said = sentence(report)
    assert said.startswith("120 stations. On the 36 held out from fitting the error is ")
    assert f"the error is {rms[1]:.3f} mm RMS and {angle.rms:.3g}°" in said
    with_them = f"{rms[0]:.3f} mm RMS with them, {rms[1]:.3f} mm without."
    assert f"3 of 120 stations were rejected and are not in the figures: {with_them}" in said
    assert rms[0] > 20.0 * rms[1]
    assert sentence(points()).startswith("60 stations, none rejected. On the 18 held out from fitting the error is ")


def test_geometry_only_says_what_was_not_looked_for() -> None:
    assert NOT_SOUGHT in sentence(points())
    assert NOT_SOUGHT not in sentence(warm_cell())


def test_report_json_has_the_fields_of_the_verdict() -> None:
    report = everything()
    data = json.loads(json.dumps(to_json_data(report), allow_nan=False))
    assert data["status"] == "open"
    assert data["open_because"] == [reason.sentence for reason in WHY]
    assert data["converged"] is False
    assert data["noise_floor_mm"] == 0.04
    assert data["account_mm2"] == [
        {"what": "geometry", "value": 7.5, "ci95": [7.0, 8.0]},
        {"what": "effect:gear_harmonic elbow_joint", "value": 0.25, "ci95": None},
        {"what": "unaccounted", "value": -0.05, "ci95": None},
    ]
    assert data["account_deg2"] == data["account_mm2"][:1]
    assert data["predictable"] == {"share": 0.2, "ci95": [0.1, 0.3]}
    assert data["predictable_deg"] == {"share": 0.01, "ci95": [0.0, 0.02]}
    assert data["repeatability_mm"] == {"value": 0.05, "source": "revisits"}
    assert data["repeatability_deg"] == {"value": 0.004, "source": "stated"}
    assert to_json_data(judged(warm_cell(), OPEN))["repeatability_mm"] == {"value": None, "source": None}
    assert data["not_applied"] == [
        {"effect": "compliance at elbow_joint", "why": "effort was not recorded", "cost_mm2": 0.004}
    ]
    assert data["regimes"] == [{"from_station": 0, "to_station": 11, "what": "tool"}]
    assert data["convention"] == "pose inverted"
    assert data["recording"]["dropped"] == {"readings outside the time of the joint states": 12}
    assert set(data["tolerance"]) >= {"asked_mm", "statistic", "ci95", "result"}
    assert data["tolerance"]["result"] == "CANNOT TELL"  # too many were rejected
    assert data["trace"] == {
        "version": report.trace.version,
        "date": "2023-11-14T22:13:20.000Z",
        "bag_sha256": "ab" * 32,
        "robot": "ur10",
        "instrument": "pose on /tracker/pose",
    }


def test_what_is_not_known_is_null() -> None:
    data = to_json_data(replace(points(), judged=None))
    assert data["status"] == "cannot_tell"
    for name in ("noise_floor_mm", "account_mm2", "predictable", "repeatability_deg", "convention", "tolerance"):
        assert data[name] is None, name
    assert data["open_because"] == data["not_applied"] == data["regimes"] == []
    assert to_json_data(judged(points(), CANNOT))["noise_floor_mm"] is None


def test_the_scatter_within_stations_is_no_floor() -> None:
    """Ten readings of a dwell scatter by 20 µm along each axis: their mean is off by √3 · 20 µm / √10 in space."""
    made = stations(80)
    t, rng = made.readings[0].stamps, np.random.default_rng(0)
    q = np.repeat(made.joints[0].position, 21, axis=0)
    dense = (t[:, None] + np.linspace(0.0, 1.0, 21)).ravel()
    poses = np.repeat(made.readings[0].values, 10, axis=0)
    poses[:, :3] += 2e-5 * rng.standard_normal((len(poses), 3))
    joint = replace(made.joints[0], stamps=dense, position=q, velocity=np.full_like(q, np.nan), effort=q * np.nan)
    reading = replace(
        made.readings[0], stamps=(t[:, None] + np.linspace(0.46, 0.94, 10)).ravel(), values=poses, received=None
    )
    recording = replace(made, joints=(joint,), readings=(reading,))
    scatter = reading_scatter_mm(cut_stations(recording, joint.names))
    assert scatter == pytest.approx(np.sqrt(3.0) * 2e-2 / np.sqrt(10.0), rel=0.1)


@pytest.mark.parametrize(("left", "shown"), [(0.1, "10.00 %"), (14.61, "cannot be divided")])
def test_shares_are_of_one_whole_and_never_beyond_it(left: float, shown: str) -> None:
    """What a frozen calibration leaves may be many times the nominal error: no share of that."""
    rows = (Row("geometry", 1.0 - left, None), Row("unaccounted", left, None))
    (table,) = account_tables(replace(FLOOR, account_mm2=rows, account_deg2=None))
    assert [row[2] for row in table.rows[1:]] == [shown, "100.00 %"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verdict", "tone", "heading"),
    [(FLOOR, "good", "at the floor"), (OPEN, "bad", "open"), (CANNOT, "warn", "cannot tell"), (None, "warn", "cannot")],
)
def test_the_colour_of_the_page_is_that_of_the_status(verdict: Verdict | None, tone: str, heading: str) -> None:
    page = page_of(replace(points(), judged=verdict))
    assert f'<p class="verdict {tone}"><strong>Verdict: {heading}' in page
    assert ('class="reasons' in page) == (verdict is OPEN)


@pytest.mark.slow
def test_the_page_shows_the_account_and_the_reasons() -> None:
    report = judged(warm_cell(), replace(OPEN, account_mm2=ROWS, account_deg2=ROWS[:1]))
    page = page_of(report.with_tolerance(Asked(0.2)))
    for reason in WHY:
        assert f"<li>{reason.sentence}</li>" in page
    assert page.count('aria-label="Account in ') == 2  # one in mm², one in deg²
    assert '<th scope="row">gear_harmonic elbow_joint</th>' in page
    assert '<b class="warn">CANNOT TELL:</b>' in page
    rms = report.rejection
    assert rms is not None
    said = f"{rms.with_mm:.3f} mm RMS with them, {rms.without_mm:.3f} mm without."
    assert (
        page.count(f"stations were rejected and are not in the figures: {said}") == 2
    )  # in the answer and by the error


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
