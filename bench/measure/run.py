"""What measuring on order is worth, in cells of MuJoCo and by replay of real grids.

    make bench NAME=measure ARGS="--only goal impossible --cells 6"

goal: stations until 0.1 mm are proven, chosen and at random under the same rule, proof included; whether what was
promised is true. impossible: goals below what the arm repeats; whether they are refused, and how good the arm then is
beside 400 planned stations. ties: pairs of explanations that one recording leaves open, and up to twelve stations more.
ur5, ipa: how many stations of a recorded grid give the error of the whole, at three tenths that are never offered;
--seeds divisions, with --chosen no random stations beside. --first-cell: its seed; another one makes fresh cells.
--noise: times the tracker's.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
from dataclasses import replace
from typing import Any

import numpy as np
import recorded
from harness import over, share
from recordings import plant
from scenarios import SCENARIOS
from sites import BEGIN, REPEAT, Cell, Stations
from workplace import TRACKER, Workplace, distance

from modcal_core.calibration.cell import Cell as Known
from modcal_core.calibration.noise import errors
from modcal_core.calibration.store import Calibration
from modcal_core.measurements.samples import Samples
from modcal_core.planning import Advice, Advisor, Goal, Method
from modcal_core.planning.next_stations import best_stations, deciding_stations, first_stations, random_stations
from modcal_core.planning.outlook import Refit, outlook, refit
from modcal_core.planning.pool import of_recording, survey
from modcal_core.planning.rivals import deciding
from modcal_core.planning.session import FRAME, POINT, POSE, Session, Station
from modcal_core.planning.site import Noise, Site
from modcal_core.robot import Robot
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_nodes.measuring import Replay

Array = np.ndarray
ARMS, KINDS = ("ur10", "panda", "xarm7"), ("point", "pose")
# effects of the arm that a frozen model can hold; what jumps or drifts while it is measured has no error to promise
FAULTS = (
    "none compliance compliance_all gear_harmonic encoder_eccentricity bearing_tilt wrist_coupling gear_ratio "
    "axis_wobble hose_drag approach_backlash hardening_spring gear_harmonic+compliance"
)
TIED = "compliance bearing_tilt gear_ratio axis_wobble encoder_eccentricity wrist_coupling hardening_spring"
EACH, TRUTH = 8.0, 400  # s from one station to the next; random postures at which the error is taken
GOAL, PLANNED, FIRST = 1e-4, 400, 40  # m; stations that a refusal is compared with, of which so many to begin with
RECORDED, NARROW, MORE, AT_ONCE = 45, 0.45, 12, 4  # of ties: stations, share of the joints' ranges, further stations
HELD, LARGE, WITHIN = 0.3, 3000, 1.1  # of a grid: share that scores; a large one; times the whole's error
GRIDS = {"ur5": (5, 0.35), "ipa": (200, 0.15)}  # stations held out together, and the share that is claimed
WAYS = ("planned", "random")


class AtRandom(Advisor):
    """Draws every station at random, to compare with."""

    def advise(self, session: Session, elapsed: float = 0.0) -> Advice:
        if session.stations:
            return super().advise(session, elapsed)
        return self._asked(self._fitted(session), random_stations(self.pool, session, self.least(session.kind)), "")

    def _best(self, at: Any, count: int, first: int, rng: np.random.Generator) -> tuple[list[Station], Array]:
        stations = random_stations(self.pool, at.session, count)
        q = np.array([s.asked for s in stations]).reshape(-1, self.chain.n)
        return stations, at.view.rows(q, rng.choice([-1.0, 1.0], q.shape))


ADVISORS = {"planned": Advisor, "random": AtRandom}


class Measured(Workplace):
    """A workplace where one station is measured after the other."""

    def __init__(self, task: harness.Task, noise: float = 1.0, repeats: float = REPEAT) -> None:
        self.seed, self.kind = task["seed"], task["kind"]
        rng = np.random.default_rng([self.seed, 26])
        cell = Cell(task["robot"], rng)
        self.planted = plant(cell, SCENARIOS[task["fault"]], rng, 600.0)
        super().__init__(cell, tuple(f.bend for f in self.planted), (noise * TRACKER[0], noise * TRACKER[1]), repeats)
        self.chain = read_chain(cell.arm.urdf, None, cell.arm.tip)
        self.inertias = read_inertias(cell.arm.urdf, self.chain)
        ranges = zip(cell.arm.names, *cell.arm.range, strict=True)
        site = Site(limits={n: (float(a), float(b)) for n, a, b in ranges}, noise=Noise(position=2e-5))
        self.pool = survey(self.chain, site, np.random.default_rng(self.seed), self.kind, drawn=True)
        self.begin(0)

    def begin(self, seed: int) -> None:
        """Another measurement in the same cell, with noise of its own."""
        self.rng = np.random.default_rng([self.seed, 27, seed])
        self.now, self.last = 0.0, np.zeros(self.chain.n)

    def visit(self, station: Station) -> Station:
        """Go to a station, from the side that is asked for, and read."""
        self.now += EACH
        way = np.sign(station.asked - self.last)
        if station.approach is not None:
            way = np.where(station.approach != 0.0, station.approach, way)
        self.last = station.asked
        pose = self.kind == "pose"
        seen = self.read(Stations(station.asked[None], np.array([self.now]), way[None]), self.rng, pose)
        reading = np.r_[seen.p[0], seen.R[0].as_quat()] if pose else seen.p[0]
        return station.measured(reading, stamp=BEGIN + self.now, approach=way)

    def done(self, session: Session) -> Session:
        for number in session.pending:
            session = session.with_station(number, self.visit(session.stations[number]))
        return session

    def asked(self, q: Array) -> Session:
        """A session in which these postures (N, n) have been measured."""
        return self.done(Session(self.chain.names, self.kind).asking([Station(row) for row in q]))

    def refit(self, session: Session) -> Refit:
        return refit(session.samples(session.fitted), self.chain, 0, None, self.inertias)

    def run(self, goal: Goal, way: str) -> Advice:
        self.begin(0)
        advisor = ADVISORS[way](self.chain, self.pool, goal, None, None, self.inertias)
        session = Session(self.chain.names, self.kind)
        while (advice := advisor.advise(session, self.now)).outcome is None:
            session = self.done(advice.session)
        return advice

    def at_random(self, seed: int, now: float) -> tuple[np.random.Generator, Stations]:
        """Random allowed postures, each reached from a side of its own."""
        rng = np.random.default_rng([self.seed, seed])
        q = self.pool.q[self.pool.order[-TRUTH:]]
        return rng, Stations(q, np.full(len(q), now), rng.choice([-1.0, 1.0], q.shape))

    def floor(self) -> float:
        """RMS over space [mm] of what the arm does not repeat at random allowed postures, as its truth has it."""
        rng, stations = self.at_random(29, 0.0)
        p = [self.cell.poses(told, self.faults).p for told in (stations, self.reached(stations, rng))]
        return distance(*p)

    def error(self, calibration: Calibration) -> float:
        """RMS [mm] of the distance between where the model has the tool and where it is, at random allowed postures.

        What the arm does not repeat is part of it; the instrument's noise never is.
        """
        rng, stations = self.at_random(28, self.now)
        exact = self.cell.poses(self.reached(stations, rng), self.faults).p
        samples = Samples.from_arrays(stations.q, points=exact, names=self.chain.names)
        told = {"frames": (FRAME,), "approach": stations.came, "stamps": BEGIN + stations.t}
        return missed(calibration, replace(samples, **told))


def missed(calibration: Calibration, samples: Samples) -> float:
    return 1e3 * harness.rms(errors(calibration.calibrated, samples).position_norm)


def cells(count: int, first: int) -> list[harness.Task]:
    """Arm, fault, kind of reading and seed of so many cells; first: seed of the first."""
    order = [(arm, fault) for fault in FAULTS.split() for arm in ARMS]
    picked = [order[i] for i in np.random.default_rng(first - 74).permutation(len(order))]
    keys = ("robot", "fault", "kind", "seed")
    return [dict(zip(keys, (*picked[k % len(order)], KINDS[k % 2], first + k), strict=True)) for k in range(count)]


def goal(task: harness.Task) -> harness.Result:
    place, out = Measured(task, task["noise"]), {}
    for name in WAYS:
        advice = place.run(Goal(GOAL), name)
        s, true = advice.status, place.error(advice.refitted.calibration)
        told = {"ending": advice.outcome.ending, "stations": s.measured, "fit": s.fitted, "proof": s.proving}
        out |= {f"{name} {key}": value for key, value in (told | {"true_mm": true}).items()}
    return out


def impossible(task: harness.Task) -> harness.Result:
    """A goal of six tenths of what the arm repeats; error of the model then, and of as many planned stations."""
    place = Measured(task, repeats=4 * REPEAT)
    floor = place.floor()
    advice = place.run(Goal(0.6e-3 * floor), "planned")
    out: harness.Result = {"ending": advice.outcome.ending, "stations": advice.status.measured, "floor_mm": floor}
    out["true_mm"] = place.error(advice.refitted.calibration)
    place.begin(1)
    rng = np.random.default_rng(0)
    first = first_stations(place.pool, Session(place.chain.names, place.kind), FIRST, rng)
    session = place.asked(np.array([station.asked for station in first]))
    model = place.refit(session)
    view = outlook(model, place.pool.where, Known(), rng)
    more, _ = best_stations(place.pool, view, model, session, PLANNED - FIRST, 0, rng)
    best = place.error(place.refit(place.done(session.asking(more))).calibration)
    return {**out, "best_mm": best, "ratio": out["true_mm"] / best, "said": advice.outcome.sentence}


def tie(task: harness.Task) -> harness.Result:
    """A recording of a part of the joints' ranges: what it leaves open, and whether further stations separate it."""
    seed = task["seed"]
    place = Measured({**task, "seed": 500 + seed})
    rng, (low, high) = np.random.default_rng([place.seed, 30]), place.cell.arm.range
    middle = 0.5 * (low + high) + 0.25 * rng.uniform(-1.0, 1.0, len(low)) * (high - low)
    half = 0.5 * NARROW * (high - low)
    session = place.asked(np.clip(rng.uniform(middle - half, middle + half, (RECORDED, len(low))), low, high))
    model = place.refit(session)
    before, used = open_pairs(model), 0
    found, _ = deciding(model.calibration, place.pool, AT_ONCE, np.random.default_rng(seed))
    if found is None:
        return {"open": False}
    name, other, between = found.effect.label, found.rival.label, found.name
    while found is not None and used < MORE:
        stations = deciding_stations(found)[: MORE - used]
        session = place.done(session.asking(stations))
        used += len(stations)
        model = place.refit(session)
        found, _ = deciding(model.calibration, place.pool, AT_ONCE, np.random.default_rng(seed + used))
    decided = not {(name, other), (other, name)} & open_pairs(model)
    # a curve that was taken for an effect can be told from its rival, and the line that is left cannot
    same = not decided and between in deciding(model.calibration, place.pool, 1, np.random.default_rng(seed))[1]
    out: harness.Result = {"open": True, "between": between, "more": used, "decided": decided, "one_motion": same}
    out |= {"open_before": len(before), "open_after": len(open_pairs(model))}
    out |= {
        "effects": [e.label for e in model.calibration.calibrated.effects],
        "true": [f.place for f in place.planted],
    }
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
    robot = Robot.from_table(harness.ROBOTS / "ur5.yaml")
    q, p = recorded.grid("ur5")
    return robot, Samples.from_arrays(q, points=p).of_joints(robot.names)


def replay(task: harness.Task) -> harness.Result:
    """One division of a grid: the error of all stations that are offered, and how it falls with those asked for."""
    seed, (size, limit) = task["seed"], GRIDS[task["part"]]
    robot, samples = grid(task["part"])
    block = np.arange(len(samples)) // size
    held = np.isin(block, np.random.default_rng(seed).permutation(block[-1] + 1)[: round(HELD * (block[-1] + 1))])
    offered, scored = samples.select(~held), samples.select(held)
    whole = missed(refit(offered, robot.mechanism, seed, None, robot.inertias).calibration, scored)
    out: dict[str, Any] = {"offered": len(offered), "scored": len(scored), "whole_mm": whole, "steps": []}
    for name in WAYS[: 1 if task["chosen"] else 2]:
        measurer, pool = Replay(offered), of_recording(offered.q, np.random.default_rng(seed))
        aim = Goal(None, stations=max(int(limit * len(offered)), 20))
        session, advice = Session(robot.names, POSE if measurer.kind == POSE else POINT), None
        steps: list[list[Any]] = []
        while advice is None or advice.outcome is None:
            for number in session.pending:
                session = session.with_station(number, measurer.measure(session.stations[number]))
            # half as many again each time, of a large recording twice as many, for time: what is asked is how few do
            batch = max(12, len(session.rows()) // (1 if len(offered) > LARGE else 2))
            method = Method(seed, batch)
            plan = ADVISORS[name](robot.mechanism, pool, aim, method, None, robot.inertias)
            advice = plan.advise(session)
            session = advice.session
            if advice.refitted is not None:
                mm, count = missed(advice.refitted.calibration, scored), len(session.rows())
                share = f"{count / len(offered):.1%}"
                steps.append([f"{seed} {name}", count, share, mm, mm / whole, len(advice.status.effects)])
        beyond = [k for k, step in enumerate(steps) if step[4] > WITHIN]
        last = max(beyond, default=-1) + 1  # from here on within
        out[f"{name} reached"] = steps[last][1] if last < len(steps) else None
        out["steps"] += steps
    return out


PART = {"goal": goal, "impossible": impossible, "ties": tie, "ur5": replay, "ipa": replay}


def show(part: str, results: list[harness.Result]) -> None:
    told = ("robot", "fault", "kind")
    if part == "goal":
        keys = ("ending", "stations", "fit", "proof", "true_mm")
        harness.rows("Chosen, and at random", results, (*told, *(f"{way} {key}" for way in WAYS for key in keys)))
        both = [r for r in results if all(r[f"{way} ending"] == "proven" for way in WAYS)]
        kept = [r[f"{n} true_mm"] <= 1e3 * GOAL for r in results for n in WAYS if r[f"{n} ending"] == "proven"]
        ratio = [r["planned stations"] / r["random stations"] for r in both] or [np.nan]
        medians = [over(f"{way} stations", harness.median)(both) for way in WAYS]
        harness.say(
            f"both proven in {len(both)} of {len(results)}; stations planned / random: median {np.median(ratio):.2f} "
            f"({np.percentile(ratio, 25):.2f} to {np.percentile(ratio, 75):.2f}); medians {medians[0]} and "
            f"{medians[1]}; promise kept in {share(kept)}"
        )
    elif part == "impossible":
        keys = (*told, "ending", "stations", "floor_mm", "true_mm", "best_mm")
        harness.rows("Goals that cannot be reached", results, keys)
        ratios, refused = np.array([r["ratio"] for r in results]), [r["ending"] == "no_station_helps" for r in results]
        harness.say(
            f"refused {share(refused)}; error over that of {PLANNED} planned stations: median {np.median(ratios):.3f}, "
            f"{np.mean(ratios <= 1.1):.0%} within 1.1, largest {ratios.max():.2f}"
        )
    elif part == "ties":
        keys = (*told[:2], "between", "more", "decided", "one_motion", "open_before", "open_after")
        harness.rows("Pairs that one recording leaves open", results, keys)
        decided, same = (share(r[k] for r in results) for k in ("decided", "one_motion"))
        harness.say(f"separated by at most {MORE} more: {decided}; one motion, which is said: {same}")
    else:
        heads = ("division", "stations", "share", "mm", "÷ whole", "effects")
        harness.table(f"Replay of {part}", heads, [step for r in results for step in r["steps"]])
        keys = ("seed", "whole_mm", *(f"{way} reached" for way in WAYS))
        harness.rows(f"within {WITHIN} of the whole from", results, keys)


def main() -> int:
    given = harness.options(
        __doc__,
        seeds=1,
        names=("goal", "impossible", "ties", *GRIDS),
        cells=30,
        first_cell=100,
        noise=1.0,
        chosen=False,
    )
    made, tied = cells(given.cells, given.first_cell), TIED.split()
    tasks = {"goal": [{**cell, "noise": given.noise} for cell in made], "impossible": made}
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
            done = harness.each(PART, some, given)
            failed += harness.failures(done)
            results += [r for r in done if not r["failed"] and r.get("open", True)]
            if part == "ties" and len(results) >= given.cells:
                results, waiting = results[: given.cells], []
        if results:
            show(part, results)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
