"""Can modcal's verdict be trusted? Recordings with faults that nobody planned for and good ones, judged one by one.

    python bench/verdict/run.py --only tool,quaternion --seeds 1 --jobs 2

A fault counts as named when what makes the verdict open, or what was modelled, holds the joint, the place or the topic
that is at fault; a cause is named falsely when it is none of the case's.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import importlib
import json
import multiprocessing
import sys
import tempfile
import traceback
import zlib
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import judge as j
import numpy as np
from case import KINDS, Case
from rich.console import Console
from rich.table import Table
from workcell import Works
from world import ARMS, World

for _file in sorted((Path(__file__).parent / "kinds").glob("*.py")):
    importlib.import_module(f"kinds.{_file.stem}")  # which registers its rows


@dataclass(frozen=True)
class Group:
    """Kinds that are reported together. seeds: of each kind, unless asked otherwise; robots: the arms, in turn."""

    title: str
    seeds: int = 1
    cell: type[Works] | type[World] = Works
    robots: tuple[str, ...] = ("ur10", "panda", "xarm7")


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
    "fresh_eighth": Group(f"{ONCE}, eighth group, in cells of its own", 1, World, tuple(ARMS)[:3]),
    "ninth": Group("Real recordings, tampered with"),
    "good": Group("Good recordings", 4),
    "good_fifth": Group("Good recordings of other builds"),
    "good_eighth": Group("Good recordings, in cells of their own", 1, World, tuple(ARMS)[:3]),
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
        title, n = GROUPS[group].title, Counter(r["outcome"] for r in rows)
        shown, named = len(rows) - n[j.HARMLESS], n[j.NAMED] + n[j.FOUND]
        told = (
            f"{title}: calm and wrong {n[j.CALM_AND_WRONG]} of {len(rows)}; of {shown} whose data show the fault "
            f"{n[j.NAMED]} open and named, {n[j.FOUND]} modelled down to the floor and named: "
            f"{100 * named / max(shown, 1):.0f} %; named falsely in {sum(bool(r['false']) for r in rows)}\n"
        )
        table(console, title, rows, FAULTS, told)
    rows = [r for r in results if r["group"].startswith("good")]
    for known, words, floor in ((True, "floor known", j.AT_FLOOR), (False, "floor not known", j.BESIDE)):
        here = [r for r in rows if r["known"] is known]
        n = Counter(r["outcome"] for r in here)
        told = (
            f"Good, {words}: {len(here)} recordings, {n[j.OPEN]} open, {n[floor]} at the floor "
            f"({100 * n[floor] / max(len(here), 1):.0f} %), {n[j.CANNOT_TELL]} cannot tell, {n[j.FAILED]} failed; "
            f"effects that nobody planted in {sum(bool(r['false']) for r in here)}\n"
        )
        table(console, f"Good recordings, {words}", here, (floor, j.CANNOT_TELL, j.OPEN), told)


def table(console: Console, title: str, rows: list[dict[str, Any]], columns: tuple[str, ...], told: str) -> None:
    """A row a kind and one of all, a column for each outcome and one of what is named falsely; a sentence below."""
    if not rows:
        return
    made = Table("kind", title=title)
    for name in (*columns, "named falsely"):
        made.add_column(name, justify="right")
    for kind in [*dict.fromkeys(r["kind"] for r in rows), "all"]:
        here = [r for r in rows if kind in (r["kind"], "all")]
        n = Counter(r["outcome"] for r in here)
        if kind == "all":
            made.add_section()
        counts = [*(n[name] for name in columns), sum(bool(r["false"]) for r in here)]
        made.add_row(kind, *(str(v or ("0" if kind == "all" else "")) for v in counts))
    console.print(made)
    console.print(told)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--groups", default=",".join(GROUPS), help="comma-separated; default: all")
    parser.add_argument("--only", default="", help="comma-separated parts of kinds' names")
    parser.add_argument("--seeds", type=int, help="of each kind; default: main and later 2, good 4, others 1")
    parser.add_argument("--first", type=int, default=0, help="seed of each kind; default: 0")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument(
        "--json", type=Path, default=Path(os.devnull), metavar="FILE", help="a line of JSON a recording"
    )
    given = parser.parse_args()
    only = [part for part in given.only.split(",") if part]
    tasks = tasks_of(given.groups.split(","), only, given.seeds, given.first)
    spawn, results = multiprocessing.get_context("spawn"), {}
    with given.json.open("w", encoding="utf-8") as log, ProcessPoolExecutor(given.jobs, mp_context=spawn) as pool:
        waiting = {pool.submit(one, task): task for task in tasks}
        for done, future in enumerate(as_completed(waiting), 1):
            results[waiting[future]] = result = future.result()
            print(f"[{done}/{len(tasks)}] {line(result)}", file=sys.stderr, flush=True)
            print(json.dumps(result), file=log, flush=True)
    said = [results[task] for task in tasks]
    console = Console(width=None if sys.stdout.isatty() else 170)
    confusion(said, console)
    for outcome in (j.CALM_AND_WRONG, j.UNNAMED, j.SILENT, j.FAILED, j.OPEN, j.BESIDE):
        for r in (r for r in said if r["outcome"] == outcome):
            console.print(line(r), markup=False, soft_wrap=True)
    for r in (r for r in said if r["false"]):
        console.print("named falsely:", *r["false"], line(r), sep=" | ", markup=False, soft_wrap=True)
    return 1 if any(r["outcome"] in (j.CALM_AND_WRONG, j.FAILED) for r in said) else 0


def line(r: dict[str, Any]) -> str:
    """One recording in a line."""
    way, left = f" {r['way']}" if r["way"] else "", f", {r['left']:.2f} x floor" if r["left"] == r["left"] else ""
    here = f"{r['outcome']}: {r['kind']} {r['robot']} {r['seed']}{way}: {r['status']}{left}, {r['seconds']:.1f} s"
    return f"{here}: {r['text'][:400]}"


if __name__ == "__main__":
    sys.exit(main())
