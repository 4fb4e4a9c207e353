"""No public class name has two meanings in the three packages."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parents[2] / "ros2_ws" / "src"
PACKAGES = ("modcal_core", "modcal_msgs_py", "modcal_nodes")


def defined(source: str) -> set[str]:
    """Names of the public classes at the top of a module."""
    return {n.name for n in ast.parse(source).body if isinstance(n, ast.ClassDef) and not n.name.startswith("_")}


def twice(sources: dict[str, str]) -> dict[str, list[str]]:
    """Where names are defined that stand in more than one of these files."""
    places: dict[str, list[str]] = defaultdict(list)
    for place, source in sources.items():
        for name in defined(source):
            places[name].append(place)
    return {name: found for name, found in places.items() if len(found) > 1}


@pytest.mark.slow
def test_no_class_name_has_two_meanings() -> None:
    files = [f for package in PACKAGES for f in sorted((SRC / package / package).rglob("*.py"))]
    assert len(files) > 300
    assert twice({f.relative_to(SRC).as_posix(): f.read_text() for f in files}) == {}


def test_the_rule_catches_a_second_meaning() -> None:
    assert twice({"a.py": "class Frame: ...", "b.py": "class Frame: ...\nclass _Own: ..."}) == {
        "Frame": ["a.py", "b.py"]
    }
