"""The whole way: bags in, a folder each, two tables."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from modcal_core.errors import BadTable
from modcal_nodes.fleet.bags import find_bags, names_of, robot_namer, robot_of_bag
from modcal_nodes.fleet.compare import Compared, Row, compare
from modcal_nodes.fleet.kept import MARK, keep, kept_row, made_from
from modcal_nodes.fleet.table import DRIFT, FLEET, write_table
from modcal_nodes.fleet.task import Outcome, Task
from modcal_nodes.io.options import Options

Runner = Callable[[Sequence[Task]], Generator[Outcome, None, None]]


@dataclass(frozen=True)
class FleetPlan:
    """What there is to do. tasks: one for each bag. kept: rows of those that are done already, by name."""

    out: Path
    tasks: tuple[Task, ...]
    sources: dict[str, dict[str, Any]]
    kept: dict[str, Row]

    @property
    def missing(self) -> list[Task]:
        """The tasks that are to be done."""
        return [task for task in self.tasks if task.name not in self.kept]


def plan(given: Sequence[str], out: Path, options: Options, again: bool = False) -> FleetPlan:
    """The bags that are meant, and which of them are done already. again: none is.

    Raises BadRecording where there is no bag, BadTable where something else stands where a result would.
    """
    files = {name: path.resolve() for name in ("urdf", "delta", "cell_file") if (path := getattr(options, name))}
    options = replace(options, **files)
    names = names_of(find_bags(given, out))
    tasks = tuple(Task(name, bag, options) for bag, name in names.items())
    for task in tasks:
        folder = out / task.name
        if folder.exists() and not (folder / MARK).is_file():
            raise BadTable(str(folder), "holds something that modcal fleet did not write", "give --out another folder")
    sources = {task.name: made_from(task) for task in tasks}
    kept = {task.name: row for task in tasks if (row := kept_row(out, task, sources[task.name])) is not None}
    return FleetPlan(out, tasks, sources, {} if again else kept)


def run(
    planned: FleetPlan,
    runner: Runner,
    robot_by: str,
    refit_base: bool = False,
    refit_tool: bool = False,
    heard: Callable[[Row], object] = lambda _: None,
) -> Compared:
    """Do what is missing, and write the tables of everything that was given.

    heard: of each row as it comes. When it is interrupted, what is finished stays, and the tables are of that.
    """
    robot_namer(robot_by)
    rows = dict(planned.kept)
    by_name = {task.name: task for task in planned.tasks}
    try:
        with closing(runner(planned.missing)) as outcomes:
            for outcome in outcomes:
                task = by_name[outcome.name]
                rows[task.name] = keep(planned.out, task, outcome, planned.sources[task.name])
                heard(rows[task.name])
    finally:
        compared = _written(planned, rows, robot_by, refit_base, refit_tool)
    return compared


def _written(
    planned: FleetPlan, rows: Mapping[str, Row], robot_by: str, refit_base: bool, refit_tool: bool
) -> Compared:
    """Compare what is done, and write both tables, if anything is."""
    done = [rows[task.name] for task in planned.tasks if task.name in rows]
    done = [{**row, "robot": robot_of_bag(Path(row["bag"]), row.get("model"), robot_by)} for row in done]
    compared = compare(done, planned.out, refit_base, refit_tool)
    if done:
        write_table(planned.out / "fleet.parquet", compared.rows, FLEET)
        write_table(planned.out / "drift.parquet", compared.drifts, DRIFT)
    return compared
