"""``modcal history``, ``modcal compare`` and ``modcal fleet``: many calibrations, two of them, and many recordings."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

import click
from distributed import Client

from modcal_core.calibration import Calibration, fingerprint
from modcal_core.errors import BadCommand, BadTable, plain
from modcal_core.files import read_json
from modcal_core.measurements import require
from modcal_core.moves import Values, series_of, values_of
from modcal_core.outcome import offsets_of
from modcal_core.report import STATUS_WORDS, History, HistoryEntry, Side, compare, explained, history_report
from modcal_nodes.cli.console import Output, saving, speaking, written
from modcal_nodes.cli.options import EXISTING, UNMET, WRITTEN, Decimal, Whole, given
from modcal_nodes.fleet import DONE, Row, calibrate_all, find_bags, names_of, write_table
from modcal_nodes.io import SCHEMA, Options

_COLUMNS = {
    "recording": "",
    "status": "verdict: at the floor, open, or cannot tell",
    "RMS mm before": "held-out error of the nominal model",
    "RMS mm after": "the same with geometry and effects corrected",
}


@click.command("fleet")
@click.argument("bags", nargs=-1, required=True)
@click.option("--out", type=WRITTEN, default=Path("fleet"), help="Folder of the results.")
@click.option("--csv", "as_csv", is_flag=True, help="Write fleet.csv in place of fleet.parquet.")
@click.option("--jobs", type=Whole(min=1), metavar="N", help="Processes of this machine. Default: one per core.")
@click.option("--dask", "address", metavar="ADDRESS", help="Address of a Dask scheduler, in place of this machine.")
@given(Options, without=("tolerance_mm", "tolerance_of", "factory_kinematics"))
@speaking
def fleet_command(
    bags: tuple[str, ...],
    out: Path,
    as_csv: bool,
    jobs: int | None,
    address: str | None,
    output: Output,
    options: Options,
) -> int:
    """Calibrate every recording in BAGS (bags, folders that hold some, patterns).

    Writes a folder for each, and a table with a row for each. Exit 2 when some could not be calibrated; all others are
    then written nevertheless.
    """
    named = names_of(find_bags(bags, out), out)
    files: dict[str, Any] = {name: value.resolve() for name, value in vars(options).items() if isinstance(value, Path)}
    asked = replace(options, **files)
    name = "fleet.csv" if as_csv else "fleet.parquet"
    done = count(1)
    with _client(address, jobs) as client, output.working() as watch:
        rows = calibrate_all(named, out, asked, client, lambda _: watch("calibrating", next(done) / len(named)))
    write_table(out / name, rows)
    data = {"modcal_fleet": 1, "out": str(out), "recordings": rows}
    output.result(
        data,
        explained(_COLUMNS, [_shown(row) for row in rows], words=2),
        written(out, [name, "a folder for each recording"], "Table", name),
    )
    if left := [row for row in rows if row["state"] != DONE]:
        first = f"{left[0]['name']} {left[0]['state']}: {left[0]['said']}"
        click.echo(plain(f"modcal: {len(left)} of {len(rows)} recordings were not calibrated; {first}"), err=True)
    return 2 if left else 0


def _shown(row: Row) -> tuple[str, ...]:
    if row["state"] != DONE:
        return row["name"], row["state"], "", ""
    sizes = ["" if (x := row[f"{stage}_rms_mm"]) is None else f"{x:.3f}" for stage in ("nominal", "final")]
    return row["name"], STATUS_WORDS[row["status"]], *sizes


def _client(address: str | None, workers: int | None) -> Client:
    """A client of the cluster at this address, or of so many workers here. Raises BadCommand where none answers."""
    if address is None:
        here = "127.0.0.1:0"  # Dask's own default is a port that another cluster may have, open to the network
        return Client(n_workers=workers, threads_per_worker=1, dashboard_address=here, set_as_default=False)
    try:
        return Client(address, timeout="10s", set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        said = f"no scheduler answers ({' '.join(str(error).split())})"
        raise BadCommand(f"--dask {address}", said, "give its address, host:port") from error


_DATED = re.compile(r"(\d{4}-\d{2}-\d{2})")
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
    shelves: dict[Path, list[_FolderContents]] = {}
    for part in parts:
        shelves.setdefault(part.parent, []).append(_kept(part, folder))
    histories = [h for shelf, kept in shelves.items() for h in _histories(shelf.relative_to(folder).as_posix(), kept)]
    if not histories:
        remedy = "keep the calibration that was checked there as well"
        raise BadTable(str(folder), "holds checks but no calibration", remedy)
    return tuple(histories)


def _histories(shelf: str, kept: list[_FolderContents]) -> Iterator[History]:
    """Of the robots of one folder: one, unless descriptions differ."""
    robots = sorted({k.robot for k in kept if k.robot})
    for robot in robots:
        # a check that changed nothing keeps no model: it belongs to the robot of its folder, if there is but one
        mine = [k for k in kept if k.robot == robot or (not k.robot and len(robots) == 1)]
        mine.sort(key=lambda k: (k.entry.time is None, k.entry.time or 0.0, k.entry.name))
        dated = [(k.entry.name, k.entry.time, k.values) for k in mine if k.entry.time is not None and k.values]
        notes = []
        if undated := sum(k.entry.time is None for k in mine):
            notes.append(f"{undated} without a date are in no trend: begin their names with the day (2026-03-01).")
        if len(robots) > 1 and (loose := sum(not k.robot for k in kept)):
            notes.append(f"{loose} checks without a change may be of any of {len(robots)} robots: they are left out.")
        name = next((k.name for k in mine if k.robot and k.name != robot), robot)
        called = name if shelf == "." else f"{name} in {shelf}"
        yield History(called, tuple(k.entry for k in mine), series_of(dated), tuple(notes))


@dataclass(frozen=True)
class _FolderContents:
    """What a folder keeps. robot: fingerprint, empty where it keeps no model. name: of the robot. values: by name."""

    robot: str
    name: str
    entry: HistoryEntry
    values: Values


def _kept(part: Path, folder: Path) -> _FolderContents:
    check, report = _json(part / "check.json"), _json(part / "report.json")
    calibration = Calibration.load(part) if (part / "calibration.yaml").is_file() else None
    trace = (report or {}).get("trace") or {}
    # what a person wrote on the folder counts before the clock of a recording, which may be none
    dated = _DATED.match(part.name)
    date = dated[1] if dated is not None else (check or {}).get("date") or trace.get("date")
    said = str((check or report or {}).get("verdict") or "")
    name = part.relative_to(folder).as_posix()
    entry = HistoryEntry(name, "check" if check else "calibration", date, _seconds(date, part), said)
    if calibration is None:
        return _FolderContents("", "", entry, {})
    robot = fingerprint(calibration.nominal.chain)
    values = values_of(calibration)
    offsets = offsets_of(calibration)
    for offset in () if offsets is None else offsets.found:
        if offset.std is not None:
            unit = "mrad" if offset.turning else "mm"
            values[f"zero of {offset.joint}"] = (unit, 1e3 * offset.value, 1e3 * offset.std, False)
    return _FolderContents(robot, str(trace.get("robot") or robot), entry, values)


def _seconds(date: str | None, part: Path) -> float | None:
    if date is None:
        return None
    try:
        at = datetime.fromisoformat(date)
    except ValueError as error:
        raise BadTable(f"{part}: date {date[:40]}", "is not a date", "remove the folder, or calibrate again") from error
    return (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()


def _json(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    remedy = "remove the folder, or run the verb again"
    data = read_json(path, remedy)
    if not isinstance(data, dict):
        raise BadTable(str(path), "is no report", remedy)
    return data


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
        sides = [_side(path, name) for path, name in zip((first, second), names, strict=True)]
        found = compare(sides[0], sides[1], tolerance_mm)
    output.saved(found, f"{first.resolve().stem}_{second.resolve().stem}_comparison")
    judged = tolerance_mm is not None and found.data["result"] in ("beyond tolerance", "cannot tell")
    return UNMET if judged else 0


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
    require(data, SCHEMA, str(path), remedy)
    return dict(data)
