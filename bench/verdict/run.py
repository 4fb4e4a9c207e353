"""Can modcal's verdict be trusted? Recordings with faults that nobody planned for and good ones, judged one by one.

    python bench/verdict/run.py --only tool,quaternion --seeds 1 --jobs 2

Groups: ``main``; ``later``, kinds that were written later than the rest; ``fresh``, ``fresh_again``, ``fresh_third``,
``fresh_fourth``, ``fresh_fifth``, ``fresh_sixth``, ``fresh_seventh`` and ``fresh_eighth``, each written after the last
change to the code of its day and run once; ``real`` and ``ninth``, of real arms beside the checkout; ``good``;
``good_fifth`` and ``good_eighth``, healthy cells of other builds. A fault counts as named when what makes the verdict
open, or what was modelled, holds the joint, the place or the topic that is at fault.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
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

import conventions  # noqa: E402, F401 (registers its kinds)
import fresh  # noqa: E402, F401
import fresh_again  # noqa: E402, F401
import fresh_again_cell  # noqa: E402, F401
import fresh_eighth  # noqa: E402, F401
import fresh_eighth_arm  # noqa: E402, F401
import fresh_eighth_streams  # noqa: E402, F401
import fresh_fifth  # noqa: E402, F401
import fresh_fifth_arm  # noqa: E402, F401
import fresh_fourth  # noqa: E402, F401
import fresh_seventh  # noqa: E402, F401
import fresh_sixth  # noqa: E402, F401
import fresh_sixth_around  # noqa: E402, F401
import fresh_sixth_cells  # noqa: E402, F401
import fresh_third  # noqa: E402, F401
import fresh_third_arm  # noqa: E402, F401
import good  # noqa: E402, F401
import later  # noqa: E402, F401
import nearby  # noqa: E402, F401
import nearby_about  # noqa: E402, F401
import nearby_again  # noqa: E402, F401
import ninth  # noqa: E402, F401
import ninth_use  # noqa: E402, F401
import numpy as np  # noqa: E402
import physics  # noqa: E402, F401
import real  # noqa: E402, F401
import regimes  # noqa: E402, F401
import unusual  # noqa: E402, F401
import use  # noqa: E402, F401
from case import KINDS, Case  # noqa: E402
from eighth_cell import World  # noqa: E402
from judge import (  # noqa: E402
    AT_FLOOR,
    BESIDE,
    CALM_AND_WRONG,
    CANNOT_TELL,
    FAILED,
    FOUND,
    HARMLESS,
    NAMED,
    OPEN,
    SILENT,
    UNNAMED,
    Outcome,
    judge,
    variant,
)
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from workcell import Works  # noqa: E402

ROBOTS = ("ur10", "panda", "xarm7")
FAULTS = (CALM_AND_WRONG, NAMED, FOUND, UNNAMED, SILENT, HARMLESS, FAILED)
GOODS = (AT_FLOOR, BESIDE, CANNOT_TELL, OPEN, FAILED)
SEEDS = dict.fromkeys(KINDS, 1) | {"main": 2, "later": 2, "good": 4}
GOOD = ("good", "good_fifth", "good_eighth")
WORLDS = {"fresh_eighth": (("ur5e", "irb", "iiwa7"), World), "good_eighth": (("ur5e", "irb", "iiwa7"), World)}


@dataclass(frozen=True)
class Task:
    """One recording to be judged. way: how the floor of a good one is known."""

    group: str
    kind: str
    seed: int
    way: str = ""

    @property
    def robot(self) -> str:
        """The arm: the three in turn."""
        robots = WORLDS.get(self.group, (ROBOTS, Works))[0]
        return robots[(list(KINDS[self.group]).index(self.kind) + self.seed) % len(robots)]


def make(task: Task) -> Case:
    """The case of a task: the same for the same task."""
    rng = np.random.default_rng([zlib.crc32(task.kind.encode()), task.seed])
    world = WORLDS.get(task.group, (ROBOTS, Works))[1]
    case = KINDS[task.group][task.kind](world(task.robot, rng), rng)
    return variant(case, task.way) if task.way else case


def one(task: Task) -> dict[str, Any]:
    """The outcome of a task, as plain data."""
    done = asdict(task) | {"robot": task.robot}
    known = None if not task.way else task.way != "unknown"
    try:
        with tempfile.TemporaryDirectory(prefix="verdict_") as folder:
            return done | asdict(judge(make(task), Path(folder), known))
    except Exception:
        return done | asdict(Outcome(FAILED, "raised", traceback.format_exc(limit=-3), known=known))


def tasks_of(groups: list[str], only: list[str], seeds: int | None, first: int = 0) -> list[Task]:
    """The tasks of some groups, of the kinds whose names hold one of ``only``."""
    out = []
    for group in groups:
        for name in KINDS[group]:
            if only and not any(part in name for part in only):
                continue
            for seed in range(first, first + (SEEDS.get(group, 1) if seeds is None else seeds)):
                if group in GOOD:
                    out.append(Task(group, name, seed, "stated" if seed % 3 == 2 else "returns"))
                    out.append(Task(group, name, seed, "unknown"))
                else:
                    out.append(Task(group, name, seed))
    return out


def confusion(results: list[dict[str, Any]], console: Console) -> None:
    """The tables, calm and wrong first."""
    for group, title in (
        ("main", "Faults"),
        ("real", "Faults in real recordings"),
        ("later", "Kinds written later"),
        ("fresh", "Kinds once written after the last change"),
        ("fresh_again", "Kinds once written after the last change, again"),
        ("fresh_third", "Kinds once written after the last change, third group"),
        ("fresh_fourth", "Kinds once written after the last change, fourth group"),
        ("nearby", "Kinds near those that were missed"),
        ("fresh_fifth", "Kinds once written after the last change, fifth group"),
        ("fresh_sixth", "Kinds once written after the last change, sixth group"),
        ("fresh_seventh", "Kinds once written after the last change, seventh group"),
        ("fresh_eighth", "Kinds written after the last change, in cells of their own"),
        ("ninth", "Real recordings, tampered with"),
    ):
        rows = [r for r in results if r["group"] == group]
        if not rows:
            continue
        table = Table(title=title)
        table.add_column("kind")
        for name in FAULTS:
            table.add_column(name, justify="right")
        for kind in dict.fromkeys(r["kind"] for r in rows):
            counts = Counter(r["outcome"] for r in rows if r["kind"] == kind)
            table.add_row(kind, *(str(counts[name] or "") for name in FAULTS))
        counts = Counter(r["outcome"] for r in rows)
        table.add_section()
        table.add_row("all", *(str(counts[name]) for name in FAULTS))
        console.print(table)
        shown = len(rows) - counts[HARMLESS]
        named = counts[NAMED] + counts[FOUND]
        console.print(
            f"{title}: calm and wrong {counts[CALM_AND_WRONG]} of {len(rows)}; of {shown} whose data show the fault "
            f"{counts[NAMED]} open and named, {counts[FOUND]} modelled down to the floor and named: "
            f"{100 * named / max(shown, 1):.0f} %\n"
        )
    rows = [r for r in results if r["group"] in GOOD]
    if not rows:
        return
    table = Table(title="Good recordings")
    table.add_column("kind")
    for known in ("floor known", "not known"):
        for name in (AT_FLOOR, CANNOT_TELL, OPEN):
            table.add_column(f"{known}: {name}", justify="right")
    for kind in [*dict.fromkeys(r["kind"] for r in rows), "all"]:
        cells = []
        for known in (True, False):
            counts = Counter(r["outcome"] for r in rows if kind in (r["kind"], "all") and r["known"] is known)
            cells += [str(counts[name] or "") for name in (AT_FLOOR if known else BESIDE, CANNOT_TELL, OPEN)]
        if kind == "all":
            table.add_section()
        table.add_row(kind, *cells)
    console.print(table)
    for known in (True, False):
        here = [r for r in rows if r["known"] is known]
        counts = Counter(r["outcome"] for r in here)
        console.print(
            f"Good, floor {'known' if known else 'not known'}: {len(here)} recordings, {counts[OPEN]} open, "
            f"{counts[AT_FLOOR] + counts[BESIDE]} at the floor ({100 * counts[AT_FLOOR] / max(len(here), 1):.0f} %), "
            f"{counts[CANNOT_TELL]} cannot tell, {counts[FAILED]} failed"
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--groups", default=",".join(KINDS), help="comma-separated; default: all")
    parser.add_argument("--only", default="", help="comma-separated parts of kinds' names")
    parser.add_argument(
        "--seeds", type=int, default=None, help="of each kind; default: main and later 2, good 4, others 1"
    )
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
            result = future.result()
            results.append(result)
            print(f"[{done}/{len(tasks)}] {line(result)}", file=sys.stderr, flush=True)
            if log:
                log.write(json.dumps(result) + "\n")
                log.flush()
    if log:
        log.close()
    order = {task: k for k, task in enumerate(tasks)}
    results.sort(key=lambda r: order[Task(r["group"], r["kind"], r["seed"], r["way"])])
    console = Console(width=None if sys.stdout.isatty() else 170)
    confusion(results, console)
    bad = (CALM_AND_WRONG, UNNAMED, SILENT, FAILED, OPEN, BESIDE)
    for r in sorted((r for r in results if r["outcome"] in bad), key=lambda r: bad.index(r["outcome"])):
        console.print(line(r), markup=False, soft_wrap=True)
    return 1 if any(r["outcome"] in (CALM_AND_WRONG, FAILED) for r in results) else 0


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
