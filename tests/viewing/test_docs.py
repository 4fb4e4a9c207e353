"""What docs/live_view.md shows works, and its tables name what there is."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import click
import pytest
from nodes.test_launching import SPACES

from modcal_nodes.cli.main import modcal

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "live_view.md").read_text()


def test_the_example_prints_what_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    (program,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(program, "docs/live_view.md", "exec"), {})
    said = re.findall(r"print\(.*\)  # (.*)", program)
    assert len(said) == 2
    numbers = [[float(x) for x in re.findall(r"-?\d[\d.e-]*", line)] for line in printed.getvalue().splitlines()]
    assert numbers[0] == pytest.approx([0.0, 0.0, 1e-3], abs=1e-12)
    assert printed.getvalue().splitlines()[0].endswith("True")
    assert numbers[1] == pytest.approx([float(x) for x in said[1].strip("[]").split()])


def test_every_namespace_is_in_the_table() -> None:
    rows = dict(re.findall(r"^\| `(/[\w/]+)` \| [^|]+ \| ([^|]*) \|", TEXT, re.MULTILINE))
    for topic, spaces in SPACES.items():
        assert set(re.findall(r"`(\w+)`", rows[topic])) == spaces


def test_every_option_is_in_the_table() -> None:
    command = modcal.get_command(click.Context(modcal), "watch")
    assert command is not None
    options = {o for p in command.params for o in p.opts if o.startswith("--")}
    assert set(re.findall(r"`(--[\w-]+)[ `]", TEXT)) == options
