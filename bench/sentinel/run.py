"""Has an arm changed, by ordinary recordings? Planted changes and none, in MuJoCo, beside a plain threshold.

An arm has reference recordings of two tasks on several days, then, for each kind, up to two recordings with a change;
or some of the same tasks without one, and one of another task. Each is judged with the tag and without it. Right: named
within two recordings, and the joint; *one of*: it is among what may as well be. The threshold: the mean of |commanded −
measured| of some joint is four standard deviations of the reference recordings beyond their mean.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness
import numpy as np
from sentinel.worlds import NONE, ArmWorld, Change

from modcal_core.robots import read_inertias
from modcal_core.sentinel import ArmVerdict, Cells, MonitoredArm, Normal, cells_of, judge_bags

Named = dict[str, Any]
KINDS = {  # kind in the world, size, kind as it is named
    "zero 1°": ("zero", np.radians(1.0), "joint_zero"), "zero 0.3°": ("zero", np.radians(0.3), "joint_zero"),
    "play 10 mrad": ("play", 0.01, "play"), "friction +30 %": ("friction", 0.3, "friction"),
    "payload 0.5 kg": ("payload", 0.5, "carried_mass"), "latency 20 ms": ("latency", 0.02, "latency"),
    "camera 5 mm": ("camera", 0.005, "camera"), "ratio 1 %": ("ratio", 0.01, "gear"),
}  # fmt: skip
OF_A_JOINT = ("zero", "play", "friction", "ratio")
REFERENCE, TASKS, QUIET, OTHER_TASK, SIGMAS = 8, 2, 8, 7, 4.0


def one(task: dict[str, Any]) -> dict[str, Any]:
    """An arm."""
    world = ArmWorld(task["robot"], task["seed"], tag=True)
    names, n = world.chain.names, world.chain.n
    arm = MonitoredArm(names, world.chain, read_inertias(world.urdf, world.chain))
    rng = np.random.default_rng(task["seed"])

    def cells(day: int, change: Change = NONE, of: int | None = None) -> Cells:
        made = world.record(day, task["seconds"], day % TASKS if of is None else of, change)
        return cells_of(made, names, f"day {day}")

    reference = [cells(day) for day in range(REFERENCE)]
    normal = {True: Normal.fit(reference, arm), False: Normal.fit([without_tag(c) for c in reference], arm)}
    level = np.array([following(c) for c in reference])
    limit = level.mean(axis=0) + SIGMAS * level.std(axis=0, ddof=1)
    cases: list[Named] = []
    for name in task["kinds"]:
        kind, size, expected = KINDS[name]
        joint = int(rng.integers(0, n))
        later = [cells(REFERENCE + k, Change(kind, joint, size)) for k in range(2)]
        wanted = (expected, names[joint] if kind in OF_A_JOINT else "")
        for tag in (True, False):
            case = named([judged(normal[tag], later[:k], tag) for k in (1, 2)], wanted)
            cases.append(
                {"kind": name, "tag": tag, "joint": joint, **case, "plain": bool((following(later[0]) > limit).any())}
            )
    quiet = [cells(REFERENCE + k) for k in range(QUIET)]
    for tag in (True, False):
        alarms = [judged(normal[tag], quiet[: k + 1], tag).status == "changed" for k in range(QUIET)]
        plain = [bool((following(c) > limit).any()) for c in quiet]
        cases.append({"kind": "none", "tag": tag, "alarms": sum(alarms), "plain": sum(plain), "of": QUIET})
        other = judged(normal[tag], [cells(50, NONE, OTHER_TASK)], tag)
        cases.append({"kind": "another task", "tag": tag, "outcome": other.status})
    noticed = {tag: judged(normal[tag], quiet[:1], tag).noticed for tag in (True, False)}
    return {"cases": cases, "noticed": {str(t): {k: v[0] for k, v in of.items()} for t, of in noticed.items()}}


def without_tag(cells: Cells) -> Cells:
    return replace(cells, columns={k: x for k, x in cells.columns.items() if not k.startswith("tag")})


def judged(normal: Normal, later: list[Cells], tag: bool) -> ArmVerdict:
    return judge_bags(normal, later if tag else [without_tag(c) for c in later])


def named(found: list[ArmVerdict], wanted: tuple[str, str]) -> Named:
    """What came of two recordings."""
    for k, verdict in enumerate(found):
        for change in verdict.changes[:1]:
            same = change.kind == wanted[0] and wanted[1] in ("", change.place)
            label = {"joint_zero": "zero of ", "gear": "gear of "}.get(wanted[0], f"{wanted[0]} of ") + wanted[1]
            outcome = "right" if same else "one of" if label in change.same_as else "wrong"
            return {"outcome": outcome, "recordings": k + 1, "said": verdict.sentence, "more": len(verdict.changes) - 1,
                    "right_joint": not wanted[1] or change.place == wanted[1]}  # fmt: skip
    return {"outcome": "not found", "log_e": round(found[-1].log_e, 1)}


def following(cells: Cells) -> np.ndarray:
    return np.nanmean(np.abs(cells[f"apart:{cells.topics[0]}"]), axis=0)


def main() -> None:
    """Run, and print the tables."""
    given = harness.options(__doc__, seeds=1, names=KINDS, jobs=1, robots=["ur10", "panda", "xarm7"], seconds=60.0)
    tasks = harness.tasks(given, robot=given.robots, seconds=[given.seconds], kinds=[given.names])
    cases = [case for r in harness.each(one, tasks, given) if not r["failed"] for case in r["cases"]]
    for tag in (True, False):
        mine = [case for case in cases if case["tag"] is tag]
        harness.say(f"{'with' if tag else 'without'} a tag")
        for name in (*given.names, "another task"):
            of = [case for case in mine if case["kind"] == name]
            plain = sum(case.get("plain", False) for case in of)
            harness.say(f"  {name:16} {dict(Counter(c['outcome'] for c in of))}, threshold {plain} of {len(of)}")
        quiet = [case for case in mine if case["kind"] == "none"]
        alarms, plain, of = (sum(case[key] for case in quiet) for key in ("alarms", "plain", "of"))
        hours = of * given.seconds / 3600.0
        harness.say(f"  none: {alarms} alarms in {of} recordings, {hours:.2f} h; threshold {plain}")


if __name__ == "__main__":
    main()
