"""``modcal fleet``: many recordings, on all cores or on a cluster."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from modcal_core.errors import plain
from modcal_core.files import to_json
from modcal_core.report.sentence import STATUS_WORDS
from modcal_nodes.cli.calibrate import calibration_options
from modcal_nodes.cli.console import console, written
from modcal_nodes.cli.legend import explain, table
from modcal_nodes.cli.number import Whole
from modcal_nodes.cli.paths import EXISTING, WRITTEN
from modcal_nodes.cli.show import STYLES
from modcal_nodes.fleet.cluster import Certificates, run_on_cluster
from modcal_nodes.fleet.compare import Compared, Row
from modcal_nodes.fleet.pool import run_here
from modcal_nodes.fleet.room import room
from modcal_nodes.fleet.run import FleetPlan, plan, run
from modcal_nodes.fleet.task import DONE, Outcome, Task
from modcal_nodes.fleet.work import do
from modcal_nodes.io.options import Options

_COLUMNS = {
    "robot": "",
    "last": "day of the last recording",
    "status": "verdict on it: at the floor, open, or cannot tell",
    "over time": "what has changed between the recordings",
    "recordings": "",
    "RMS mm before": "held-out error of the nominal model, in the last recording",
    "RMS mm after": "the same with geometry and effects corrected",
}


@click.command("fleet")
@click.argument("bags", nargs=-1, required=True)
@click.option("--out", type=WRITTEN, default=Path("fleet"), show_default=True, help="Folder of the results.")
@click.option(
    "--jobs",
    type=Whole(min=1),
    default=None,
    metavar="N",
    help="Recordings at a time. Default: one per core, as far as memory allows.",
)
@click.option(
    "--dask",
    "address",
    default=None,
    metavar="ADDRESS",
    help="Address of a Dask scheduler: work on its cluster instead of this machine's cores.",
)
@click.option(
    "--dask-ca",
    type=EXISTING,
    default=None,
    metavar="FILE",
    help="TLS: the certificate authority of the cluster (PEM).",
)
@click.option("--dask-cert", type=EXISTING, default=None, metavar="FILE", help="TLS: our certificate (PEM).")
@click.option("--dask-key", type=EXISTING, default=None, metavar="FILE", help="TLS: its key (PEM).")
@click.option(
    "--robot-by",
    default="folder",
    show_default=True,
    metavar="HOW",
    help="Which robot a bag is of: 'folder' it lies in, name in its 'urdf', or a pattern of its path with "
    "the name in (…).",
)
@click.option("--refit-base", is_flag=True, help="Do not compare bases: tracker or robot are set up again each time.")
@click.option("--refit-tool", is_flag=True, help="Do not compare tools: they are mounted again each time.")
@click.option("--again", is_flag=True, help="Recalibrate all recordings, including those already done.")
@click.option("--json", "as_json", is_flag=True, help="Print both tables as JSON in place of the summary.")
@calibration_options
def fleet_command(
    bags: tuple[str, ...],
    out: Path,
    jobs: int | None,
    address: str | None,
    dask_ca: Path | None,
    dask_cert: Path | None,
    dask_key: Path | None,
    robot_by: str,
    refit_base: bool,
    refit_tool: bool,
    again: bool,
    as_json: bool,
    **options: Any,
) -> int:
    """Calibrate every recording in BAGS (bags, folders that hold some, patterns) and compare the results of each robot.

    Writes a folder for each, fleet.parquet with a row for each, and drift.parquet. A second call does only what is
    missing or has changed. Exit 2 when some could not be calibrated; all others are then written nevertheless.
    """
    certificates = Certificates.of(dask_ca, dask_cert, dask_key)
    planned = plan(bags, out, Options(**options), again)
    page = console()
    quiet = as_json or not page.is_terminal
    here = room()
    jobs = jobs or here.jobs
    if not as_json:
        where = f"on {address}" if address else here.said(jobs)
        page.print(f"{len(planned.missing)} of {len(planned.tasks)} recordings to do, {where}", highlight=False)

    def runner(tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        return run_on_cluster(tasks, address, do, certificates) if address else run_here(tasks, jobs, do)

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    with Progress(*columns, console=page, disable=quiet, transient=True) as progress:
        bar = progress.add_task("", total=len(planned.missing))

        def heard(row: Row) -> None:
            progress.advance(bar)
            if not quiet and row["state"] != DONE:
                progress.console.print(f"{row['name']}: {row['said']}", style="yellow", highlight=False)

        compared = run(planned, runner, robot_by, refit_base, refit_tool, heard)
    if as_json:
        click.echo(to_json(_data(planned, compared)), nl=False)
    else:
        _show(planned, compared, page)
    left = [row for row in compared.rows if row["state"] != DONE]
    if left:
        first = f"{left[0]['name']} {left[0]['state']}: {left[0]['said']}"
        click.echo(
            plain(f"modcal: {len(left)} of {len(compared.rows)} recordings were not calibrated; {first}"), err=True
        )
    return 2 if left else 0


def _data(planned: FleetPlan, compared: Compared) -> dict[str, Any]:
    states = [row["state"] for row in compared.rows]
    return {
        "modcal_fleet": 1,
        "out": str(planned.out),
        "states": {state: states.count(state) for state in sorted(set(states))},
        "kept": len(planned.kept),
        "recordings": compared.rows,
        "drift": compared.drifts,
    }


def _status(row: Row) -> Text:
    """The verdict in a word, in its colour; empty of a row that an older version made."""
    status = row.get("status")
    return Text(STATUS_WORDS[status], STYLES[status]) if status in STYLES else Text()


def _show(planned: FleetPlan, compared: Compared, page: Console) -> None:
    """A line for each robot, then those that could not be calibrated."""
    shown = table(_COLUMNS, words=4)
    robots: dict[tuple[str, str], list[Row]] = {}
    for row in compared.rows:
        if row["state"] == DONE:
            robots.setdefault((row["robot"], row["kinematics"]), []).append(row)
    for (robot, _), rows in sorted(robots.items()):
        last = max(rows, key=lambda row: row["started"])
        sizes = [last[f"{stage}_rms_mm"] for stage in ("nominal", "final")]
        numbers = ["" if size is None else f"{size:.3f}" for size in sizes]
        shown.add_row(robot, last["started"][:10], _status(last), last["drift"] or "", str(len(rows)), *numbers)
    page.print(shown, highlight=False)
    explain(_COLUMNS, page)
    for row in compared.rows:
        if row["state"] != DONE:
            page.print(f"{row['name']} {row['state']}: {row['said']}", style="yellow", highlight=False)
    names = ["fleet.parquet", "drift.parquet", "a folder for each recording"]
    click.echo(plain(written(planned.out, names, "Table", "fleet.parquet")))
