"""Can modcal's verdict be trusted? Recordings with faults that nobody planned for and good ones, judged one by one.

    python bench/verdict/run.py --only tool,quaternion --seeds 1 --jobs 2

A fault counts as named when what makes the verdict open, or what was modelled, holds the joint, the place or the topic
that is at fault; a cause is named falsely when it is none of the case's.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import importlib  # noqa: E402
import json  # noqa: E402
import multiprocessing  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import traceback  # noqa: E402
import zlib  # noqa: E402
from collections import Counter  # noqa: E402
from concurrent.futures import ProcessPoolExecutor, as_completed  # noqa: E402
from dataclasses import asdict, dataclass  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import judge as j  # noqa: E402
import numpy as np  # noqa: E402
from case import KINDS, Case  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from workcell import Works  # noqa: E402
from world import World  # noqa: E402

for _file in sorted((Path(__file__).parent / "kinds").glob("*.py")):
    importlib.import_module(f"kinds.{_file.stem}")  # which registers its rows


@dataclass(frozen=True)
class Group:
    """Kinds that are reported together. seeds: of each kind, unless asked otherwise; robots: the arms, in turn."""

    title: str
    seeds: int = 1
    cell: type[Works] | type[World] = Works
    robots: tuple[str, ...] = ("ur10", "panda", "xarm7")


ARMS = {"cell": World, "robots": ("ur5e", "irb", "iiwa7")}
ONCE = "Kinds once written after the last change"
GROUPS = {
    "main": Group("Faults", 2),
    "real": Group("Faults in real recordings"),
    "later": Group("Kinds written later", 2),
    "fresh": Group(ONCE),
    "fresh_again": Group(f"{ONCE}, again"),
    "fresh_third": Group(f"{ONCE}, third group"),
    "fresh_fourth": Group(f"{ONCE}, fourth group"),
    "nearby": Group("Kinds near those that were missed"),
    "fresh_fifth": Group(f"{ONCE}, fifth group"),
    "fresh_sixth": Group(f"{ONCE}, sixth group"),
    "fresh_seventh": Group(f"{ONCE}, seventh group"),
    "fresh_eighth": Group("Kinds written after the last change, in cells of their own", **ARMS),
    "ninth": Group("Real recordings, tampered with"),
    "good": Group("Good recordings", 4),
    "good_fifth": Group("Good recordings of other builds"),
    "good_eighth": Group("Good recordings in cells of their own", **ARMS),
}
FAULTS = (j.CALM_AND_WRONG, j.NAMED, j.FOUND, j.UNNAMED, j.SILENT, j.HARMLESS, j.FAILED)


@dataclass(frozen=True)
class Task:
    """One recording to be judged. way: how the floor of a good one is known."""

    group: str
    kind: str
    seed: int
    way: str = ""

    @property
    def robot(self) -> str:
        """The arm: those of the group in turn."""
        robots = GROUPS[self.group].robots
        return robots[(list(KINDS[self.group]).index(self.kind) + self.seed) % len(robots)]


def make(task: Task) -> Case:
    """The case of a task: the same for the same task."""
    rng = np.random.default_rng([zlib.crc32(task.kind.encode()), task.seed])
    case = KINDS[task.group][task.kind](GROUPS[task.group].cell(task.robot, rng), rng)
    return j.variant(case, task.way) if task.way else case


def one(task: Task) -> dict[str, Any]:
    """The outcome of a task, as plain data."""
    done = asdict(task) | {"robot": task.robot}
    known = None if not task.way else task.way != "unknown"
    try:
        with tempfile.TemporaryDirectory(prefix="verdict_") as folder:
            return done | asdict(j.judge(make(task), Path(folder), known))
    except Exception:
        return done | asdict(j.Outcome(j.FAILED, "raised", traceback.format_exc(limit=-3), known=known))


def tasks_of(groups: list[str], only: list[str], seeds: int | None, first: int = 0) -> list[Task]:
    """The tasks of some groups, of the kinds whose names hold one of ``only``; good ones with and without a floor."""
    out = []
    for group in groups:
        for name in (name for name in KINDS.get(group, {}) if not only or any(part in name for part in only)):
            for seed in range(first, first + (GROUPS[group].seeds if seeds is None else seeds)):
                ways = ("stated" if seed % 3 == 2 else "returns", "unknown") if group.startswith("good") else ("",)
                out += [Task(group, name, seed, way) for way in ways]
    return out


def confusion(results: list[dict[str, Any]], console: Console) -> None:
    """The tables, calm and wrong first."""
    for group, rows in ((g, [r for r in results if r["group"] == g]) for g in GROUPS if not g.startswith("good")):
        if not rows:
            continue
        title, counts = GROUPS[group].title, Counter(r["outcome"] for r in rows)
        _print(console, title, rows, [(name, lambda r, name=name: r["outcome"] == name) for name in FAULTS])
        shown, named = len(rows) - counts[j.HARMLESS], counts[j.NAMED] + counts[j.FOUND]
        console.print(
            f"{title}: calm and wrong {counts[j.CALM_AND_WRONG]} of {len(rows)}; of {shown} whose data show the fault "
            f"{counts[j.NAMED]} open and named, {counts[j.FOUND]} modelled down to the floor and named: "
            f"{100 * named / max(shown, 1):.0f} %; named falsely in {sum(bool(r['false']) for r in rows)}\n"
        )
    rows = [r for r in results if r["group"].startswith("good")]
    if not rows:
        return
    ways, columns = ((True, "floor known", j.AT_FLOOR), (False, "not known", j.BESIDE)), []
    for known, words, floor in ways:
        for name, outcome in ((j.AT_FLOOR, floor), (j.CANNOT_TELL, j.CANNOT_TELL), (j.OPEN, j.OPEN)):
            is_one = lambda r, known=known, outcome=outcome: r["known"] is known and r["outcome"] == outcome  # noqa: E731
            columns.append((f"{words}: {name}", is_one))
    _print(console, "Good recordings", rows, columns)
    for known, words, _ in ways:
        here = [r for r in rows if r["known"] is known]
        counts = Counter(r["outcome"] for r in here)
        console.print(
            f"Good, {words}: {len(here)} recordings, {counts[j.OPEN]} open, "
            f"{counts[j.AT_FLOOR] + counts[j.BESIDE]} at the floor "
            f"({100 * (counts[j.AT_FLOOR] + counts[j.BESIDE]) / max(len(here), 1):.0f} %), "
            f"{counts[j.CANNOT_TELL]} cannot tell, {counts[j.FAILED]} failed; "
            f"effects that nobody planted in {sum(bool(r['false']) for r in here)}"
        )


def _print(console: Console, title: str, rows: list[dict[str, Any]], columns: list[tuple[str, Any]]) -> None:
    """One table: a row a kind and one of all, a column for each count and one of what was named falsely."""
    table = Table("kind", title=title)
    columns = [*columns, ("named falsely", lambda r: bool(r["false"]))]
    for name, _ in columns:
        table.add_column(name, justify="right")
    for kind in [*dict.fromkeys(r["kind"] for r in rows), "all"]:
        here = [r for r in rows if kind in (r["kind"], "all")]
        if kind == "all":
            table.add_section()
        table.add_row(kind, *(str(sum(map(of, here)) or ("0" if kind == "all" else "")) for _, of in columns))
    console.print(table)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--groups", default=",".join(GROUPS), help="comma-separated; default: all")
    parser.add_argument("--only", default="", help="comma-separated parts of kinds' names")
    parser.add_argument("--seeds", type=int, help="of each kind; default: main and later 2, good 4, others 1")
    parser.add_argument("--first", type=int, default=0, help="seed of each kind; default: 0")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path, default=None, metavar="FILE", help="a line of JSON a recording")
    given = parser.parse_args()
    only = [part for part in given.only.split(",") if part]
    tasks = tasks_of(given.groups.split(","), only, given.seeds, given.first)
    results: list[dict[str, Any]] = []
    log = given.json.open("w", encoding="utf-8") if given.json else None
    with ProcessPoolExecutor(given.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        waiting = {pool.submit(one, task): task for task in tasks}
        for done, future in enumerate(as_completed(waiting), 1):
            results.append(future.result())
            print(f"[{done}/{len(tasks)}] {line(results[-1])}", file=sys.stderr, flush=True)
            if log:
                log.write(json.dumps(results[-1]) + "\n")
                log.flush()
    if log:
        log.close()
    order = {task: k for k, task in enumerate(tasks)}
    results.sort(key=lambda r: order[Task(r["group"], r["kind"], r["seed"], r["way"])])
    console = Console(width=None if sys.stdout.isatty() else 170)
    confusion(results, console)
    bad = (j.CALM_AND_WRONG, j.UNNAMED, j.SILENT, j.FAILED, j.OPEN, j.BESIDE)
    for r in sorted((r for r in results if r["outcome"] in bad), key=lambda r: bad.index(r["outcome"])):
        console.print(line(r), markup=False, soft_wrap=True)
    for r in (r for r in results if r["false"]):
        console.print(f"named falsely: {r['kind']} {r['robot']} {r['seed']}: {' | '.join(r['false'])}", markup=False)
    return 1 if any(r["outcome"] in (j.CALM_AND_WRONG, j.FAILED) for r in results) else 0


def line(r: dict[str, Any]) -> str:
    """One recording in a line."""
    way = f" {r['way']}" if r["way"] else ""
    left = f", {r['left']:.2f} x floor" if r["left"] == r["left"] else ""
    return (
        f"{r['outcome']}: {r['kind']} {r['robot']} {r['seed']}{way}: {r['status']}{left}, {r['seconds']:.1f} s"
        f": {r['text'][:400]}"
    )


if __name__ == "__main__":
    sys.exit(main())
