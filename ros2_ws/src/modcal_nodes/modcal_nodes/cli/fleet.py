"""``modcal fleet``: many recordings, on all cores or on a cluster of Dask."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import count
from pathlib import Path
from typing import Any

import click
from distributed import Client

from modcal_core.errors import BadCommand, plain
from modcal_core.report import STATUS_WORDS, explained
from modcal_nodes.cli.console import UNMET, WRITTEN, Output, Whole, given, speaking, written
from modcal_nodes.fleet import DONE, Row, calibrate_all, find_bags, names_of, watch_all, write_table
from modcal_nodes.io import Options, SentinelOptions

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
@speaking
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
            rows = calibrate_all(named, out, asked, client, heard)
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
