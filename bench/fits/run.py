"""Fits beside what can be reached: recordings whose floor is known, calibrated, and what is left of them in floors.

    make bench NAME=fits ARGS="--only wall payloads_unknown --seeds 4"

Four groups of kinds: geometry that is hard to find (``hard_cells.py``), loads as they are (``loads.py``), drivers as
people record them (``drivers.py``), and Deltas with unequal rods. Beside the floor stands what the truth itself leaves
of the same stations, and where a fit ends that is begun there: where both end alike, no better optimum was missed, and
what is left above the floor is what fitting so many values to so few readings adds.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
import zlib
from dataclasses import replace
from functools import reduce
from itertools import pairwise
from typing import Any

import drivers
import loads
import numpy as np
from arms import urdf_of
from deltas import record_delta
from hard_cells import DISTANCE, KINDS
from sites import rms
from works import Planted

import modcal_core as modcal
from modcal_core.calibration.cell import Cell, with_bases
from modcal_core.calibration.distances import Distance
from modcal_core.calibration.fit import Fit, identify
from modcal_core.calibration.noise import errors, squared_residuals
from modcal_core.geometry import se3
from modcal_core.loop import Solution, calibrate
from modcal_core.measurements.samples import Samples, between
from modcal_core.preprocess import prepare
from modcal_core.robot import Robot
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias

TRUE_MM = 1e-3  # RMS that a fit to exact readings may leave to count as the truth
MAX, NAMED = 1.1, 0.95  # times the floor, and share of the seeds, that a Delta has to reach
STAGES = ("nominal", "geometric", "final")
ROWS = {**loads.ROWS, **drivers.ROWS}
RODS = {"rods_apart": (True, False), "rods_alike": (False, False)}  # unequal, and with a gear
RODS |= {"rods_apart_gear": (True, True), "rods_alike_gear": (False, True)}
# Of the Deltas: noise over space [mm], stations, how far rods are apart [m], and the gear: cycles a turn, amplitude
# [rad], and standard deviations by which its cycles may be off
FLOOR_MM, STATIONS, HELD_OUT, APART_M, CYCLES, AMPLITUDE, WITHIN = 0.01, 160, 200, 6e-4, 40.0, 3e-4, 3.0
FIRST = {**dict.fromkeys(KINDS, 100), **dict.fromkeys(RODS, 1)}  # seeds that the published figures begin with


def one(task: harness.Task) -> harness.Result:
    """What came of one recording: everything in units of its floor."""
    group = geometry if task["kind"] in KINDS else row if task["kind"] in ROWS else delta
    return group(task["kind"], task["seed"], not task["geometry_only"])


def geometry(kind: str, seed: int, effects: bool) -> harness.Result:
    """A cell whose geometry is hard to find."""
    made = KINDS[kind](np.random.default_rng([zlib.crc32(kind.encode()), seed]))
    chain = read_chain(made.urdf, tip=made.tip)
    samples, exact = (prepare(recording, chain).samples for recording in (made.recording, made.exact))
    known = Cell(tuple(Distance(pair, DISTANCE) for pair in made.distances))
    done = calibrate(samples, chain, np.random.default_rng(seed), known, look_for_effects=effects)
    report, fit = done.report, done.scored
    left = {stage: 1e3 * float(np.sqrt(np.nanmean(report.errors[stage].position_norm ** 2))) for stage in STAGES}
    assert np.array_equal(exact.stamps, report.samples.stamps), "not the same stations with and without noise"
    beside = beside_truth(done, replace(exact, sockets=report.samples.sockets), known, made.tool)
    moved = fit.model.T_tip_tool[:3, 3] - done.calibration.nominal.T_tip_tool[:3, 3]
    count, final = (len(fit.parameters), len(report.sets.train)), left["final"]
    out = {"floor_mm": made.floor_mm, "left_mm": left, **beside, "over_floor": final / made.floor_mm}
    out |= {"over_truth": final / beside["truth_mm"], "over_begun": final / beside["begun_mm"]}
    out |= {"expected": float(np.sqrt(1.0 + count[0] / (3.0 * count[1]))), "values": count[0], "train": count[1]}
    out |= {"status": report.judged.status, "rejected": report.rejected_stations()}
    out["tool_moved_mm"] = 1e3 * np.linalg.norm(moved)
    out |= {"effects": [f"{e.family} {e.place}" for e in fit.model.effects]}
    return out | {"distance_mm": max((1e3 * abs(d.residual) for d in report.distances), default=0.0)}


def row(kind: str, seed: int, effects: bool) -> harness.Result:
    """Loads or drivers: whether the cause is named, and nothing that is not there."""
    works, planted = ROWS[kind].planted(kind, seed)
    first = planted.recordings[0]
    urdf = first.robot_description or ""
    chain = read_chain(urdf, None, urdf_of(works.robot)[1], frozenset(first.joints[0].names))
    parts = [prepare(recording, chain).samples for recording in planted.recordings]
    samples = reduce(lambda a, b: a.followed_by(b), parts)
    cell = Cell(between=tuple(between(a, b) for a, b in pairwise(parts)))
    how = {"inertias": read_inertias(urdf, chain), "look_for_effects": effects}
    done = calibrate(samples, chain, np.random.default_rng(0), cell, **how)
    report, final = done.report, done.report.size_mm("final").rms
    found = [(e.family, e.place) for e in report.effects if e.family != "outliers"]
    gravity, kg = compared(report.loads, planted)
    named = planted.named is None or any(f in planted.named[0] and p in planted.named[1] for f, p in found)
    clean = not (found if "*" in planted.never else [f for f, _ in found if f in planted.never])
    out = {"robot": works.robot, "over_floor": final / planted.floor_mm, "final_mm": final, "samples": len(samples)}
    out |= {"named": bool(named and (planted.down is None or gravity < 5.0))}
    out |= {"clean": bool(clean and (kind not in loads.ROWS or planted.down is not None or np.isnan(gravity)))}
    out |= {"gravity_deg": gravity, "kg": kg, "status": report.judged.status}
    out |= {"effects": [f"{e.family} {e.place} {e.driver}" for e in report.effects]}
    return out | (beside_true_effects(done, works.exact_samples(report.samples), cell) if planted.stations else {})


def compared(found: Any, planted: Planted) -> tuple[float, float]:
    """Angle [deg] between found and true weight, and the largest error of a payload [kg]; NaN where nothing is said."""
    gravity = kg = np.nan
    if found is not None and found.down is not None:
        true = np.array([0.0, 0.0, -1.0]) if planted.down is None else planted.down
        gravity = float(np.degrees(np.arccos(np.clip(found.down @ true, -1.0, 1.0))))
    if found is not None and found.payloads:
        masses = np.array([p.mass for p in found.payloads])
        true_kg = np.array(planted.carried or (0.0,) * len(masses))
        kg = float(np.abs(masses - true_kg).max()) if len(masses) == len(true_kg) else np.nan
    return gravity, kg


def delta(kind: str, seed: int, effects: bool) -> harness.Result:
    """A Delta of MuJoCo's closed chains, every constant off: are its rods and its gear named, and nothing else?"""
    unequal, gear = RODS[kind]
    rng = np.random.default_rng([seed, 22])
    apart, joint = APART_M * rng.choice([-1.0, 1.0], 3) if unequal else np.zeros(3), int(rng.integers(3))
    how = {"noise_m": 1e-3 * FLOOR_MM / np.sqrt(3.0), "unequal": tuple(apart)}
    how["gear"] = (joint, CYCLES, AMPLITUDE) if gear else None
    cell = record_delta(seed, STATIONS + HELD_OUT, ("point", "pose")[seed % 2], seed % 4 < 2, **how)
    found = modcal.calibrate(Robot(cell.nominal), cell.samples.select(np.arange(STATIONS)), seed=0)
    rest = cell.samples.select(np.arange(STATIONS, STATIONS + HELD_OUT))
    gap = found.calibration.calibrated.predict_samples(rest)[:, :3, 3] - rest.reading
    named = sorted(f"{e.family}:{e.place}" for e in found.report.effects)
    gears = [e.parameters["cycles_per_turn"] for e in found.report.effects if e.family == "gear_harmonic"]
    there = [f"gear_harmonic:{cell.nominal.names[joint]}"] * gear + ["parallelogram:tool"] * unequal
    right = named == there and all(abs(value - CYCLES) < WITHIN * std for value, std, *_ in gears)
    out = {"over_floor": 1e3 * rms(gap) / FLOOR_MM, "named": right, "clean": right, "effects": named}
    return out | {"status": found.report.status, "cycles": [(value, std) for value, std, *_ in gears]}


def train_of(done: Solution) -> np.ndarray:
    """Rows of the train set that are not wrong."""
    return done.report.sets.train[~done.report.wrong[done.report.sets.train]]


def missed(fit: Fit, samples: Samples) -> float:
    """RMS [mm] of what a fit leaves."""
    return 1e3 * harness.rms(errors(fit.model, samples).position_norm)


def beside_truth(done: Solution, exact: Samples, cell: Cell, tool: np.ndarray) -> dict[str, float]:
    """truth_mm: RMS that the truth, base and tool with it, leaves of the held-out stations; begun_mm: that of the same
    fit begun there; less: how much its cost is less [squared deviations]. NaN where the truth is not among its values.

    exact: the samples without noise. tool: (3,) [m].
    """
    fit, train = done.scored, done.report.samples.select(train_of(done))
    about = replace(fit.start, T_tip_tool=se3.transform(fit.start.T_tip_tool[:3, :3], tool))
    for start, begin in ((fit.start, fit.values), (with_bases(about, exact, cell), None)):
        true = identify(start, exact, fit.parameters, cell.distances, robust=False, begin=begin)
        if missed(true, exact) < TRUE_MM:
            break
    else:
        return dict.fromkeys(("truth_mm", "begun_mm", "less"), np.nan)
    again = identify(true.start, train, fit.parameters, cell.distances, begin=true.values)
    scored = done.report.scored
    less = _cost(fit, fit, train) - _cost(again, fit, train)
    return {"truth_mm": missed(true, scored), "begun_mm": missed(again, scored), "less": less}


def beside_true_effects(done: Solution, exact: Samples, cell: Cell) -> dict[str, float]:
    """Ratios: over_truth: what is left over what the truth leaves of the same held-out stations; expected: the same by
    the covariance of the values; lacks: what the model that was found leaves of stations without noise, over the
    truth's; over_begun: over the same model fitted from the values that stations without noise give it.
    """
    report, fit, rows = done.report, done.scored, train_of(done)
    start = fit.start.with_effects(fit.model.effects)
    true = identify(start, exact.select(rows), fit.parameters, cell.distances, robust=False, begin=fit.values)
    start = true.start.with_effects(true.model.effects)
    again = identify(start, report.samples.select(rows), fit.parameters, cell.distances, begin=true.values)
    held = report.sets.held_out[~report.wrong[report.sets.held_out]]
    noise = report.samples.reading[held] - exact.reading[held]
    left = 1e3 * rms(noise)
    estimation = {row.what: row.value for row in report.judged.account_mm2}["estimation"]
    final = missed(fit, report.scored)
    return {
        "over_truth": final / left,
        "expected": float(np.sqrt(1.0 + estimation / left**2)),
        "lacks": missed(true, exact.select(held)) / left,
        "over_begun": final / missed(again, report.scored),
    }


def _cost(fit: Fit, scale: Fit, samples: Samples) -> float:
    """Squares of what a fit leaves, and of its values in priors, in deviations of one scale for all fits."""
    prior = np.array([p.prior_std for p in fit.parameters])
    square = squared_residuals(errors(fit.model, samples), samples, scale.noise)
    return float(square.sum() + np.sum((fit.values / prior) ** 2))


def line(r: harness.Result) -> str:
    words = [f"{r['over_floor']:.2f} x the floor"]
    if "over_truth" in r:
        words.append(f"{r['over_truth']:.2f} x the truth, {r['over_begun']:.3f} x begun there")
    words += [] if r.get("named", True) else ["NOT NAMED"]
    words += [] if r.get("clean", True) else ["NOT THERE"]
    return ", ".join([*words, r["status"], *r["effects"]])


def together(kind: str, of_seeds: list[harness.Result]) -> list[object]:
    """A row of the table."""

    def values(key: str) -> np.ndarray:
        return np.array([r.get(key, np.nan) for r in of_seeds], dtype=float)

    def told(key: str, *ways: Any) -> list[object]:
        known = values(key)[np.isfinite(values(key))]
        return [f"{way(known):.3f}" if len(known) else "" for way in ways]

    over = values("over_floor")
    named = [f"{np.mean([r[key] for r in of_seeds]):.0%}" if key in of_seeds[0] else "" for key in ("named", "clean")]
    row = [kind, len(of_seeds), *told("over_floor", np.median, harness.rms, np.max), f"{np.mean(over <= MAX):.0%}"]
    row += [*named, *told("gravity_deg", np.median, np.max), *told("kg", np.median)]
    row += [*told("over_truth", np.median, np.max), *told("expected", harness.rms)]
    return row + [*told("lacks", np.median, np.max), *told("over_begun", np.max)]


def main() -> int:
    """Exit code: 0 where nothing failed and the Deltas meet their targets."""
    parser = harness.parser(__doc__, seeds=20, names=(*KINDS, *ROWS, *RODS), first=None)
    parser.add_argument("--geometry-only", action="store_true", help="look for no effects")
    given = harness.parsed(parser)
    first = {kind: FIRST.get(kind, 0) if given.first is None else given.first for kind in given.names}
    tasks = [
        {"kind": kind, "seed": first[kind] + k, "geometry_only": given.geometry_only}
        for kind in given.names
        for k in range(given.seeds)
    ]
    results = harness.each(one, tasks, given, line)
    good = {kind: [r for r in results if r["kind"] == kind and not r["failed"]] for kind in given.names}
    heads = f"recording|seeds|÷ floor|RMS|worst|≤ {MAX:g}|named|nothing else|gravity °|worst|kg|÷ truth|worst|expected"
    heads = f"{heads}|lacks|worst|÷ begun at the truth".split("|")
    harness.table("What is left, in floors", heads, [together(kind, rs) for kind, rs in good.items() if rs])
    deltas = {kind: rs for kind, rs in good.items() if kind in RODS and rs}
    targets = [(f"{k}: {MAX} floors", harness.rms([r["over_floor"] for r in rs]) <= MAX) for k, rs in deltas.items()]
    targets += [(f"{k}: {NAMED:.0%} named", np.mean([r["named"] for r in rs]) >= NAMED) for k, rs in deltas.items()]
    return int(bool(harness.failures(results))) or harness.met(*targets)


if __name__ == "__main__":
    sys.exit(main())
