"""Size is a cost: a ceiling for every package, which may fall and not rise.

A package that needs more takes it from another one; one that has shrunk lowers its ceiling, so that what was saved stays
saved. ``python scripts/size.py`` prints the counts.
"""

from __future__ import annotations

import runpy
import subprocess
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]

# Package: lines and statements at most.
CEILINGS: dict[str, tuple[int, int]] = {
}  # fmt: skip
SOURCE = (0, 0)
TEXT = 0  # lines of all tracked text but the bags, so that nothing hides in examples, scripts, templates or YAML
FORMAT_SKIPS = 0
SLACK = 1.03  # a ceiling may stand so far above what there is


@pytest.fixture(scope="module")
def found() -> Any:
    if subprocess.run(["git", "rev-parse"], cwd=ROOT, capture_output=True).returncode != 0:
        pytest.skip("not a git checkout")
    return runpy.run_path(str(ROOT / "scripts" / "size.py"))["sizes"](ROOT)


def within(what: str, count: int, ceiling: int) -> list[str]:
    """What is wrong with a count: above its ceiling, or so far below that the ceiling should follow."""
    if count > ceiling:
        return [f"{what}: {count}, at most {ceiling}: take it from elsewhere"]
    return [f"{what}: {count}, so lower the ceiling of {ceiling}"] if SLACK * count + 20 < ceiling else []


def test_every_package_keeps_to_its_ceiling(found: Any) -> None:
    assert set(found.packages) == set(CEILINGS)
    wrong = []
    for name, (lines, statements) in CEILINGS.items():
        wrong += within(f"{name}, lines", found.packages[name].lines, lines)
        wrong += within(f"{name}, statements", found.packages[name].statements, statements)
    assert not wrong


def test_all_together(found: Any) -> None:
    wrong = within("source, lines", found.source.lines, SOURCE[0])
    wrong += within("source, statements", found.source.statements, SOURCE[1])
    wrong += within("tracked text, lines", found.text, TEXT)
    skips = sum(path.read_text().count("# fmt: skip") for path in (ROOT / "ros2_ws" / "src").rglob("*.py"))
    assert not wrong + within("# fmt: skip", skips, FORMAT_SKIPS)


def test_a_ceiling_is_one() -> None:
    assert within("a", 101, 100)
    assert within("a", 60, 100)
    assert not within("a", 100, 100)
    assert not within("a", 90, 100)
