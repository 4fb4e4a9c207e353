"""``modcal fleet``: a Dask map of ``modcal calibrate`` over recordings, or of the sentinel over robots, and a table."""

from __future__ import annotations

import glob
import hashlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

import click
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from distributed import Client, KilledWorker, wait

from modcal_core.errors import BadCommand, BadRecording, BadTable, ModcalError, plain
from modcal_core.files import replace_folder
from modcal_core.public import Result
from modcal_core.report import STATUS_WORDS, explained, sentinel_report, to_json_data
from modcal_msgs_py import SUFFIXES
from modcal_nodes.cli.console import UNMET, WRITTEN, Output, Whole, given, speaks, written
from modcal_nodes.io import Options, SentinelOptions, calibrate_bag, judge_arm

Row = dict[str, Any]
Made = tuple[Row, dict[str, bytes]]
DONE, REFUSED, FAILED = "done", "refused", "failed"
# in the folder of a recording or robot that was refused or failed: why
NOT_CALIBRATED, NOT_JUDGED = "not_calibrated.txt", "not_judged.txt"
_ALONE_S = 60.0  # without any worker, after which none is waited for: one that died is there again in a few
_MARKS = ("report.json", "sentinel.json", NOT_CALIBRATED, NOT_JUDGED)
_TEXT, _NUMBER = pa.string(), pa.float64()
_SIZES = tuple(f"{stage}_{size}_mm" for stage in ("nominal", "geometric", "final") for size in ("rms", "p95"))
SCHEMA = pa.schema(
    [
        *((name, _TEXT) for name in ("name", "bag", "state", "said", "robot")),
        ("started", pa.timestamp("ms", tz="UTC")),
        *(("duration_s", _NUMBER), ("measurement", _TEXT), ("stations", pa.int64()), ("rejected", pa.int64())),
        *((name, _NUMBER) for name in (*_SIZES, "floor_mm", "unexplained_mm")),
        *((name, _TEXT) for name in ("effects", "status", "verdict")),
    ]
)


def find_bags(given: Iterable[str], leave_out: Path) -> list[Path]:
    """The bags (absolute paths, sorted, each once) that are named, lie in named folders, or match named patterns.

    leave_out: a folder that is not searched. Raises BadRecording for a name that leads to no bag.
    """
    found: set[Path] = set()
    for name in given:
        paths = [Path(name)] if Path(name).exists() else [Path(p) for p in glob.glob(name, recursive=True)]
        if not paths:
            raise BadRecording(name, "does not exist", "give bags, folders that hold bags, or a pattern")
        bags = [bag.resolve() for path in paths for bag in _below(path, leave_out.resolve())]
        if not bags:
            raise BadRecording(name, "holds no bag", "give bag folders, .mcap or .db3 files, or a folder above them")
        found.update(bags)
    return sorted(found)


def _below(path: Path, leave_out: Path) -> Iterator[Path]:
    """The path itself where it is a bag, else the bags in it."""
    if path.is_file():
        yield path
        return
    inside = sorted(file for file in path.iterdir() if file.is_file() and file.name.endswith(SUFFIXES))
    # a recorder that was stopped leaves no metadata, but files that are named after their folder
    if (path / "metadata.yaml").is_file() or (inside and all(f.name.startswith(f"{path.name}_") for f in inside)):
        yield path
        return
    yield from inside
    for folder in sorted(p for p in path.iterdir() if p.is_dir() and not p.name.startswith(".")):
        if folder.resolve() != leave_out:
            yield from _below(folder, leave_out)


def names_of(bags: Iterable[Path], out: Path) -> dict[str, Path]:
    """The bags by the names of their results: folder and own name; of equals, with digits of the path.

    Raises BadTable where something else stands where a result in `out` would.
    """
    plain = {bag: f"{bag.parent.name or 'bag'}/{bag.stem if bag.is_file() else bag.name}" for bag in bags}
    count = Counter(plain.values())
    digits = {bag: hashlib.sha256(str(bag).encode()).hexdigest()[:8] for bag in plain}
    named = {name if count[name] == 1 else f"{name}-{digits[bag]}": bag for bag, name in plain.items()}
    _require_free([out / name for name in named], plain)
    return named


def _require_free(folders: Iterable[Path], bags: Iterable[Path]) -> None:
    for folder in folders:
        ours = any((folder / mark).is_file() for mark in _MARKS) and folder.resolve() not in bags
        if folder.exists() and not ours:
            raise BadTable(str(folder), "holds something other than results", "give --out another folder")


def calibrate_one(bag: Path, options: Options) -> Made:
    """A row of the table, and the files of the calibration by name. A recording that is of no use is a row too."""
    try:
        done = calibrate_bag(bag, options)
    except ModcalError as error:
        return {"state": REFUSED, "said": str(error)}, {}
    return _row(done.result), {name: text.encode() for name, text in done.files.items()}


@dataclass(frozen=True)
class RobotBags:
    """Recordings of one robot, and the folder of its history."""

    bags: tuple[Path, ...]
    history: Path

    def __str__(self) -> str:
        return ", ".join(map(str, self.bags))


def watch_one(robot: RobotBags, options: SentinelOptions) -> Made:
    """A row of the table, and what the sentinel says of a robot by its recordings, as files by name."""
    try:
        found, name = judge_arm(robot.bags, replace(options, history=str(robot.history)))
    except ModcalError as error:
        return {"state": REFUSED, "said": str(error)}, {}
    later = [bag for bag in found.bags if not bag.reference][-len(robot.bags) :]
    row = {"state": DONE, "robot": name, "started": _date(later[0].began), "status": found.status}
    row |= {"effects": "; ".join(change.label for change in found.changes), "verdict": found.sentence}
    return row, {name: text.encode() for name, text in sentinel_report(found, name).files.items()}


def watch_all(
    bags: Iterable[Path], out: Path, options: SentinelOptions, client: Client, heard: Callable[[Row], object]
) -> list[Row]:
    """Ask of each robot whether it has changed; a robot's name is that of the
    folder above its bags, and of the folder of its history in the one that the options name.
    """
    robots = defaultdict(list)
    for bag in bags:
        robots[bag.parent.name].append(bag)
    _require_free([out / name for name in robots], bags)
    histories = Path(options.history or "").resolve()
    named = {name: RobotBags(tuple(of), histories / name) for name, of in robots.items()}
    return map_bags(watch_one, named, out, options, client, heard)


def map_bags(
    work: Callable[[Any, Any], Made],
    bags: Mapping[str, Any],
    out: Path,
    options: Any,
    client: Client,
    heard: Callable[[Row], object],
) -> list[Row]:
    """Work on each of the bags on a cluster; writes a folder for each in `out`, and returns rows in order of names.

    heard: of each row as it comes. A task that raises, or whose workers die as often as Dask allows, is a failed row.
    """
    rows: list[Row] = []
    unmade = NOT_JUDGED if isinstance(options, SentinelOptions) else NOT_CALIBRATED

    def keep(name: str, fault: BaseException | None, made: Made | None) -> None:
        said = "" if fault is None else " ".join(f"{type(fault).__name__}: {fault}".split())
        row, files = made or ({"state": FAILED, "said": said}, {})
        rows.append({"name": name, "bag": str(bags[name]), **row})
        replace_folder(out / name, files or {unmade: f"{row['state']}: {row['said']}\n".encode()})
        heard(rows[-1])

    # A worker that dies takes along what waits on it, so what was lost with one is tried once more by itself.
    lost = []
    for name, fault, made in _outcomes(work, bags, options, client):
        if isinstance(fault, KilledWorker):
            lost.append(name)
        else:
            keep(name, fault, made)
    for name in lost:
        keep(*next(_outcomes(work, {name: bags[name]}, options, client)))
    return sorted(rows, key=lambda row: row["name"])


def _outcomes(
    work: Callable[[Any, Any], Made], bags: Mapping[str, Any], options: Any, client: Client
) -> Iterator[tuple[str, BaseException | None, Made | None]]:
    """Name, fault and result of each bag as it is done; a fault of all that are left where no worker is."""
    futures = {client.submit(work, bag, options, pure=False): name for name, bag in bags.items()}
    while futures:
        try:
            with client.as_current():
                done = wait(list(futures), timeout=_ALONE_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            try:
                client.wait_for_workers(1, timeout=_ALONE_S)  # one that died may be on its way back
            except TimeoutError:
                yield from ((name, RuntimeError("no worker is left on the cluster"), None) for name in futures.values())
                return
            continue
        for future in done:
            fault = future.exception()
            yield futures.pop(future), fault, future.result() if fault is None else None
            future.release()  # its files need not stay on the cluster


def _row(done: Result) -> Row:
    """What the table says of a calibration."""
    data = to_json_data(done.report)
    sizes = {stage: of_stage or {} for stage, of_stage in data["error_mm"].items()}
    return {
        "state": DONE,
        "robot": done.robot.name,
        "started": _date(done.samples.origin.began or 0.0),
        **{name: data["recording"][name] for name in ("duration_s", "measurement", "stations", "rejected")},
        **{f"{stage}_{size}_mm": sizes[stage].get(size) for stage in sizes for size in ("rms", "p95")},
        "floor_mm": data["noise_floor_mm"],
        "unexplained_mm": None if data["unexplained"] is None else data["unexplained"]["size_mm"],
        "effects": "; ".join(f"{e['family']} at {e['place']} by {e['driver']}" for e in data["effects"]),
        "status": data["status"],
        "verdict": data["verdict"],
    }


def _date(stamp: float) -> str:
    return datetime.fromtimestamp(stamp, UTC).isoformat(timespec="milliseconds")


def write_table(path: Path, rows: Iterable[Row]) -> None:
    """Write rows under the columns of `SCHEMA`, as CSV where the file is called so, else as Parquet."""
    rows = list(rows)
    columns = [pa.array([row.get(f.name) for row in rows], _TEXT if f.name == "started" else f.type) for f in SCHEMA]
    table = pa.table([column.cast(f.type) for column, f in zip(columns, SCHEMA, strict=True)], schema=SCHEMA)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".csv":
        pyarrow.csv.write_csv(table, path)
    else:
        pyarrow.parquet.write_table(table, path, compression="zstd")


_COLUMNS = {
    "recording": "",
    "status": "verdict: at the floor, open, or cannot tell",
    "RMS mm before": "held-out error of the nominal model",
    "RMS mm after": "the same with geometry and effects corrected",
}
_OF_ROBOTS = {
    "robot": "",
    "status": "unchanged, changed, or cannot tell",
    "verdict": "what has changed, and since when",
}


@click.command("fleet")
@click.argument("bags", nargs=-1, required=True)
@click.option("--out", type=WRITTEN, default=Path("fleet"), help="Folder of the results.")
@click.option("--csv", "as_csv", is_flag=True, help="Write fleet.csv in place of fleet.parquet.")
@click.option("--jobs", type=Whole(min=1), metavar="N", help="Processes of this machine. Default: one per core.")
@click.option("--dask", "address", metavar="ADDRESS", help="Address of a Dask scheduler, in place of this machine.")
@click.option("--sentinel", "histories", metavar="FOLDER", help="Ask whether robots have changed; of their histories.")
@given(Options, without=("tolerance_mm", "tolerance_of", "factory_kinematics"))
@speaks()
def fleet_command(
    bags: tuple[str, ...],
    out: Path,
    as_csv: bool,
    jobs: int | None,
    address: str | None,
    histories: str | None,
    output: Output,
    options: Options,
) -> int:
    """Calibrate every recording in BAGS (bags, folders that hold some, patterns).

    Writes a folder for each, and a table with a row for each. Exit 2 when some could not be calibrated; all others are
    then written nevertheless. With --sentinel each robot is judged by its recordings, as modcal sentinel does: its name
    is that of the folder above them, and of its history. Exit 3 when one has changed, or it cannot be told.
    """
    found = find_bags(bags, out)
    files: dict[str, Any] = {name: value.resolve() for name, value in vars(options).items() if isinstance(value, Path)}
    asked = replace(options, **files)
    name = "fleet.csv" if as_csv else "fleet.parquet"
    done, watched = count(1), None if histories is None else _watched(asked, histories)
    named = {bag.parent.name: bag for bag in found} if watched else names_of(found, out)
    with _client(address, jobs) as client, output.working() as watch:

        def heard(_: Row) -> None:
            watch("judging" if watched else "calibrating", next(done) / len(named))

        if watched is not None:
            rows = watch_all(found, out, watched, client, heard)
        else:
            rows = map_bags(calibrate_one, named, out, asked, client, heard)
    write_table(out / name, rows)
    columns = _OF_ROBOTS if watched else _COLUMNS
    data = {"modcal_fleet": 1, "out": str(out), "recordings": rows}
    output.result(
        data,
        [explained(columns, [_shown(row)[: len(columns)] for row in rows], words=2)],
        written(out, [name, f"a folder for each {'robot' if watched else 'recording'}"], "Table", name),
    )
    if left := [row for row in rows if row["state"] != DONE]:
        first = f"{left[0]['name']} {left[0]['state']}: {left[0]['said']}"
        said = "robots were not judged" if watched else "recordings were not calibrated"
        click.echo(plain(f"modcal: {len(left)} of {len(rows)} {said}; {first}"), err=True)
    return 2 if left else UNMET if watched and any(row["status"] != "unchanged" for row in rows) else 0


def _watched(options: Options, histories: str) -> SentinelOptions:
    """What is asked of a sentinel. Raises BadCommand for options that only a calibration takes."""
    own, usual = {one.name for one in fields(SentinelOptions)}, Options()
    for one in fields(Options):
        if one.name not in own and getattr(options, one.name) != getattr(usual, one.name):
            raise BadCommand(f"--{one.name.replace('_', '-')}", "is no option of --sentinel", "leave it out")
    taken = {one.name: getattr(options, one.name) for one in fields(Options) if one.name in own}
    return SentinelOptions(**taken, history=histories)


def _shown(row: Row) -> tuple[str, ...]:
    if row["state"] != DONE:
        return row["name"], row["state"], "", ""
    if "final_rms_mm" not in row:
        return row["name"], row["status"].replace("_", " "), row["verdict"]
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
