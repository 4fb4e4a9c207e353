"""What measuring on order is worth, in cells of MuJoCo and by replay of real grids.

    make bench NAME=measure ARGS="--only goal impossible --cells 6"

goal: stations until 0.1 mm are proven, chosen and at random under the same rule, proof included; whether what was
promised is true. impossible: goals below what the arm repeats; whether they are refused, and how good the arm then is
beside 400 planned stations. ties: pairs of explanations that one recording leaves open, and up to twelve stations more.
ur5, ipa: how many stations of a recorded grid give the error of the whole, at three tenths that are never offered.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
from typing import Any

import numpy as np
import recorded
from cells import REPEATS, Bench

from modcal_core.calibration.noise import errors
from modcal_core.measurements.samples import Samples
from modcal_core.measuring.advice import Advisor
from modcal_core.measuring.choose import deciding_stations, fit_stations, of_recording, one_motion
from modcal_core.measuring.outlook import outlook
from modcal_core.measuring.proof import Goal
from modcal_core.measuring.refit import Refit, refit
from modcal_core.measuring.session import POINT, POSE, Session, Station
from modcal_core.robot import Robot
from modcal_nodes.measuring.folder import Replay

ARMS, KINDS = ("ur10", "panda", "xarm7"), ("point", "pose")
# effects of the arm that a frozen model can hold; what jumps or drifts while it is measured has no error to promise
FAULTS = (
    "none compliance compliance_all gear_harmonic encoder_eccentricity bearing_tilt wrist_coupling gear_ratio "
    "axis_wobble hose_drag approach_backlash hardening_spring gear_harmonic+compliance"
)
TIED = "compliance bearing_tilt gear_ratio axis_wobble encoder_eccentricity wrist_coupling hardening_spring"
GOAL, PLANNED, FIRST = 1e-4, 400, 40  # m; stations that a refusal is compared with, of which so many to begin with
RECORDED, NARROW, MORE, AT_ONCE = 45, 0.45, 12, 4  # of ties: stations, share of the joints' ranges, further stations
HELD, LARGE, WITHIN = 0.3, 3000, 1.1  # of a grid: share that scores; a large one; times the whole's error
GRIDS = {"ur5": (5, 0.35), "ipa": (200, 0.15)}  # stations held out together, and the share that is claimed
PARTS = ("goal", "impossible", "ties", *GRIDS)


def cells(count: int, first: int) -> list[harness.Task]:
    """Arm, fault, kind of reading and seed of so many cells; first: seed of the first."""
    order = [(arm, fault) for fault in FAULTS.split() for arm in ARMS]
    picked = [order[i] for i in np.random.default_rng(first - 74).permutation(len(order))]
    keys = ("robot", "fault", "kind", "seed")
    return [dict(zip(keys, (*picked[k % len(order)], KINDS[k % 2], first + k), strict=True)) for k in range(count)]


def one(task: harness.Task) -> harness.Result:
    """What came of one cell of a part."""
    return PART[task["part"]](task)


def goal(task: harness.Task) -> harness.Result:
    """Stations until the goal is proven, chosen and at random."""
    bench = Bench(task["robot"], task["fault"], task["seed"], task["kind"], task["noise"])
    out = {}
    for name, planned in (("planned", True), ("random", False)):
        advice = bench.run(Goal(GOAL), planned)
        s, true = advice.status, 1e3 * bench.error(advice.refitted.calibration)
        out[name] = {"ending": advice.outcome.ending, "stations": s.measured, "fit": s.fitted}
        out[name] |= {"proof": s.proving, "true_mm": true}
    return out


def impossible(task: harness.Task) -> harness.Result:
    """A goal of six tenths of what the arm repeats."""
    bench = Bench(task["robot"], task["fault"], task["seed"], task["kind"], repeats=4 * REPEATS)
    floor = bench.floor()
    advice = bench.run(Goal(0.6 * floor), True)
    error = bench.error(advice.refitted.calibration)
    out: harness.Result = {"ending": advice.outcome.ending, "stations": advice.status.measured, "floor_mm": 1e3 * floor}
    out |= {"true_mm": 1e3 * error, "best_mm": 1e3 * best_error(bench, PLANNED), "said": advice.outcome.sentence}
    return out


def best_error(bench: Bench, count: int) -> float:
    """RMS error [m] of the model from so many stations, chosen for the error of the tool: the best to compare with."""
    bench.begin(1)
    pool, session = bench.pool, Session(bench.chain.names, bench.kind)
    session = bench.done(session.asking([Station(pool.q[int(j)]) for j in pool.first(FIRST)]))
    model = bench.refit(session)
    view = outlook(model, pool.where, model.spread, np.random.default_rng(0))
    more = fit_stations(pool, session, view, model, count - FIRST, True, np.random.default_rng(0), 0)
    return bench.error(bench.refit(bench.done(session.asking(more.stations))).calibration)


def tie(task: harness.Task) -> harness.Result:
    """A recording of a part of the joints' ranges: what it leaves open, and whether further stations separate it."""
    seed = task["seed"]
    bench = Bench(task["robot"], task["fault"], 500 + seed, task["kind"])
    bench.begin(0)
    rng, (low, high) = np.random.default_rng([bench.seed, 30]), bench.cell.arm.range
    middle = 0.5 * (low + high) + 0.25 * rng.uniform(-1.0, 1.0, len(low)) * (high - low)
    half = 0.5 * NARROW * (high - low)
    q = np.clip(rng.uniform(middle - half, middle + half, (RECORDED, len(low))), low, high)
    session = bench.done(Session(bench.chain.names, bench.kind).asking([Station(row) for row in q]))
    model = bench.refit(session)
    before, used = open_pairs(model), 0
    stations, between = deciding_stations(model, bench.pool, AT_ONCE, np.random.default_rng(seed))
    if not stations:
        return {"open": False}
    while stations and used < MORE:
        stations = stations[: MORE - used]
        session = bench.done(session.asking(stations))
        used += len(stations)
        model = bench.refit(session)
        stations, _ = deciding_stations(model, bench.pool, AT_ONCE, np.random.default_rng(seed + used))
    name, _, other = between.partition(" or ")
    decided = not {(name, other), (other, name)} & open_pairs(model)
    # a curve that was taken for an effect can be told from its rival, and the line that is left cannot
    same = not decided and (name, other) in one_motion(model, bench.pool, np.random.default_rng(seed))
    out: harness.Result = {"open": True, "between": between, "more": used, "decided": decided, "one_motion": same}
    out |= {"open_before": len(before), "open_after": len(open_pairs(model))}
    out |= {"effects": [e.label for e in model.calibration.calibrated.effects], "true": [f.place for f in bench.faults]}
    return out


def open_pairs(model: Refit) -> set[tuple[str, str]]:
    """Pairs of explanations that the readings leave open, by name."""
    pairs = zip(model.calibration.calibrated.effects, model.calibration.rivals, strict=False)
    return {(effect.label, rival.label) for effect, rivals in pairs for rival in rivals}


def grid(name: str) -> tuple[Robot, Samples]:
    """The UR5's 1 000 points, or the 11 911 poses of the UR10's series A, one a station."""
    if name == "ipa":
        with harness.scratch() as folder:
            return recorded.series("a", folder)
    robot = Robot.from_table(harness.ROOT / "examples" / "robots" / "ur5.yaml")
    q, p = recorded.grid("ur5")
    return robot, Samples.from_arrays(q, points=p).of_joints(robot.names)


def replay(task: harness.Task) -> harness.Result:
    """One division of a grid: the error of all stations that are offered, and how it falls with those asked for."""
    seed, (size, limit) = task["seed"], GRIDS[task["part"]]
    robot, samples = grid(task["part"])
    block = np.arange(len(samples)) // size
    held = np.isin(block, np.random.default_rng(seed).permutation(block[-1] + 1)[: round(HELD * (block[-1] + 1))])
    offered, scored = samples.select(~held), samples.select(held)

    def error(found: Refit) -> float:
        return 1e3 * harness.rms(errors(found.calibration.calibrated, scored).position_norm)

    whole = error(refit(offered, robot.mechanism, seed, None, robot.inertias))
    out: dict[str, Any] = {"offered": len(offered), "scored": len(scored), "whole_mm": whole}
    for name in ("planned", "random"):
        measurer, pool = Replay(offered), of_recording(offered.q, np.random.default_rng(seed))
        aim = Goal(None, stations=max(int(limit * len(offered)), 20))
        session, rows, reached = Session(robot.names, POSE if measurer.kind == POSE else POINT), [], None
        while True:
            # half as many again each time, of a large recording twice as many, for time: what is asked is how few do
            batch = max(12, len(session.rows()) // (1 if len(offered) > LARGE else 2))
            plan = Advisor(robot.mechanism, pool, aim, seed, None, robot.inertias, name == "planned", batch)
            advice = plan.advise(session)
            session = advice.session
            if advice.refitted is not None:
                rows.append((len(session.rows()), error(advice.refitted), len(advice.status.effects)))
                reached = (reached or rows[-1][0]) if rows[-1][1] <= WITHIN * whole else None
            if advice.outcome is not None:
                break
            for number in session.pending:
                session = session.with_station(number, measurer.measure(session.stations[number]))
        out[name] = {"steps": rows, "reached": reached, "said": advice.outcome.sentence}
        if task["chosen"]:
            break
    return out


PART = {"goal": goal, "impossible": impossible, "ties": tie, "ur5": replay, "ipa": replay}


def show(part: str, results: list[harness.Result]) -> None:
    """What a part comes to."""
    if part == "goal":
        both = [r for r in results if r["planned"]["ending"] == r["random"]["ending"] == "proven"]
        proven = [r[n] for r in results for n in ("planned", "random") if r[n]["ending"] == "proven"]
        ratio = [r["planned"]["stations"] / r["random"]["stations"] for r in both]
        rows = [
            [r["robot"], r["fault"], r["kind"], *(r[n][k] for n in ("planned", "random") for k in r[n])]
            for r in results
        ]
        told = ("ending", "stations", "fit", "proof", "true mm")
        harness.table("Chosen, and at random", ("arm", "fault", "readings", *told, *told), rows)
        medians = [np.median([r[n]["stations"] for r in both]) for n in ("planned", "random")]
        harness.say(
            f"both proven in {len(both)} of {len(results)}; stations planned / random: median {np.median(ratio):.2f} "
            f"({np.percentile(ratio, 25):.2f} to {np.percentile(ratio, 75):.2f}); medians {medians[0]:.0f} and "
            f"{medians[1]:.0f}; promise kept in {harness.share(p['true_mm'] <= 1e3 * GOAL for p in proven)}"
        )
    elif part == "impossible":
        keys = ("robot", "fault", "kind", "ending", "stations", "floor_mm", "true_mm", "best_mm")
        harness.table("Goals that cannot be reached", keys, [[r[k] for k in keys] for r in results])
        ratios = np.array([r["true_mm"] / r["best_mm"] for r in results])
        refused = harness.share(r["ending"] == "no_station_helps" for r in results)
        harness.say(
            f"refused {refused}; error over that of {PLANNED} planned stations: median {np.median(ratios):.3f}, "
            f"{np.mean(ratios <= 1.1):.0%} within 1.1, largest {ratios.max():.2f}"
        )
    elif part == "ties":
        keys = ("robot", "fault", "between", "more", "decided", "one_motion", "open_before", "open_after")
        harness.table("Pairs that one recording leaves open", keys, [[r[k] for k in keys] for r in results])
        decided, same = (harness.share(r[k] for r in results) for k in ("decided", "one_motion"))
        harness.say(f"separated by at most {MORE} more: {decided}; one motion, which is said: {same}")
    else:
        rows = [
            [f"{r['seed']} {name}", n, f"{n / r['offered']:.1%}", mm, mm / r["whole_mm"], effects, r[name]["reached"]]
            for r in results
            for name in ("planned", "random")[: 1 + ("random" in r)]
            for n, mm, effects in r[name]["steps"]
        ]
        heads = ("division", "stations", "share", "mm", "÷ whole", "effects", f"within {WITHIN} from")
        harness.table(f"Replay of {part}", heads, rows)


def main() -> int:
    """Exit code: 0 where nothing failed."""
    parser = harness.parser(__doc__, seeds=1, names=PARTS)  # seeds: divisions of a grid
    parser.add_argument("--cells", type=int, default=30)
    parser.add_argument("--first-cell", type=int, default=100, help="its seed: another one makes fresh cells")
    parser.add_argument("--noise", type=float, default=1.0, help="times the tracker's noise of bench/undeclared")
    parser.add_argument("--chosen", action="store_true", help="of the grids no random stations beside")
    given = harness.parsed(parser)
    made = cells(given.cells, given.first_cell)
    tasks = {"goal": [{**cell, "noise": given.noise} for cell in made], "impossible": made}
    tied = TIED.split()
    tasks["ties"] = [
        {"robot": ARMS[k % 3], "fault": tied[k // 3 % len(tied)], "kind": KINDS[k % 2], "seed": k + 1}
        for k in range(40 * given.cells)
    ]
    tasks |= {name: [{**task, "chosen": given.chosen} for task in harness.tasks(given)] for name in GRIDS}
    failed = 0
    for part in given.names:
        waiting, results = [{"part": part, **task} for task in tasks[part]], []
        while waiting:  # of the ties until so many pairs were left open
            some, waiting = (waiting[: given.cells], waiting[given.cells :]) if part == "ties" else (waiting, [])
            done = harness.each(one, some, given)
            failed += harness.failures(done)
            results += [r for r in done if not r["failed"] and r.get("open", True)]
            if part == "ties" and len(results) >= given.cells:
                results, waiting = results[: given.cells], []
        if results:
            show(part, results)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
