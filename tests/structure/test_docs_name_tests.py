"""The tests that the documents point to exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(("document", "least"), [("faults.md", 25), ("bad_input.md", 9)])
def test_every_test_that_is_named_exists(document: str, least: int) -> None:
    named = re.findall(r"`([\w/]+\.py)::(test_\w+)`", (ROOT / "docs" / document).read_text())
    assert len(named) >= least
    for file, name in named:
        source = ROOT / "tests" / file
        assert source.is_file(), file
        assert re.search(rf"^def {name}\(", source.read_text(), re.MULTILINE), f"{file}::{name}"
