"""Has an arm changed, by ordinary recordings? 200 simulated weeks without a change, and planted changes, in MuJoCo.

An arm has a reference recording of each of twelve weeks, of three tasks. *Weeks*: each later week's recording is judged
beside all before it; in some weeks the task is another, in some a payload is declared. An alarm counts in the week that
it begins in. *Planted*: two recordings with a change, judged with tag and without; of every joint a zero of one degree,
and of every kind the size that the report says it would have noticed in 95 of 100 cases. Right: named within two
recordings; *one of*: it is among what may as well be. A joint is named alone, first, or in the set. *Threshold*, on the
same data: the mean of |commanded − measured| of some joint is four standard deviations of the reference recordings
beyond their mean.
"""

from __future__ import annotations

import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness
import numpy as np
from sentinel.worlds import NONE, ArmWorld, Change

from modcal_core.robots import read_inertias
from modcal_core.sentinel import ArmJudge, ArmVerdict, Cells, MonitoredArm, Normal, cells_of

Named = dict[str, Any]
KINDS = {  # kind in the world, size, kind as it is named, factor of the unit that people read
    "zero 1°": ("zero", np.radians(1.0), "joint_zero", 1e3), "zero 0.3°": ("zero", np.radians(0.3), "joint_zero", 1e3),
    "play 10 mrad": ("play", 0.01, "play", 1e3), "friction +30 %": ("friction", 0.3, "friction", 1e2),
    "payload 0.5 kg": ("payload", 0.5, "carried_mass", 1.0), "latency 20 ms": ("latency", 0.02, "latency", 1e3),
    "camera 5 mm": ("camera", 0.005, "camera", 1e3), "ratio 1 %": ("ratio", 0.01, "gear", 1e6),
}  # fmt: skip
OF_A_JOINT = {"zero": "zero of", "play": "play of", "friction": "friction of", "ratio": "gear of"}
LABELS = {"payload": "payload", "latency": "latency of all joints"}
REFERENCE, TASKS, SIGMAS = 12, 3, 4.0
OTHER_TASK, DECLARED = 0.1, 0.15  # shares of the weeks


@dataclass(frozen=True)
class WatchedArm:
    """An arm, what is normal for it with a tag and without, and the threshold's limit of each joint."""

    world: ArmWorld
    judges: dict[bool, ArmJudge]
    limit: np.ndarray

    @classmethod
    def of(cls, robot: str, seed: int, seconds: float) -> WatchedArm:
        """After its reference period."""
        world = ArmWorld(robot, seed, tag=True)
        arm = MonitoredArm(world.chain.names, world.chain, read_inertias(world.urdf, world.chain))
        reference = [heard(world, week, seconds, week % TASKS) for week in range(REFERENCE)]
        normal = Normal.fit(reference, arm)
        of = {name: signal for name, signal in normal.signals.items() if not name.startswith("tag ")}
        judges = {True: ArmJudge(normal), False: ArmJudge(replace(normal, signals=of))}
        level = np.array([following(c) for c in reference])
        return cls(world, judges, level.mean(axis=0) + SIGMAS * level.std(axis=0, ddof=1))

    def judged(self, later: Sequence[Cells], tag: bool) -> ArmVerdict:
        """By these recordings."""
        judge = self.judges[tag]
        return judge.judged([judge.hear(cells) for cells in later])

    def plain(self, cells: Cells) -> bool:
        """Whether the threshold calls it changed."""
        return bool((following(cells) > self.limit).any())


def heard(world: ArmWorld, week: int, seconds: float, task: int, change: Change = NONE) -> Cells:
    made = world.record(week, seconds, task, change, began=1.7e9 + 604800.0 * week)
    return cells_of(made, world.chain.names, f"week {week}")


def following(cells: Cells) -> np.ndarray:
    return np.nanmean(np.abs(cells[f"apart:{cells.of('apart')[0]}"]), axis=0)


def weeks(task: dict[str, Any]) -> dict[str, Any]:
    """All weeks of an arm in which nothing changes."""
    arm = WatchedArm.of(task["robot"], task["seed"], task["seconds"])
    rng = np.random.default_rng((task["seed"], 77))
    bags: dict[bool, list[Any]] = {tag: [] for tag in arm.judges}
    alarmed = dict.fromkeys(arm.judges, "")
    cases: list[Named] = []
    for week in range(REFERENCE, task["weeks"]):
        drawn = rng.random()
        kind = "other task" if drawn < OTHER_TASK else "declared" if drawn < OTHER_TASK + DECLARED else "usual"
        change = Change("payload", -1, rng.uniform(0.5, 2.0)) if kind == "declared" else NONE
        of = int(rng.integers(5, 50)) if kind == "other task" else int(rng.integers(0, TASKS))
        cells = heard(arm.world, week, task["seconds"], of, change)
        bag = arm.judges[True].hear(cells, kind == "declared")
        plain = {name: of for name, of in bag.signals.items() if not name.startswith("tag ")}
        for tag, judge in arm.judges.items():
            bags[tag] = [*bags[tag], bag if tag else replace(bag, signals=plain)]
            found = judge.judged(bags[tag])
            begins = found.status == "changed" and not alarmed[tag]
            alarmed[tag] = found.sentence if found.changes else ""
            cases.append({"week": week, "kind": kind, "tag": tag, "hours": cells.seconds / 3600.0, "begins": begins,
                          "status": found.status, "said": alarmed[tag], "log_e": round(float(found.log_e), 2),
                          "asked": round(found.asked, 2), "plain": arm.plain(cells)})  # fmt: skip
    return {"cases": cases}


def planted(task: dict[str, Any]) -> dict[str, Any]:
    """Changes of an arm, each by itself."""
    arm = WatchedArm.of(task["robot"], task["seed"], task["seconds"])
    rng, week = np.random.default_rng((task["seed"], 78)), REFERENCE
    quiet = heard(arm.world, week, task["seconds"], 0)
    noticed = {tag: arm.judged([quiet], tag).noticed for tag in arm.judges}
    cases: list[Named] = []
    for name, change, label, of in asked(arm.world, task["kinds"], noticed, rng):
        later = [heard(arm.world, (week := week + 1), task["seconds"], k % TASKS, change) for k in range(2)]
        about = {"kind": name, "joint": change.joint, "size": change.size, "plain": arm.plain(later[0])}
        for tag in of:
            size, unit = noticed[tag].get(label, (None, ""))
            found = outcome([arm.judged(later[:k], tag) for k in (1, 2)], change.kind, label)
            cases.append({**about, "tag": tag, "noticed": size, "unit": unit, **found})
    return {"cases": cases, "noticed": {str(t): {k: v[0] for k, v in of.items()} for t, of in noticed.items()}}


def asked(
    world: ArmWorld, kinds: Sequence[str], noticed: dict[bool, Any], rng: np.random.Generator
) -> Iterator[tuple[str, Change, str, tuple[bool, ...]]]:
    """Name, change, label, and with or without a tag: the kinds at their sizes, and at what would be noticed."""
    names = world.chain.names
    for name in kinds:
        kind, size, _, factor = KINDS[name]
        single = kind in OF_A_JOINT
        joint = int(rng.integers(0, len(names)))
        for j in range(len(names)) if name == "zero 1°" else [joint]:
            yield name, Change(kind, j, size), label_of(kind, names[j]), (True, False)
        for tag in (True, False) if name != "zero 0.3°" else ():
            labels = [label_of(kind, n) for n in names] if single else [label_of(kind, "")]
            known = [(j, label) for j, label in enumerate(labels) if label in noticed[tag]]
            if known:
                j, label = known[int(rng.integers(0, len(known)))]
                least = noticed[tag][label][0] / factor
                yield f"{kind} as noticed", Change(kind, j if single else -1, least), label, (tag,)


def label_of(kind: str, joint: str) -> str:
    return f"{OF_A_JOINT[kind]} {joint}" if kind in OF_A_JOINT else LABELS.get(kind, kind)


def outcome(found: Sequence[ArmVerdict], kind: str, label: str) -> Named:
    """What came of one and of two recordings."""
    for k, verdict in enumerate(found):
        for change in verdict.changes[:1]:
            said = "right" if change.label == label else "one of" if label in change.same_as else "wrong"
            joint = label.rpartition(" of ")[2] if kind in OF_A_JOINT else ""
            named = [one.rpartition(" of ")[2] for one in (change.label, *change.same_as)]
            return {"outcome": said, "recordings": k + 1, "first": joint in ("", named[0]),
                    "among": joint in ("", *named), "alone": not change.same_as, "said": verdict.sentence,
                    "more": len(verdict.changes) - 1}  # fmt: skip
    return {"outcome": "not found", "log_e": round(float(found[-1].log_e), 1)}


def tell_weeks(results: Sequence[Named]) -> None:
    for tag in (True, False):
        cases = [case for r in results for case in r["cases"] if case["tag"] is tag]
        hours, plain = sum(case["hours"] for case in cases), sum(case["plain"] for case in cases)
        alarms = [case for case in cases if case["begins"]]
        harness.say(f"{'with' if tag else 'without'} a tag: {hours:.1f} h in {len(cases)} recordings")
        harness.say(f"  {len(alarms)} alarms, {sum(c['status'] == 'changed' for c in cases)} recordings in alarm")
        harness.say(f"  threshold: {plain} recordings in alarm")
        for kind in ("usual", "declared", "other task"):
            status = dict(Counter(case["status"] for case in cases if case["kind"] == kind))
            harness.say(f"  {kind}: {status}, alarms {sum(case['kind'] == kind for case in alarms)}")
        for case in alarms:
            harness.say(f"    week {case['week']}: {case['said']}")


def tell_planted(results: Sequence[Named]) -> None:
    for tag in (True, False):
        mine = [case for r in results for case in r["cases"] if case["tag"] is tag]
        harness.say(f"{'with' if tag else 'without'} a tag")
        for name in dict.fromkeys(case["kind"] for case in mine):
            of = [case for case in mine if case["kind"] == name]
            harness.say(f"  {name:20} {counted(of)}")
        shown = [c for c in mine if c["kind"] == "zero 1°" and c["noticed"] is not None and c["noticed"] < 17.45]
        harness.say(f"  zero 1°, where one degree would be noticed: {counted(shown)}")
        sizes = defaultdict(list)
        for r in results:
            for label, size in r["noticed"][str(tag)].items():
                sizes[label.partition(" of ")[0]].append(size)
        for label, of in sizes.items():
            low, middle, high = np.percentile(of, [10, 50, 90])
            harness.say(f"  noticed, {label:20} median {middle:.3g}, 10 to 90 %: {low:.3g} to {high:.3g}, of {len(of)}")


def counted(cases: Sequence[Named]) -> str:
    found = [case for case in cases if case["outcome"] != "not found"]
    alone, first, among = (
        sum(case["among"] and (case["alone"] or k > 0) and (case["first"] or k > 1) for case in found) for k in range(3)
    )
    plain = sum(case["plain"] for case in cases)
    joints = f"joint alone {alone}, first {first}, in the set {among} of {len(found)}"
    return f"{dict(Counter(c['outcome'] for c in cases))}, {joints}, threshold {plain}/{len(cases)}"


def main() -> None:
    """Run, and print the tables."""
    robots, what = ["ur10", "panda", "xarm7"], ("planted", "weeks")
    given = harness.options(__doc__, names=KINDS, jobs=1, robots=robots, weeks=200, seconds=600.0, what=what)
    tasks = harness.tasks(given, robot=given.robots, **{k: [getattr(given, k)] for k in ("seconds", "weeks")})
    tasks = [{**task, "kinds": given.names} for task in tasks]
    of, tell = {"planted": (planted, tell_planted), "weeks": (weeks, tell_weeks)}[given.what]
    tell([r for r in harness.each(of, tasks, given) if not r["failed"]])


if __name__ == "__main__":
    main()
