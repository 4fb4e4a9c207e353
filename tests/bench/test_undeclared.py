"""The benchmark of planted faults is honest: it accepts the truth, and nothing else."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from modcal_msgs_py.mcap_read import read_recording

FOLDER = Path(__file__).resolve().parents[2] / "bench" / "undeclared"


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> dict[str, ModuleType]:
    monkeypatch.syspath_prepend(str(FOLDER.parent))
    monkeypatch.syspath_prepend(str(FOLDER))
    modules = {name: importlib.import_module(name) for name in ("scenarios", "recordings", "score")}
    yield modules
    for name in modules:
        sys.modules.pop(name, None)


def entry(family: str, place: str, driver: str, same_as: tuple[str, ...] = ()) -> dict[str, Any]:
    return {"family": family, "place": place, "direction": "axis", "driver": driver, "same_as": list(same_as)}


def test_what_counts(bench: dict[str, ModuleType]) -> None:
    effects = [{"family": ["compliance"], "place": ["elbow_joint"], "driver": ["load:elbow_joint"]}]
    truth = {"scenario": "compliance", "effects": effects}

    def score(*entries: dict[str, Any]) -> Any:
        return bench["score"].score({"effects": list(entries)}, truth)

    right = entry("compliance", "elbow_joint", "load:elbow_joint")
    assert score(right).attributed
    assert not score().attributed
    assert not score(entry("backlash", "elbow_joint", "load:elbow_joint")).attributed
    assert not score(entry("compliance", "wrist_1_joint", "load:wrist_1_joint")).attributed
    assert score(right, entry("step", "tool", "time")).false == 1
    assert score(entry("compliance", "x", "load:x", ("elbow_joint axis by load:elbow_joint",))).attributed


def test_a_fault_is_in_the_bag_and_not_named_there(bench: dict[str, ModuleType], tmp_path: Path) -> None:
    first, _, truth = bench["recordings"].make("gear_harmonic", "ur10", 0, tmp_path, 20)
    recording = read_recording(first)
    assert sum(len(r.stamps) for r in recording.readings) == 20
    assert all(b"gear_harmonic" not in p.read_bytes() for p in first.rglob("*") if p.is_file())
    assert truth.parent not in first.parents
