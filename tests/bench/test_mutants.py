"""The sample of mutants fits the sources, and is found again after code has moved."""

from __future__ import annotations

import ast
import importlib
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "bench" / "mutants"
MIN = 60  # mutants that make a sample


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> dict[str, ModuleType]:
    monkeypatch.syspath_prepend(str(FOLDER))
    yield {"fragments": importlib.import_module("fragments")}
    sys.modules.pop("fragments", None)


@pytest.mark.slow
def test_the_sample_fits_the_sources(bench: dict[str, ModuleType]) -> None:
    fragments = bench["fragments"]
    sample = fragments.sample()
    assert not [name for name, count in Counter(m.name for m in sample).items() if count > 1]
    marks: dict[Path, dict[int, list[str]]] = {}
    texts: dict[Path, str] = {}
    for mutant in sample:
        try:
            place = fragments.find(ROOT, mutant)  # which also compiles it
        except fragments.NotApplicable:
            continue
        assert place.mutated(mutant.new) != place.text
        marks.setdefault(place.path, {}).setdefault(place.line, []).append(mutant.name)
        texts[place.path] = place.text
    assert sum(len(names) for lines in marks.values() for names in lines.values()) >= MIN
    for path, lines in marks.items():
        ast.parse(fragments.marked(texts[path], lines))


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    package = tmp_path / "ros2_ws" / "src" / "core" / "core" / "rooms"
    package.mkdir(parents=True)
    (package / "one.py").write_text("def f(x):\n    if x:\n        return 1\n    elif x < 2:\n        return 2\n")
    (package / "two.py").write_text(
        "class A:\n    def g(self):\n        return [\n            1,\n            2,\n        ]\n"
    )
    return tmp_path


def test_a_mutant_is_found_where_its_function_has_gone(bench: dict[str, ModuleType], checkout: Path) -> None:
    Mutant, find = bench["fragments"].Mutant, bench["fragments"].find
    place = find(checkout, Mutant("", "elsewhere.A.g", "", "1, 2", "1, 3"))
    assert (place.path.name, place.line) == ("two.py", 3)
    assert "return [\n            1, 3,\n" in place.mutated("1, 3")


def test_a_mark_stands_before_the_whole_of_a_condition(bench: dict[str, ModuleType], checkout: Path) -> None:
    place = bench["fragments"].find(checkout, bench["fragments"].Mutant("", "one.f", "", "x < 2", "x <= 2"))
    assert place.line == 2
    ast.parse(bench["fragments"].marked(place.text, {place.line: ["a", "b"]}))


@pytest.mark.slow
@pytest.mark.parametrize(("function", "old"), [("one.f", "x > 2"), ("one.f", "return"), ("one.h", "x < 2")])
def test_a_mutant_that_is_gone_says_so(bench: dict[str, ModuleType], checkout: Path, function: str, old: str) -> None:
    with pytest.raises(bench["fragments"].NotApplicable, match=f"{function}: m: "):
        bench["fragments"].find(checkout, bench["fragments"].Mutant("", function, "m", old, "0"))
