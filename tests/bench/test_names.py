"""`make bench`: every bench is listed with one line, runs by its name, and an unknown name is refused with the list."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

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


def test_a_bench_gets_its_arguments() -> None:
    assert "--recordings" in _bench("fleet-workers", "--help").stdout
    assert _bench("long-bag", "--help").stdout.startswith("usage: long_bag.py")


def test_make_has_the_targets_of_daily_work_and_no_other() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)) - {"reference"}
    daily = "help setup setup-test build demo week test suite quick lint ruff mypy format docs wheel lock clean"
    assert targets == {*daily.split(), "bench", "fuzz", "mutants"}
