"""A short run of `make fuzz`: no exception but refusals, none slow, in little memory; and the fuzzer itself is sharp."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "bench" / "fuzz"
SECONDS = {"mcap": 2.5}  # the other ten targets: 0.8 each
LARGEST_MIB = 1024


@pytest.fixture(scope="module")
def bench() -> Iterator[dict[str, ModuleType]]:
    before, known = list(sys.path), set(sys.modules)
    sys.path.insert(0, str(FOLDER))
    names = ("cases", "targets", "run")
    yield {name: importlib.import_module(name) for name in names}
    sys.path[:] = before
    for name in set(sys.modules) - known:
        if name in names:
            sys.modules.pop(name)


@pytest.mark.slow
def test_ten_seconds_of_hostile_input(bench: dict[str, ModuleType], tmp_path: Path) -> None:
    """Of processor; `make fuzz` takes five minutes, because a fault that is left is found by numbers alone."""
    for target in bench["run"].targets(tmp_path):
        found = bench["run"].fuzz(target, 0, SECONDS.get(target.name, 0.8))
        assert not found.faults, (target.name, found.examples)
        assert found.cases > 30
        assert found.refused < found.cases, target.name
        assert found.refused > 0 or target.name == "report"


def test_whatever_is_not_changed_is_read(bench: dict[str, ModuleType], tmp_path: Path) -> None:
    """The bases are good, and putting a file together again changes nothing: else every case would be refused."""
    cases = bench["cases"]
    for target in bench["targets"].targets(tmp_path):
        if target.name != "images":
            target.run(target.good)
        if target.name == "mcap":
            target.run(cases.whole(cases.parts(target.good)))


def test_a_fault_is_found_and_named(bench: dict[str, ModuleType]) -> None:
    target = bench["targets"].Target("x", lambda rng: int(rng.integers(50)), lambda case: 1 // case and None, 1)
    found = bench["run"].fuzz(target, 3, 0.0, cases=400)
    (key,) = found.faults
    assert key.startswith("ZeroDivisionError at test_fuzz.py")
    number, said = found.examples[key]
    assert "ZeroDivisionError" in said
    assert bench["run"].fuzz(target, 3, 0.0, cases=1, first=number).faults


def test_cases_are_the_same_every_time_and_differ_among_themselves(
    bench: dict[str, ModuleType], tmp_path: Path
) -> None:
    target = bench["targets"].mcap_target(tmp_path)
    made = [target.make(np.random.default_rng([0, k])) for k in range(60)]
    assert made == [target.make(np.random.default_rng([0, k])) for k in range(60)]
    assert len(set(made)) > 55
