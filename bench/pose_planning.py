"""Planned stations against random ones, on arms of MuJoCo.

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

import numpy as np
from planning.arms import irb1410
from planning.sites import hall
from planning.studies import Arm

from modcal_core.planning.planner import Planner, PlanRequest, min_stations
from modcal_core.planning.pool import survey
from modcal_core.robots.urdf import read_chain

WHERE = 200  # postures at which the error is taken
ARMS, READINGS, SIZES = ("ur10", "irb1410", "panda"), ("point", "pose"), (1.0, 1.5, 3.0)  # times the least stations


def one(task: harness.Task) -> harness.Result:
    """Both errors [mm], their ratio with its interval, and what was foretold and claimed."""
    name, reading = task["robot"], task["reading"]
    chain = irb1410() if name == "irb1410" else read_chain((harness.ROBOTS / f"{name}.urdf").read_text())
    pool = survey(chain, hall(), np.random.default_rng(8), reading)
    planner = Planner(pool, PlanRequest(reading=reading), np.random.default_rng(1))
    count = int(task["size"] * min_stations(len(planner.outlook.parameters), reading))
    best, where = planner.best(count), pool.roadmap[:WHERE]
    planned, drawn = np.empty(task["arms"]), np.empty(task["arms"])
    for seed in range(task["arms"]):
        random = np.random.default_rng(seed).choice(len(pool.q), count, replace=False)
        arm = Arm.made(chain, hall(), seed)
        planned[seed] = arm.error_after(best, reading, where)
        drawn[seed] = arm.error_after(pool.q[random], reading, where)
    again = np.random.default_rng(0).integers(task["arms"], size=(1000, task["arms"]))
    low, high = np.percentile([harness.rms(planned[i]) / harness.rms(drawn[i]) for i in again], [2.5, 97.5])
    left = planner.left(planner.outlook.rows(best))
    sizes = [1e3 * v for v in (harness.rms(planned), left, harness.rms(drawn), planner.random(count))]
    out = dict(zip(("planned mm", "foretold", "random mm", "and foretold"), sizes, strict=True))
    out |= {"stations": count, "ratio": f"{sizes[0] / sizes[2]:.2f} ({low:.2f} to {high:.2f})"}
    claims = [planner.claim(q).mm["p95"].ci95[1] for q in (best, pool.q[random])]
    return {
        **out,
        "claimed mm": claims[0],
        "at random": claims[1],
        "random for the same": same_at_random(planner, left),
    }


def same_at_random(planner: Planner, left: float) -> str:
    """How many random stations are foretold to leave as little."""
    for count in range(10, len(planner.pool.q), 2):
        if planner.random(count) <= left:
            return str(count)
    return f"more than {len(planner.pool.q)}"


def main() -> int:
    given = harness.options(__doc__, seeds=24, names=[f"{arm}_{reading}" for arm in ARMS for reading in READINGS])
    tasks = []
    for name in given.names:
        told = {**dict(zip(("robot", "reading"), name.split("_"), strict=True)), "arms": given.seeds}
        tasks += [{**told, "size": size} for size in SIZES]
    results = harness.each(one, tasks, given)
    keys = ("robot", "reading", "stations", "planned mm", "foretold", "random mm", "and foretold", "ratio")
    harness.rows("", results, (*keys, "claimed mm", "at random", "random for the same"))
    return harness.ended(results)


if __name__ == "__main__":
    sys.exit(main())
