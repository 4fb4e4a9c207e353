"""``modcal history``, ``modcal compare`` and ``modcal sentinel``: what changes over many calibrations or recordings."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from modcal_core.calibration import Calibration, fingerprint
from modcal_core.errors import BadTable, NotEnoughData, refusing
from modcal_core.files import read_json
from modcal_core.moves import series_of, values_of
from modcal_core.outcome import offsets_of
from modcal_core.report import History, HistoryEntry, Side, VerbResult, compare, history_report, sentinel_report
from modcal_core.schema import require
from modcal_nodes.cli.console import EXISTING, UNMET, Decimal, Output, given, saving
from modcal_nodes.io import SentinelOptions, judge_arm

_DATED = re.compile(r"(\d{4}-\d{2}-\d{2})")
_OF_MODCAL = {"type": "object", "required": ["modcal_report"], "properties": {"modcal_report": {"enum": [1]}}}
_DEPTH = 3  # folders below the one that is given


@click.command("history")
@click.argument("folder", type=EXISTING)
@saving("Folder of history.json. Default: FOLDER.")
def history_command(folder: Path, output: Output) -> None:
    """Show how a robot changes over time, by all calibrations and checks below FOLDER.

    FOLDER holds what modcal calibrate and modcal check wrote, for each robot in a folder of its own. Joint zeros,
    curves of gears, compliances and the spread of readings are followed; what grows or falls beyond chance is said.
    """
    with output.working() as watch:
        watch("reading")
        found = read_history(folder)
    output.saved(history_report(found), folder)


def read_history(folder: Path) -> tuple[History, ...]:
    """The history of each robot below a folder. Raises BadTable where it holds none."""
    parts = sorted(
        {p.parent for depth in range(1, _DEPTH + 1) for n in ("calibration.yaml", "check.json")
         for p in folder.glob("/".join(["*"] * depth) + f"/{n}")}
    )  # fmt: skip
    if not parts:
        said = "holds no folder of modcal calibrate or modcal check"
        raise BadTable(str(folder), said, "keep a robot's calibrations and checks as folders in one folder")
    shelves: dict[Path, list[HistoryEntry]] = {}
    for part in parts:
        shelves.setdefault(part.parent, []).append(_kept(part, folder, str(part)))
    histories = [h for shelf, kept in shelves.items() for h in _histories(shelf.relative_to(folder).as_posix(), kept)]
    if not histories:
        remedy = "keep the calibration that was checked there as well"
        raise BadTable(str(folder), "holds checks but no calibration", remedy)
    return tuple(histories)


def _histories(shelf: str, kept: list[HistoryEntry]) -> Iterator[History]:
    """Of the robots of one folder: one, unless descriptions differ."""
    robots = sorted({e.robot for e in kept if e.robot})
    for robot in robots:
        # a check that changed nothing keeps no model: it belongs to the robot of its folder, if there is but one
        mine = [e for e in kept if e.robot == robot or (not e.robot and len(robots) == 1)]
        mine.sort(key=lambda e: (e.time is None, e.time or 0.0, e.name))
        dated = [(e.name, e.time, e.values) for e in mine if e.time is not None and e.values]
        notes = []
        if undated := sum(e.time is None for e in mine):
            notes.append(f"{undated} without a date are in no trend: begin their names with the day (2026-03-01).")
        if len(robots) > 1 and (loose := sum(not e.robot for e in kept)):
            notes.append(f"{loose} checks without a change may be of any of {len(robots)} robots: they are left out.")
        name = next((e.called for e in mine if e.robot and e.called != robot), robot)
        called = name if shelf == "." else f"{name} in {shelf}"
        yield History(called, tuple(mine), series_of(dated), tuple(notes))


@refusing
def _kept(part: Path, folder: Path, _: str) -> HistoryEntry:
    """What a folder keeps. Raises BadTable, naming it, for what is no calibration, report or check."""
    check, report = _json(part / "check.json"), _json(part / "report.json")
    trace = report.get("trace") or {}
    # what a person wrote on the folder counts before the clock of a recording, which may be none
    dated = _DATED.match(part.name)
    date = dated[1] if dated is not None else check.get("date") or trace.get("date")
    at = None if date is None else datetime.fromisoformat(date)
    time = None if at is None else (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()
    said, name = str((check or report).get("verdict") or ""), part.relative_to(folder).as_posix()
    entry = HistoryEntry(name, "check" if check else "calibration", date, time, said)
    if not (part / "calibration.yaml").is_file():
        return entry
    calibration = Calibration.load(part)
    robot, values, offsets = fingerprint(calibration.nominal.chain), values_of(calibration), offsets_of(calibration)
    for offset in () if offsets is None else offsets.found:
        if offset.std is not None:
            unit = "mrad" if offset.turning else "mm"
            values[f"zero of {offset.joint}"] = (unit, 1e3 * offset.value, 1e3 * offset.std, False)
    return replace(entry, robot=robot, called=str(trace.get("robot") or robot), values=values)


def _json(path: Path) -> dict[str, Any]:
    return dict(read_json(path, "remove the folder, or run the verb again")) if path.is_file() else {}


@click.command("compare")
@click.argument("first", type=EXISTING, metavar="A")
@click.argument("second", type=EXISTING, metavar="B")
@click.option(
    "--tolerance-mm", type=Decimal(min=0.0, min_open=True), metavar="MM",
    help="How far the two may differ at the tool, 95th percentile; exit code 3 if it is more, or cannot be told.",
)  # fmt: skip
@saving("Folder of comparison.json.")
def compare_command(first: Path, second: Path, tolerance_mm: float | None, output: Output) -> int:
    """Compare two calibrations, or two reports: what differs between A and B, and whether it matters.

    A and B are folders of modcal calibrate or modcal evaluate, calibration.yaml files, or report.json files.
    """
    names = (first.name, second.name) if first.resolve().name != second.resolve().name else (str(first), str(second))
    with output.working() as watch:
        watch("comparing")
        found = _compared(_side(first, names[0]), _side(second, names[1]), tolerance_mm, " or ".join(names))
    output.saved(found, f"{first.resolve().stem}_{second.resolve().stem}_comparison")
    judged = tolerance_mm is not None and found.data["result"] in ("beyond tolerance", "cannot tell")
    return UNMET if judged else 0


@refusing
def _compared(first: Side, second: Side, tolerance_mm: float | None, _: str) -> VerbResult:
    """As :func:`compare`, whatever is in a report that a person has changed. Raises BadTable, naming the sides."""
    return compare(first, second, tolerance_mm)


def _side(path: Path, name: str) -> Side:
    if path.suffix == ".json":
        return Side(name, report=_report(path))
    folder = path if path.is_dir() else path.parent
    beside = folder / "report.json"
    report = _report(beside) if beside.is_file() else None
    if path.is_dir() and not (path / "calibration.yaml").is_file():
        if report is None:
            said = "holds neither calibration.yaml nor report.json"
            raise BadTable(str(path), said, "give a folder of modcal calibrate or modcal evaluate")
        return Side(name, report=report)
    return Side(name, Calibration.load(path), report)


def _report(path: Path) -> dict[str, Any]:
    """The data of a report.json. Raises BadTable for anything else."""
    remedy = "give the report.json that modcal calibrate or modcal evaluate wrote"
    data = read_json(path, remedy)
    require(data, _OF_MODCAL, str(path), remedy)
    return dict(data)


@click.command("sentinel")
@click.argument("bags", type=EXISTING, nargs=-1, required=True)
@given(SentinelOptions)
@saving("Folder of the results. Default: sentinel.")
def sentinel_command(bags: tuple[Path, ...], output: Output, options: SentinelOptions) -> int:
    """Say whether an arm has changed, from ordinary recordings BAGS of its work: joint states with efforts, commands
    (or a leader, --topic joint_commands=/leader/joint_states), a fixed tag seen by a camera on the hand, sockets.

    Recordings of a reference period (four at least, a minute each, of several days) show what is normal. Names joint
    zero, gear, play, friction, latency, servo, payload, camera; exit code 3 on a change. Data sets of LeRobot are read.
    """
    if not options.reference and options.history is None:
        raise NotEnoughData("sentinel", "knows of no reference period", "give --reference BAG …, or --history FOLDER")
    with output.working() as watch:
        found, name = judge_arm(bags, options, watch)
    output.saved(sentinel_report(found, name), "sentinel")
    return 0 if found.status == "unchanged" else UNMET
