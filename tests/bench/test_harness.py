"""What benches share: options by their defaults, tasks by parts and seeds, tables by groups, exit codes."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

BENCH = Path(__file__).resolve().parents[2] / "bench"
ROWS = [
    {"part": "a", "seed": 0, "mm": 1.0, "good": True, "failed": None},
    {"part": "a", "seed": 1, "mm": 3.0, "good": False, "failed": None},
    {"part": "b", "seed": 0, "mm": None, "good": True, "failed": None},
    {"part": "b", "seed": 1, "failed": "ValueError: no"},
]


@pytest.fixture(scope="module")
def harness() -> Iterator[ModuleType]:
    before, known = list(sys.path), "harness" in sys.modules
    sys.path.insert(0, str(BENCH))
    yield importlib.import_module("harness")
    sys.path[:] = before
    if not known:
        sys.modules.pop("harness")


def test_options_are_of_the_type_of_their_default(harness: ModuleType) -> None:
    made = harness.parser(
        "A bench.", seeds=3, names=("one", "two"), share=0.5, quick=False, keep=Path, sizes=[1], how=("x", "y")
    )
    given = harness.parsed(made, [])
    assert (given.share, given.quick, given.keep, given.sizes, given.how) == (0.5, False, None, [1], "x")
    words = ["--share", "1", "--quick", "--keep", "out", "--sizes", "2", "3", "--how", "y", "--only", "two"]
    given = harness.parsed(made, words)
    assert (given.share, given.quick, given.keep, given.sizes, given.how) == (1.0, True, Path("out"), [2, 3], "y")
    assert given.names == ["two"]
    assert harness.told(given, "share", "how") == {"share": 1.0, "how": "y"}
    with pytest.raises(SystemExit):
        harness.parsed(made, ["--how", "z"])


def test_tasks_have_as_many_seeds_as_are_asked_for_or_usual(harness: ModuleType) -> None:
    made = harness.parser("A bench.", seeds=None, names=("one", "two"))
    usual = harness.tasks(harness.parsed(made, []), {"one": 2, "two": 1}, part=("one", "two"))
    assert usual == [{"part": "one", "seed": 0}, {"part": "one", "seed": 1}, {"part": "two", "seed": 0}]
    asked = harness.parsed(made, ["--seeds", "1", "--first", "7"])
    assert harness.tasks(asked, {"one": 2, "two": 1}, part=["one"]) == [{"part": "one", "seed": 7}]


def test_parts_go_by_the_first_value_and_failures_are_kept(
    harness: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    given = harness.parsed(harness.parser("A bench.", seeds=0), ["--jobs", "1"])
    parts = {"a": lambda task: {"x": 2 * task["n"]}, "b": lambda task: {"x": 1 // task["n"]}}
    results = harness.each(parts, [{"part": "a", "n": 4}, {"part": "b", "n": 0}], given)
    assert results[0]["x"] == 8
    assert "ZeroDivisionError" in results[1]["failed"]
    assert harness.ended(results[:1], ("all", True)) == 0
    assert harness.ended(results) == 1
    assert harness.ended(results[:1], ("a limit", False)) == 1
    assert "not met: a limit" in capsys.readouterr().out


def test_a_summary_has_a_row_a_group_without_what_failed(
    harness: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = {"mean": harness.over("mm", np.mean), "good": harness.over("good", harness.share)}
    harness.summary("sizes", ROWS, "part", columns, sums=True)
    lines = [line.replace("│", " ").split() for line in capsys.readouterr().out.splitlines() if "│" in line]
    assert lines == [
        ["a", "2", "2", "1", "of", "2"],
        ["b", "1", "–", "1", "of", "1"],
        ["all", "3", "2", "2", "of", "3"],
    ]
    assert [len(rs) for rs in harness.grouped(ROWS, "part", "seed").values()] == [1, 1, 1]


def test_a_share_has_the_interval_of_clopper_and_pearson(harness: ModuleType) -> None:
    assert harness.interval(0, 10) == pytest.approx((0.0, 1.0 - 0.025**0.1))
    assert harness.interval(10, 10, 0.9) == pytest.approx((0.05**0.1, 1.0))
