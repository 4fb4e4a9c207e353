"""Which tests come by a mark in the sources, and how they end. A plugin of pytest, and what the marks call.

A copy of this file stands in the copied workspace under the name ``mutants_probe``. A process that a test starts
inherits from the environment on whose behalf it runs.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

RECORD, TESTS, FILE = "MUTANTS_RECORD", "MUTANTS_TESTS", "MUTANTS_FILE"
_seen: set[tuple[str, str]] = set()


def reached(mutant: str) -> None:
    """Note once for each test that it came by this mark."""
    test = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" (")[0]
    if (mutant, test) not in _seen:
        _seen.add((mutant, test))
        _write({"mutant": mutant, "test": test, "file": os.environ.get(FILE)})


def _write(line: dict[str, Any]) -> None:
    if path := os.environ.get(RECORD):
        out = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        os.write(out, (json.dumps(line) + "\n").encode())  # at once, so that processes do not write into each other
        os.close(out)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave only the tests that are asked for, in that order."""
    if TESTS in os.environ:
        rank = {name: i for i, name in enumerate(json.loads(Path(os.environ[TESTS]).read_text()))}
        items[:] = sorted((item for item in items if item.nodeid in rank), key=lambda item: rank[item.nodeid])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[Any]:
    report = yield
    seconds, outcome = getattr(item, "mutants", (0.0, "passed"))
    outcome = report.outcome if outcome == "passed" else outcome
    item.mutants = seconds + report.duration, outcome  # type: ignore[attr-defined]
    if report.when == "teardown":
        took, file, waits = seconds + report.duration, item.nodeid.split("::")[0], item.get_closest_marker("dds")
        _write({"done": item.nodeid, "file": file, "outcome": outcome, "seconds": took, "waits": waits is not None})
    return report
