"""A snapshot of what was heard, what a person and a log see of it; and what docs/live_view.md shows works."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import click
import pytest
from modcal_interfaces.msg import Change, Estimate
from nodes.test_launching import SPACES
from rich.console import Console

from modcal_nodes.cli.main import modcal
from modcal_nodes.watching import Changes, Heard, table

FACTS = {"state": "trusted", "samples rejected": "3", "messages of /joint_states": "17"}


def heard() -> Heard:
    """A calibrator that is well, a corrector that is not, and a node of somebody else's."""
    out = Heard()
    out.status("/calibrator: model", "modcal", 0, "error is 0.05 mm", FACTS, 10.0)
    out.status("/calibrator: hearing", "modcal", 0, "everything that is needed is received", {}, 10.0)
    out.status("/arm/corrector: correction", "modcal", 2, "joint_states are 3 s off", {"poses": "5"}, 10.5)
    out.status("/drive: motor [4]", "vendor", 2, "hot", {}, 10.5)
    return out


def shown(snapshot: dict) -> str:
    console = Console(width=140, record=True, force_terminal=False)
    with console.capture() as capture:
        console.print(table(snapshot))
    return capture.get()


def test_nodes_of_ours_and_the_worst_of_them() -> None:
    data = heard().snapshot(11.0)
    assert [n["name"] for n in data["nodes"]] == ["/arm/corrector", "/calibrator"]
    assert [n["level"] for n in data["nodes"]] == ["error", "ok"]
    assert data["level"] == "error"
    assert data["nodes"][1]["heard_s_ago"] == 1.0
    assert data["nodes"][1]["parts"][0]["facts"] == FACTS
    assert Heard().snapshot(0.0) == {"modcal_watch": 1, "level": "ok", "nodes": []}


def test_a_namespace_leaves_out_the_others() -> None:
    for namespace in ("arm", "/arm", "/arm/"):
        some = Heard(namespace)
        for node in ("/arm/corrector", "/army/corrector", "/calibrator"):
            some.status(f"{node}: hearing", "modcal", 0, "", {}, 0.0)
        assert some.names == ("/arm/corrector",)


def test_who_says_nothing_is_silent() -> None:
    some = heard()
    some.status("/arm/corrector: correction", "modcal", 0, "poses are corrected", {}, 20.0)
    data = some.snapshot(20.5)
    assert {n["name"]: n["level"] for n in data["nodes"]} == {"/arm/corrector": "ok", "/calibrator": "silent"}
    assert "silent for 10 s; then: error is 0.05 mm" in shown(data)


def test_what_a_calibrator_publishes_beside() -> None:
    some = heard()
    some.value("/calibrator", "residual_m", 5e-5)
    some.value("/calibrator", "residual_before_m", math.nan)
    some.value("/calibrator", "trusted", False)
    some.value("/calibrator", "change", Change(changed=True, place="tool", sentence="tool has changed by 0.71 mm"))
    values, stds = [1.0, -8.0, 3.0, 4.0, math.nan, 5.0, 6.0], [*[1.0] * 6, 0.0]
    some.value("/calibrator", "estimate", Estimate(names=list("abcdefg"), values=values, stds=stds))
    some.value("/nobody", "residual_m", 1.0)
    node = some.snapshot(11.0)["nodes"][1]
    assert node["residual_m"] == 5e-5
    assert "residual_before_m" not in node
    assert node["change"]["place"] == "tool"
    # the farthest by their deviations; what has none, or is no number, is not among them
    assert [p["name"] for p in node["estimate"]] == ["b", "f", "d", "c", "a"]
    assert node["estimate"][0] == {"name": "b", "value": -8.0, "std": 1.0}
    json.dumps(some.snapshot(11.0), allow_nan=False)
    text = shown(some.snapshot(11.0))
    for words in ("0.0500 mm", "suspected", "tool has changed by 0.71 mm", "b -8 ± 1", "state trusted"):
        assert words in text
    assert "messages of" not in text


def test_a_change_that_is_none_or_has_no_size() -> None:
    some = heard()
    some.value("/calibrator", "change", Change())
    assert some.snapshot(11.0)["nodes"][1]["change"] is None
    assert "change:" not in shown(some.snapshot(11.0))
    some.value("/calibrator", "change", Change(changed=True, size_m=math.nan))
    assert some.snapshot(11.0)["nodes"][1]["change"]["size_mm"] is None


def test_names_of_another_model_are_not_put_to_numbers() -> None:
    some = heard()
    some.value("/calibrator", "estimate", Estimate(names=["a", "b"], values=[1.0] * 3, stds=[1.0] * 3))
    assert "estimate" not in some.snapshot(11.0)["nodes"][1]


def test_how_old_poses_are() -> None:
    some = heard()
    for delay in (0.001, 0.002, 0.009, math.nan):
        some.pose("/arm/corrector", delay, 2e-5)
    node = some.snapshot(11.0)["nodes"][0]
    assert node["delay_ms"]["median"] == 2.0
    assert node["delay_ms"]["p99"] == pytest.approx(8.86, abs=0.01)
    assert "std 0.020 mm" in shown(some.snapshot(11.0))


def test_words_of_others_are_not_taken_for_markup() -> None:
    some = Heard()
    some.status("/a[red]b: c[/d]", "modcal", 0, "[bold]no[/nonsense]", {"state": "[/]"}, 0.0)
    assert "[bold]no[/nonsense]" in shown(some.snapshot(0.0))


def test_a_log_has_a_line_where_something_gets_better_or_worse() -> None:
    some, log = heard(), Changes()
    assert len(log.lines(some.snapshot(11.0))) == 3
    assert log.lines(some.snapshot(12.0)) == []
    some.status("/calibrator: model", "modcal", 1, "tool has changed", {}, 12.0)
    some.status("/calibrator: hearing", "modcal", 0, "something else is heard", {}, 12.0)
    assert log.lines(some.snapshot(12.5)) == ["warn: /calibrator model: tool has changed"]
    assert [line.split(":")[0] for line in log.lines(some.snapshot(30.0))] == ["silent"] * 3


ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "live_view.md").read_text()


def test_every_namespace_is_in_the_table() -> None:
    rows = dict(re.findall(r"^\| `(/[\w/]+)` \| ([^|]*) \|", TEXT, re.MULTILINE))
    for topic, spaces in SPACES.items():
        assert set(re.findall(r"`(\w+)`", rows[topic])) == spaces


def test_options_of_the_page_are_those_of_the_command() -> None:
    command = modcal.get_command(click.Context(modcal), "watch")
    assert command is not None
    options = {o for p in command.params for o in p.opts if o.startswith("--")}
    named = set(re.findall(r"`(--[\w-]+)[ `]", TEXT))
    assert named
    assert named <= options
