"""Has an arm changed, by ordinary recordings? Planted changes and none, in MuJoCo, beside a plain threshold.

Each case: reference recordings of several tasks on several days, then two recordings with a change, or some without.
Right: named within two recordings, and the joint. The threshold: the mean of |commanded − measured| of some joint is
four standard deviations of the reference recordings beyond their mean.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness
import numpy as np
from sentinel.worlds import NONE, ArmWorld, Change

from modcal_core.robots import read_inertias
from modcal_core.sentinel import Cells, MonitoredArm, Normal, cells_of, judge_bags

KINDS = {
    "none": ("", 0.0), "zero 1°": ("zero", np.radians(1.0)), "zero 0.3°": ("zero", np.radians(0.3)),
    "play": ("play", 0.01), "friction": ("friction", 0.3), "payload": ("payload", 0.5),
    "latency": ("latency", 0.02), "camera": ("camera", 0.005), "ratio": ("ratio", 0.01),
}  # fmt: skip
EXPECTED = {"zero": "joint_zero", "play": "play", "friction": "friction", "payload": "carried_mass",
            "latency": "latency", "camera": "camera", "ratio": "gear"}  # fmt: skip
REFERENCE, TASKS, SECONDS, QUIET = 8, 2, 60.0, 8
SIGMAS = 4.0


def one(task: dict[str, Any]) -> dict[str, Any]:
    """A case."""
    world = ArmWorld(task["robot"], task["seed"], task["tag"])
    kind, size = KINDS[task["name"]]
    rng = np.random.default_rng(task["seed"])
    joint = 1 + int(rng.integers(0, world.chain.n - 2))  # neither the first, which weight does not load, nor the last
    arm = MonitoredArm(world.chain.names, world.chain, read_inertias(world.urdf, world.chain))

    def cells(day: int, change: Change = NONE) -> Cells:
        made = world.record(day, SECONDS, day % TASKS, change)
        return cells_of(made, arm.names, f"day {day}")

    reference = [cells(day) for day in range(REFERENCE)]
    normal = Normal.fit(reference, arm)
    level = np.array([_following(c) for c in reference])
    limit = level.mean(axis=0) + SIGMAS * level.std(axis=0, ddof=1)
    later: list[Cells] = []
    alarms = trivial = 0
    out: dict[str, Any] = {"joint": arm.names[joint], "noticed": {}}
    for k in range(2 if kind else QUIET):
        later.append(cells(REFERENCE + k, Change(kind, joint, size) if kind else Change()))
        trivial += bool((_following(later[-1]) > limit).any())
        found = judge_bags(normal, later)
        out |= {"status": found.status, "log_e": round(found.log_e, 1), "weight": round(found.weight, 3)}
        out["said"] = found.sentence
        alarms += found.status == "changed"
        if kind and found.changes:
            first = found.changes[0]
            same = first.same_as
            place = arm.names[joint] if kind in ("zero", "play", "friction", "ratio") else ""
            right = first.kind == EXPECTED[kind] and place in ("", first.place)
            label = _label(kind, arm.names[joint])
            out |= {"outcome": "right" if right else "one of" if label in same else "wrong", "bags": k + 1}
            out["right_joint"] = not place or first.place == place or any(place in other for other in same)
            break
    if kind and "outcome" not in out:
        out["outcome"] = "not found"
    if not kind:
        out |= {"outcome": f"{alarms} alarms", "alarms": alarms, "hours": QUIET * SECONDS / 3600.0}
    out["trivial"] = trivial
    out["noticed"] = {label: round(size, 3) for label, (size, _) in found.noticed.items()}
    return out


def _label(kind: str, joint: str) -> str:
    return {"zero": f"zero of {joint}", "play": f"play of {joint}", "friction": f"friction of {joint}",
            "ratio": f"gear of {joint}", "latency": "latency of all joints"}.get(kind, kind)  # fmt: skip


def _following(cells: Cells) -> np.ndarray:
    return np.nanmean(np.abs(cells[f"apart:{cells.topics[0]}"]), axis=0)


def main() -> None:
    """Run, and print the table."""
    given = harness.options(__doc__, seeds=1, names=KINDS)
    results = harness.each(
        one, [t for t in harness.tasks(given, name=given.names, robot=["ur10"], tag=[True, False])], given
    )
    for r in results:
        print(r)
    print(Counter((r.get("name"), r.get("outcome")) for r in results))


if __name__ == "__main__":
    main()
