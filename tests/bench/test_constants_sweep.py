"""bench/constants: a number is moved wherever it has been imported, put back, and what may not happen is told."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from modcal_core.diagnosis import pruning, search

FILE = Path(__file__).resolve().parents[2] / "bench" / "constants" / "run.py"


@pytest.fixture(scope="module")
def sweep() -> ModuleType:
    spec = importlib.util.spec_from_file_location("constants_run", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_a_number_moves_in_every_module_that_imported_it_and_comes_back(sweep: ModuleType) -> None:
    before = pruning.MIN_GAIN
    with sweep.changed("modcal_core.diagnosis.pruning", "MIN_GAIN", 1.3):
        assert pruning.MIN_GAIN == search.MIN_GAIN == pytest.approx(1.3 * before)
    assert pruning.MIN_GAIN == search.MIN_GAIN == before


@pytest.mark.parametrize(
    ("value", "factor", "expected"), [(0.5, 0.7, 0.35), (2, 0.7, 1), (2, 1.3, 3), (10, 1.3, 13), (10, 0.7, 7)]
)
def test_what_counts_stays_whole_and_moves(sweep: ModuleType, value: float, factor: float, expected: float) -> None:
    assert sweep.moved(value, factor) == pytest.approx(expected)


@pytest.mark.parametrize("name", ["NO_SUCH_NUMBER", "annotations"])
def test_a_name_that_is_no_number_is_refused_at_once(sweep: ModuleType, name: str) -> None:
    with pytest.raises(LookupError, match=name):
        sweep.value_of("modcal_core.diagnosis.pruning", name)


@pytest.mark.parametrize(
    ("recording", "said", "harm"),
    [
        ("tool_creeps 53", "calm and wrong", True),
        ("none 21", "named, 1 false", True),
        ("compliance 1", "named, 1 false", False),
        ("none 22", "named", False),
        ("tool_creeps 53", "open, not named", False),
    ],
)
def test_what_may_not_happen(sweep: ModuleType, recording: str, said: str, harm: bool) -> None:
    assert sweep.harms(recording, said) is harm
