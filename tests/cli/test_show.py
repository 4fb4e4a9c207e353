"""What the terminal shows of a verdict: its sentence in the status's colour, the account, all reasons, the tolerance."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
from report.judged import CANNOT, FLOOR, OPEN, WHY, everything
from report.reports import points
from rich.console import Console

from modcal_core.outcome.contents import Outcome
from modcal_core.report.terminal import summary
from modcal_core.report.words import sentence
from modcal_core.verdict.verdict import Row, Verdict
from modcal_nodes.cli.console import show


def shown(report: Outcome, colours: bool = False) -> str:
    text = io.StringIO()
    plain = Console(
        file=text, width=300, force_terminal=colours, color_system="standard", markup=False, highlight=False
    )
    show(summary(report), plain)
    return text.getvalue()


@pytest.mark.parametrize(("verdict", "colour"), [(FLOOR, "32"), (OPEN, "31"), (CANNOT, "33"), (None, "33")])
def test_green_only_at_the_floor(verdict: Verdict | None, colour: str) -> None:
    report = replace(points(), judged=verdict)
    words = sentence(report)[:40]
    assert f"\x1b[1;{colour}m{words}" in shown(report, colours=True)


@pytest.mark.slow
def test_the_account_every_reason_and_the_tolerance() -> None:
    said = shown(everything())
    for reason in WHY:
        assert said.count(reason.sentence) >= 1
    assert "account of the squared error" in said
    assert "gear_harmonic elbow_joint" in said
    assert "CANNOT TELL: The tool's error over the recorded ranges (95th percentile) is" in said


def test_small_rows_of_the_account_stand_together() -> None:
    small = tuple(Row(f"effect:gear_harmonic joint_{k}", 0.01) for k in range(5))
    rows = (Row("geometry", 7.5), Row("effect:compliance elbow_joint", 0.5), *small)
    said = shown(replace(points(), judged=replace(OPEN, account_mm2=rows)))
    assert "compliance elbow_joint" in said
    assert "gear_harmonic" not in said
    (together,) = [line.split() for line in said.splitlines() if "5 effects of less than 1%" in line]
    assert together[-4] == "0.05"
    few = shown(replace(points(), judged=replace(OPEN, account_mm2=rows[:4])))
    assert "gear_harmonic joint_1" in few
    assert "effects of less than" not in few


def test_a_floor_that_is_not_known_is_not_zero() -> None:
    said = shown(points())
    lines = [line for line in said.splitlines() if line.startswith(("repeatability", "instrument"))]
    assert len(lines) == 2
    assert all(line.rstrip().endswith("not known") for line in lines)
