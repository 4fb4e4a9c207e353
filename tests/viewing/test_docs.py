"""What docs/live_view.md shows works, and its tables name what there is."""

from __future__ import annotations

import re
from pathlib import Path

import click
from nodes.test_launching import SPACES

from modcal_nodes.cli.main import modcal

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
