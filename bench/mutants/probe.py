"""Which tests come by a mark in the sources, and how they end. A plugin of pytest, and what the marks call.

A copy of this file stands in the copied workspace under the name ``mutants_probe``. What a fixture of more than one
test does belongs to all tests that ask for it, what a cached helper does to all that call it, and what a file does when
it is imported to all tests in it. A process that a test starts inherits from the environment on whose behalf it runs.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

RECORD, TESTS, SKIP = "MUTANTS_RECORD", "MUTANTS_TESTS", "MUTANTS_SKIP"
_SHARED, _FILE = "MUTANTS_SHARED", "MUTANTS_FILE"
_seen: set[tuple[str | None, ...]] = set()


def reached(mutant: str) -> None:
    """Note once for each test that it came by this mark."""
    _note("mutant", mutant)


def _note(kind: str, what: str) -> None:
    get = os.environ.get
    key = (kind, what, get("PYTEST_CURRENT_TEST"), get(_SHARED), get(_FILE))
    if key not in _seen:
        _seen.add(key)
        _write({kind: what, "test": key[2], "shared": key[3], "file": key[4]})


def _write(line: dict[str, Any]) -> None:
    path = os.environ.get(RECORD)
    if path:
        out = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        os.write(out, (json.dumps(line) + "\n").encode())  # at once, so that processes do not write into each other
        os.close(out)


class _Set:
    """Environment variables that are set for a while."""

    def __init__(self, **values: str) -> None:
        self.values = values

    def __enter__(self) -> None:
        self.before = {name: os.environ.get(name) for name in self.values}
        os.environ.update(self.values)

    def __exit__(self, *_: object) -> None:
        for name in self.values:
            os.environ.pop(name, None)
        os.environ.update({name: value for name, value in self.before.items() if value is not None})


def _noted(cache: Callable[..., Any]) -> Callable[..., Any]:
    """functools.cache, which for helpers of tests also notes who uses what was computed on behalf of the first."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        if "/tests/" not in function.__code__.co_filename:
            return cache(function)
        name = f"{function.__module__}.{function.__qualname__}"

        @functools.wraps(function)
        def computed(*args: Any, **kwargs: Any) -> Any:
            with _Set(**{_SHARED: f"helper {name}"}):
                return function(*args, **kwargs)

        kept = cache(computed)

        @functools.wraps(function)
        def used(*args: Any, **kwargs: Any) -> Any:
            _note("uses", name)
            return kept(*args, **kwargs)

        return used

    return decorate


if RECORD in os.environ and "PYTEST_VERSION" in os.environ:
    functools.cache = _noted(functools.cache)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave only the tests that are asked for, in that order."""
    if TESTS in os.environ:
        rank = {name: i for i, name in enumerate(json.loads(Path(os.environ[TESTS]).read_text()))}
        items[:] = sorted((item for item in items if item.nodeid in rank), key=lambda item: rank[item.nodeid])
    if SKIP in os.environ:
        done = set(json.loads(Path(os.environ[SKIP]).read_text()))
        items[:] = [item for item in items if item.nodeid not in done]


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[Any]:
    name = collector.nodeid if isinstance(collector, pytest.Module) else ""
    with _Set(**{_FILE: name}) if name else _Set():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[Any]) -> Iterator[Any]:
    shared = fixturedef.scope != "function"
    with _Set(**{_SHARED: f"{fixturedef.scope} {fixturedef.argname}"}) if shared else _Set():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[Any]:
    report = yield
    seconds, outcome = getattr(item, "mutants", (0.0, "passed"))
    outcome = report.outcome if outcome == "passed" else outcome
    item.mutants = seconds + report.duration, outcome  # type: ignore[attr-defined]
    if report.when == "teardown":
        waits, fixtures = item.get_closest_marker("dds") is not None, getattr(item, "fixturenames", [])
        took = round(seconds + report.duration, 3)
        _write({"done": item.nodeid, "outcome": outcome, "seconds": took, "fixtures": fixtures, "waits": waits})
    return report
