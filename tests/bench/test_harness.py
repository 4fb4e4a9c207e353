"""What benches share, their names, the mutants' sample, and numbers that are moved."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from modcal_msgs_py.mcap_read import read_recording

BENCH = Path(__file__).resolve().parents[2] / "bench"


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


def test_a_share_has_the_interval_of_clopper_and_pearson(harness: ModuleType) -> None:
    assert harness.interval(0, 10) == pytest.approx((0.0, 1.0 - 0.025**0.1))
    assert harness.interval(10, 10, 0.9) == pytest.approx((0.05**0.1, 1.0))


ROOT = Path(__file__).resolve().parents[2]


def _bench(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "scripts" / "bench.py"), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_list_has_a_line_for_every_bench() -> None:
    lines = _bench().stdout.splitlines()[1:]
    named = {line.split(None, 1)[0]: line.split(None, 1)[1] for line in lines}
    folders = {file.parent.name for file in (ROOT / "bench").glob("*/run.py")}
    assert folders | {"delta", "outside"} <= named.keys()
    assert "harness" not in named
    assert all(len(words) > 20 for words in named.values()), named


def test_an_unknown_name_is_refused_with_the_list() -> None:
    done = _bench("nothing")
    assert (done.returncode, done.stdout) == (2, "")
    assert "no bench is called nothing" in done.stderr
    assert "  doors " in done.stderr


def test_make_has_the_targets_of_daily_work_and_no_other() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)) - {"reference"}
    daily = (
        "help setup setup-test build packages demo week test suite quick lint ruff mypy format docs wheel lock clean"
    )
    assert targets == {*daily.split(), "bench", "fuzz", "league", "mutants"}


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


@pytest.mark.slow
@pytest.mark.parametrize(("function", "old"), [("one.f", "x > 2"), ("one.f", "return"), ("one.h", "x < 2")])
def test_a_mutant_that_is_gone_says_so(bench: dict[str, ModuleType], checkout: Path, function: str, old: str) -> None:
    with pytest.raises(bench["fragments"].NotApplicable, match=f"{function}: m: "):
        bench["fragments"].find(checkout, bench["fragments"].Mutant("", function, "m", old, "0"))


UNDECLARED = Path(__file__).resolve().parents[2] / "bench" / "undeclared"


@pytest.fixture
def planted(monkeypatch: pytest.MonkeyPatch) -> dict[str, ModuleType]:
    monkeypatch.syspath_prepend(str(UNDECLARED.parent))
    monkeypatch.syspath_prepend(str(UNDECLARED))
    modules = {name: importlib.import_module(name) for name in ("scenarios", "recordings", "score")}
    yield modules
    for name in modules:
        sys.modules.pop(name, None)


def test_a_fault_is_in_the_bag_and_not_named_there(planted: dict[str, ModuleType], tmp_path: Path) -> None:
    first, _, truth = planted["recordings"].make("gear_harmonic", "ur10", 0, tmp_path, 20)
    recording = read_recording(first)
    assert sum(len(r.stamps) for r in recording.readings) == 20
    assert all(b"gear_harmonic" not in p.read_bytes() for p in first.rglob("*") if p.is_file())
    assert truth.parent not in first.parents
