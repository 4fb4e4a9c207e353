"""Every number that results may depend on has a comment that gives its reason."""

from __future__ import annotations

import importlib
import json
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "scripts" / "reference"))

import module_numbers  # noqa: E402

SWEPT = ROOT / "bench" / "constants" / "constants.json"


@cache
def numbers() -> list[module_numbers.Number]:
    """Those of all files, which take seconds to read."""
    return module_numbers.numbers()


@pytest.mark.slow
def test_every_number_at_the_top_of_a_file_has_a_comment() -> None:
    assert len(numbers()) > 400
    assert not [f"{n.file}:{n.line} {n.name}" for n in numbers() if not n.comment]


@pytest.mark.parametrize(
    ("source", "comment"),
    [
        ("A = 3", ""),
        ("A = 3  # of a kind", "of a kind"),
        ("# by theory\nA = 3", "by theory"),
        ("# iterations\nB = 2\nA = 3", "iterations"),
        ("# iterations\nB = 2\n\nA = 3", ""),
        ("# far above\n\nA = 3", ""),
        ("A = 3  # noqa: E1", ""),
        ("A = (\n    3,  # m\n    -4.0,  # rad\n)", "m rad"),
        ("A: dict[str, float] = {'x': 0.5}", ""),
    ],
)
def test_where_a_comment_is_looked_for(source: str, comment: str) -> None:
    assert [n.comment for n in module_numbers.of_source(source) if n.name == "A"] == [comment]


def test_what_is_swept_is_a_number() -> None:
    swept = json.loads(SWEPT.read_text("utf-8"))
    assert len(swept) > 20
    for module, name in swept:
        assert type(getattr(importlib.import_module(module), name)) in (int, float), (module, name)
