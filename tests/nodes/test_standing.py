"""What the calibrator says of the trusted model: OK only at the floor, else a warning with reasons or the remedy."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from report.judged import CANNOT, FLOOR, OPEN, WHY
from report.reports import points

from modcal_core.online.supervisor import Policy, Supervisor
from modcal_core.report.as_json import to_json_data
from modcal_core.report.words import sentence
from modcal_core.verdict.verdict import Verdict
from modcal_nodes.calibrating.diagnostics import Standing, model_status, standing_of, standing_of_json
from modcal_nodes.ros.subscriptions import ERROR, OK, WARN, Status
from modcal_nodes.watching.snapshot import OURS, Changes, Heard


def told(standing: Standing | None, verdict: str = "A result.", trouble: str = "") -> Status:
    return model_status(Supervisor(Policy()), verdict, standing, trouble, False, None)


@pytest.mark.parametrize(
    ("verdict", "level", "words"),
    [
        (FLOOR, OK, "At the floor: the residual is as small as"),
        (OPEN, WARN, "Open: 48 of 160 stations were rejected."),
        (CANNOT, WARN, CANNOT.remedy),
        (None, WARN, "no floor is known"),
    ],
)
def test_only_the_floor_is_ok(verdict: Verdict | None, level: bytes, words: str) -> None:
    report = replace(points(), judged=verdict)
    for said in ("continuing with the saved model", sentence(report)):
        status = told(standing_of(report), said)
        assert status.level == level
        assert said.rstrip(".") in status.message
        assert status.message.count(words) == 1
        assert status.values["status"] == report.status
    if verdict is OPEN:
        assert status.values["because"] == " ".join(reason.sentence for reason in WHY)


def test_without_a_model_nothing_is_ok() -> None:
    assert told(None, "nothing solved yet").level == WARN
    assert told(standing_of(replace(points(), judged=FLOOR)), trouble="different kinematics").level == ERROR


@pytest.mark.parametrize("verdict", [FLOOR, OPEN, CANNOT])
def test_a_saved_report_says_the_same(verdict: Verdict) -> None:
    report = replace(points(), judged=verdict)
    again, live = standing_of_json(json.dumps(to_json_data(report))), standing_of(report)
    assert again is not None
    assert replace(again, line="") == replace(live, line="")
    assert told(live).values["claim p95 [mm]"] == f"{report.claim.mm['p95'].ci95[1]:.4f}" if report.claim else "none"
    for old in (None, "", "{}", '{"status": "fine", "open_because": [], "remedy": null}', "[1]"):
        assert standing_of_json(old) is None


def test_watch_shows_it() -> None:
    heard, changes = Heard(), Changes()
    status = told(standing_of(replace(points(), judged=OPEN)))
    level = int.from_bytes(status.level, "little")
    facts = {name: str(value) for name, value in status.values.items()}
    heard.status("/calibrator: model", OURS, level, status.message, facts, 0.0)
    (line,) = changes.lines(heard.snapshot(0.0))
    assert line.startswith("warn: /calibrator model: A result. Open: 48 of 160 stations were rejected.")
