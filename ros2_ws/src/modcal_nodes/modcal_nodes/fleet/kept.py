"""What is kept of each recording, so that a second call does only what is missing or has changed.

A folder for each, moved into place whole. ``fleet.json`` in it says what it was made from: the bag's files with their
sizes and times, the options, the version of modcal.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import modcal_core
from modcal_core.files import replace_folder, to_json
from modcal_nodes.fleet.task import FAILED, Outcome, Task

MARK = "fleet.json"


def made_from(task: Task) -> dict[str, Any]:
    """What a result depends on, as plain data."""
    files = [task.bag] if task.bag.is_file() else sorted(p for p in task.bag.iterdir() if p.is_file())
    return {
        "modcal": modcal_core.__version__,
        "options": _digest(task),
        "bag": [[f.name, f.stat().st_size, f.stat().st_mtime_ns] for f in files],
    }


def _digest(task: Task) -> str:
    said = {name: value for name, value in asdict(task.options).items() if not isinstance(value, Path)}
    digits = hashlib.sha256(json.dumps(said, sort_keys=True).encode())
    for name, value in sorted(asdict(task.options).items()):
        if isinstance(value, Path):  # what a file says counts, not what it is called
            digits.update(name.encode() + value.read_bytes())
    return digits.hexdigest()[:16]


def keep(out: Path, task: Task, outcome: Outcome, source: Mapping[str, Any]) -> dict[str, Any]:
    """Put what became of a task in its folder, in place of what is there; returns its row of the table."""
    row = {
        "name": task.name,
        "bag": str(task.bag),
        "state": outcome.state,
        "said": outcome.said or None,
        "took_s": round(outcome.took, 3),
        **outcome.row,
    }
    mark = {"modcal_fleet": 1, "made_from": source, "row": row, **({"trace": outcome.trace} if outcome.trace else {})}
    replace_folder(out / task.name, {**outcome.files, MARK: to_json(mark).encode()})
    return row


def kept_row(out: Path, task: Task, source: Mapping[str, Any]) -> dict[str, Any] | None:
    """The row of a result that is still good; None where there is none, or it was not to be had the last time."""
    try:
        mark = json.loads((out / task.name / MARK).read_text(encoding="utf-8"))
        row: dict[str, Any] = mark["row"]
        good = mark["made_from"] == source and row["state"] != FAILED
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return {**row, "bag": str(task.bag)} if good else None
