"""Can modcal's verdict be trusted? Recordings with faults that nobody planned for and good ones, judged one by one.

    make bench NAME=verdict ARGS="--groups main --only tool,quaternion --seeds 1"

A fault counts as named when what makes the verdict open, or what was modelled, holds the joint, the place or the topic
that is at fault; a cause is named falsely when it is none of the case's.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
import importlib
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass

import judge as j
import numpy as np
from case import KINDS, Case
from sites import Cell
from world import ARMS, World, cell_of

for _file in sorted((Path(__file__).parent / "kinds").glob("*.py")):
    importlib.import_module(f"kinds.{_file.stem}")  # which registers its rows


@dataclass(frozen=True)
class Group:
    """Kinds that are reported together. seeds: of each kind, unless asked otherwise; robots: the arms, in turn."""

    title: str
    seeds: int = 1
    cell: Callable[[str, np.random.Generator], Cell] = Cell
    robots: tuple[str, ...] = ("ur10", "panda", "xarm7")


OWN = World, tuple(ARMS)[:3]
ANY = cell_of, ("ur5e", "panda", "irb", "xarm7", "iiwa7", "ur10")
ONCE = ("fresh", "fresh_again", "fresh_third", "fresh_fourth", "fresh_fifth", "fresh_sixth", "fresh_seventh")
GROUPS = {
    "main": Group("Faults", 2),
    "real": Group("Faults in real recordings"),
    "later": Group("Kinds written later", 2),
    **{name: Group(f"Kinds once written after the last change: {name}") for name in ONCE},
    "nearby": Group("Kinds near those that were missed"),
    "fresh_eighth": Group("Kinds once written after the last change: eighth group, in cells of its own", 1, *OWN),
    "ninth": Group("Real recordings, tampered with"),
    "fresh_tenth": Group("Kinds once written after the last change: tenth group, of any arm", 1, *ANY),
    "audit": Group("Kinds of an independent tester"),
    "good": Group("Good recordings", 4),
    "good_fifth": Group("Good recordings of other builds"),
    "good_eighth": Group("Good recordings, in cells of their own", 1, *OWN),
    "good_tenth": Group("Good recordings that look odd", 1, *ANY),
    "good_audit": Group("Good recordings of an independent tester"),
}
FAULTS = (j.CALM_AND_WRONG, j.NAMED, j.FOUND, j.UNNAMED, j.SILENT, j.HARMLESS, j.FAILED)


def robot_of(task: harness.Task) -> str:
    """The arm: those of the group in turn."""
    robots = GROUPS[task["group"]].robots
    return robots[(list(KINDS[task["group"]]).index(task["kind"]) + task["seed"]) % len(robots)]


def make(task: harness.Task) -> Case:
    """The case of a task: the same for the same task."""
    rng = np.random.default_rng([zlib.crc32(task["kind"].encode()), task["seed"]])
    case = KINDS[task["group"]][task["kind"]](GROUPS[task["group"]].cell(robot_of(task), rng), rng)
    return j.variant(case, task["way"]) if task["way"] else case


def one(task: harness.Task) -> harness.Result:
    """The outcome of a task, as plain data. way: how the floor of a good one is known."""
    known = None if not task["way"] else task["way"] != "unknown"
    with harness.scratch() as folder:
        return {"robot": robot_of(task), **asdict(j.judge(make(task), folder, known))}


def tasks_of(groups: list[str], only: list[str], seeds: int | None, first: int = 0) -> list[harness.Task]:
    """The tasks of some groups, of all kinds or ``only`` some; good ones with and without a floor."""
    out = []
    for group in groups:
        for kind in (name for name in KINDS.get(group, {}) if not only or name in only):
            for seed in range(first, first + (GROUPS[group].seeds if seeds is None else seeds)):
                ways = ("stated" if seed % 3 == 2 else "returns", "unknown") if group.startswith("good") else ("",)
                out += [{"group": group, "kind": kind, "seed": seed, "way": way} for way in ways]
    return out


def table(title: str, results: list[harness.Result], columns: tuple[str, ...]) -> Counter[str]:
    """A row a kind and one of all, a column for each outcome and one of what is named falsely; the counts of all."""
    rows: list[list[object] | None] = []
    for kind in [*dict.fromkeys(r["kind"] for r in results), "all"]:
        here = [r for r in results if kind in (r["kind"], "all")]
        n = Counter(r["outcome"] for r in here)
        n["falsely"] = sum(bool(r["false"]) for r in here)
        rows += [None] * (kind == "all") + [[kind, *(n[name] or "" for name in (*columns, "falsely"))]]
    harness.table(title, ["kind", *columns, "named falsely"], rows)
    return n


def show(results: list[harness.Result]) -> None:
    """The tables, calm and wrong first."""
    for group in [g for g in GROUPS if not g.startswith("good")]:
        if rows := [r for r in results if r["group"] == group]:
            n = table(GROUPS[group].title, rows, FAULTS)
            shown, named = len(rows) - n[j.HARMLESS], n[j.NAMED] + n[j.FOUND]
            harness.say(
                f"calm and wrong {n[j.CALM_AND_WRONG]} of {len(rows)}; of {shown} whose data show the fault "
                f"{n[j.NAMED]} open and named, {n[j.FOUND]} modelled down to the floor and named: "
                f"{100 * named / max(shown, 1):.0f} %; named falsely in {n['falsely']}\n"
                + ", ".join(f"{word} {count}" for word, count in Counter(r["word"] for r in rows).most_common())
            )
    for known, words, floor in ((True, "floor known", j.AT_FLOOR), (False, "floor not known", j.BESIDE)):
        if rows := [r for r in results if r["group"].startswith("good") and r["known"] is known]:
            n = table(f"Good recordings, {words}", rows, (floor, j.CANNOT_TELL, j.OPEN, j.FAILED))
            harness.say(f"effects that nobody planted in {n['falsely']} of {len(rows)}\n")


def line(r: harness.Result) -> str:
    left = f", {r['left']:.2f} x floor" if r["left"] == r["left"] else ""
    return f"{r['outcome']}: {r['status']}{left}, {r['seconds']:.1f} s: {r['text'][:400]}"


def main() -> int:
    """Exit code: 0 where nothing is calm and wrong, and nothing failed."""
    parser = harness.parser(__doc__, seeds=None)
    parser.add_argument("--groups", default=",".join(GROUPS), help="comma-separated; default: all")
    parser.add_argument("--only", dest="kinds", nargs="+", default=[], help="kinds, or parts of their names")
    given = harness.parsed(parser)
    try:
        only = given.kinds and harness.chosen([name for rows in KINDS.values() for name in rows], given.kinds)
    except LookupError as error:
        parser.error(str(error).partition(";")[0])
    results = harness.each(one, tasks_of(given.groups.split(","), only, given.seeds, given.first), given, line)
    for r in results:
        if r["failed"]:
            r |= asdict(j.Outcome(j.FAILED, "raised", r["failed"], known=r["way"] != "unknown" if r["way"] else None))
    show(results)
    for outcome in (j.CALM_AND_WRONG, j.UNNAMED, j.SILENT, j.FAILED, j.OPEN, j.BESIDE):
        harness.say(*(f"{r['kind']} {r['seed']} {r['way']}: {line(r)}" for r in results if r["outcome"] == outcome))
    harness.say(*(f"named falsely: {r['kind']} {r['seed']}: {' | '.join(r['false'])}" for r in results if r["false"]))
    return int(any(r["outcome"] in (j.CALM_AND_WRONG, j.FAILED) for r in results))


if __name__ == "__main__":
    sys.exit(main())
