"""Planned stations against random ones, on arms of MuJoCo, and what low-rank updates save.

    make bench NAME=pose_planning ARGS="--seeds 40"      # arms a row; --only point narrows

Every arm has all its bodies displaced (0.5 mm, 1 mrad a direction); its readings have the noise of the site, its joints
do not repeat. Both sides choose from the same postures: within limits, seen by the tracker, touching
nothing. The error is that of the calibrated arm at postures of the workspace, against MuJoCo, RMS over the arms;
in brackets 95 % of what drawing the arms again gives. *Foretold* is what the plan said of itself.
"""

from __future__ import annotations

import harness

# isort: split
import sys
import time
from collections.abc import Callable

import numpy as np
from planning.arms import irb1410
from planning.sites import hall
from planning.studies import Arm

from modcal_core.planning.criteria import CRITERIA, criterion
from modcal_core.planning.fedorov import best_candidate
from modcal_core.planning.planner import chosen_stations, min_stations
from modcal_core.planning.posture_pool import PosturePool, random_accuracies, survey
from modcal_core.robots.urdf import read_chain

WHERE = 200  # postures at which the error is taken
ARMS, READINGS, SIZES = ("ur10", "irb1410", "panda"), ("point", "pose"), (1.0, 1.5, 3.0)  # times the least stations
OTHERS = tuple(which for which in CRITERIA if which not in ("accuracy", "o1"))  # o1 is d


def one(task: harness.Task) -> harness.Result:
    """Both errors [mm], their ratio with its interval, what was foretold; or what low-rank updates save."""
    name, reading = task["robot"], task["reading"]
    chain = irb1410() if name == "irb1410" else read_chain((harness.ROBOTS / f"{name}.urdf").read_text())
    there = survey(chain, hall(), np.random.default_rng(8), reading)
    if task["criterion"] == "updates":
        return {"times_as_fast": updates(there), "candidates": len(there.rows)}
    count, where = int(task["size"] * min_stations(len(there.parameters), reading)), there.free_q[:WHERE]
    gain = criterion(task["criterion"], there.workspace.gamma)
    best = chosen_stations(there, count, gain, 2, np.random.default_rng(1))
    planned, drawn = np.empty(task["arms"]), np.empty(task["arms"])
    for seed in range(task["arms"]):
        random = np.random.default_rng(seed).choice(len(there.q), count, replace=False)
        arm = Arm.made(chain, there.site, seed)
        planned[seed] = arm.error_after(best.q, reading, where)
        drawn[seed] = arm.error_after(there.q[random], reading, where)
    again = np.random.default_rng(0).integers(task["arms"], size=(1000, task["arms"]))
    low, high = np.percentile([harness.rms(planned[i]) / harness.rms(drawn[i]) for i in again], [2.5, 97.5])
    foretold = np.median([a.model for a in random_accuracies(there, count, np.random.default_rng(2))])
    sizes = [1e3 * v for v in (harness.rms(planned), best.accuracy.model, harness.rms(drawn), foretold)]
    out = dict(zip(("planned mm", "foretold", "random mm", "and foretold"), sizes, strict=True))
    out |= {"stations": count, "ratio": f"{sizes[0] / sizes[2]:.2f} ({low:.2f} to {high:.2f})"}
    return {**out, "random for the same": same_at_random(there, best.accuracy.model)}


def same_at_random(there: PosturePool, model: float) -> str:
    """How many random stations are foretold to leave as little."""
    rng = np.random.default_rng(3)
    for count in range(10, len(there.q), 2):
        sets = [rng.choice(len(there.q), count, replace=False) for _ in range(9)]
        if np.median([there.workspace.left(there.rows.covariance(chosen)) for chosen in sets]) <= model:
            return str(count)
    return f"more than {len(there.q)}"


def updates(there: PosturePool) -> float:
    """Time of determinants of whole matrices over that of one exchange's look at all candidates."""
    good, J = criterion("d", there.workspace.gamma), there.rows.J
    H = np.eye(J.shape[2]) + there.rows.information(np.arange(30))
    free = np.ones(len(there.rows), dtype=bool)

    def whole() -> np.ndarray:
        return np.asarray(good.value(H + J.transpose(0, 2, 1) @ J))

    def timed(work: Callable[[], object]) -> float:
        taken = []
        for _ in range(8):
            start = time.perf_counter()
            work()
            taken.append(time.perf_counter() - start)
        return float(np.median(taken[1:]))

    j, value = best_candidate(there.rows, H, good, free)
    assert j == int(np.argmax(whole()))
    assert abs(value - whole()[j]) < 1e-9 * abs(value)
    return timed(whole) / timed(lambda: best_candidate(there.rows, H, good, free))


def main() -> int:
    given = harness.options(__doc__, seeds=24, names=[f"{arm}_{reading}" for arm in ARMS for reading in READINGS])
    tasks = []
    for name in given.names:
        kinds = [("accuracy", size) for size in SIZES]
        if name == "ur10_point":
            kinds += [*((which, 1.5) for which in OTHERS), ("updates", 1.0)]
        told = {**dict(zip(("robot", "reading"), name.split("_"), strict=True)), "arms": given.seeds}
        tasks += [{**told, "criterion": which, "size": size} for which, size in kinds]
    results = harness.each(one, tasks, given)
    keys = ("robot", "reading", "stations", "criterion", "planned mm", "foretold", "random mm", "and foretold", "ratio")
    harness.rows("", [r for r in results if "ratio" in r], (*keys, "random for the same"))
    harness.rows("whole determinants", [r for r in results if "candidates" in r], ("candidates", "times_as_fast"))
    return harness.ended(results)


if __name__ == "__main__":
    sys.exit(main())
