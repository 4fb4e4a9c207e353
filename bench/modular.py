"""Modular arms: calibration after re-assembly, and what a store of module errors is worth. Figures for docs/modules.md.

The truth is the workshop of the tests: frames of modules moved directly, flanges bolted anew each time, a laser tracker
of 0.02 mm per axis that sees a ball on the gripper. building: how long a chain takes. experiment: the source's, 50
stations calibrate five joints, 100 others score. reuse: the same ten modules in random order and turns.
"""

from __future__ import annotations

import harness

# isort: split
import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np
from modules.arms import LIBRARY, five_joints, random_assembly
from modules.test_module_errors import JOINTS, LINKS, TEN, before_calibration, built, measured
from modules.test_twists import PARALLEL, DhFit, mean_error
from modules.test_twists import measured as named_and_measured
from modules.workshop import Arm, Made, shelf_of

from modcal_core.calibration.adjoint import identify_twists
from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.modules.errors import learn, recording_evidence
from modcal_core.modules.poe import chain_of

ASSEMBLIES = (1, 2, 3, 5, 8, 12)  # after so many the next one is looked at
SEEDS = {"building": 1, "experiment": 10, "reuse": 30}
KNOWN = {"published answer": five_joints, "three parallel axes": lambda: PARALLEL}


def one(task: harness.Task) -> harness.Result:
    return {"building": building, "experiment": experiment, "reuse": reuse}[task["part"]](task)


def building(task: harness.Task) -> harness.Result:
    """How long a chain takes to build [s]."""
    rng = np.random.default_rng(0)
    many = [random_assembly(rng) for _ in range(300)]
    clock = time.process_time()
    for assembly in many:
        chain_of(assembly, LIBRARY)
    return {"each_s": (time.process_time() - clock) / len(many)}


def experiment(task: harness.Task) -> harness.Result:
    """Mean errors [m] of the drawing, the twists and a DH fit, with steps, condition and time of the twists."""
    chain, samples = named_and_measured(KNOWN[task["assembly"]](), 100 + task["seed"])
    train, rest = samples.select(np.arange(50)), samples.select(np.arange(50, 150))
    start = fit_cell(chain, train, Cell()).model
    clock = time.process_time()
    fit = identify_twists(start, train)
    took, dh = time.process_time() - clock, DhFit(chain, start, train)
    out = {"drawing": mean_error(start, rest), "twists": mean_error(fit.model, rest), "steps": fit.iterations}
    return {
        **out,
        "condition": fit.condition,
        "took": took,
        "dh": mean_error(dh.fitted(30), rest),
        "dh_condition": dh.condition(),
    }


def reuse(task: harness.Task) -> harness.Result:
    """By assemblies learned from: the next one's mean error [m] by the drawing, by the store, and of flanges alone."""
    rng, made = np.random.default_rng(1000 + task["seed"]), Made()
    shelf, told, rows = shelf_of(TEN, made, rng), [], {}
    for k in range(max(ASSEMBLIES) + 1):
        turns = [int(t) for t in rng.integers(4, size=9)]
        assembly = built(f"a{k}", list(rng.permutation(len(JOINTS))), list(rng.permutation(len(LINKS))), turns)
        samples = measured(assembly, Arm(assembly, shelf, made, rng), rng)
        if k in ASSEMBLIES:
            known, perfect = learn(told, LIBRARY).twists, replace(made, length=0.0, angle=0.0, zero=0.0)
            # of perfect modules: what is left is what no store can know
            bolted = measured(assembly, Arm(assembly, shelf_of(TEN, perfect, rng), made, rng), rng)
            errors = [before_calibration(assembly, e, samples) for e in (None, known)]
            rows[str(k)] = [*errors, before_calibration(assembly, None, bolted)]
        told.append(recording_evidence(assembly, LIBRARY, samples))
    return {"rows": rows}


def show(part: str, good: list[harness.Result]) -> None:
    """The table of a part."""
    if part == "building":
        harness.say(f"assembly to chain: {1e3 * good[0]['each_s']:.2f} ms")
    elif part == "experiment":
        rows = []
        for name in KNOWN:
            of: Any = {k: np.array([r[k] for r in good if r["assembly"] == name]) for k in good[0] if k in KEYS}
            smaller = float(np.mean(of["drawing"] / of["twists"]))
            mm = [1e3 * float(of[k].mean()) for k in ("drawing", "twists")]
            told = [int(of["steps"].max()), float(of["condition"].mean()), 1e3 * float(of["took"].mean())]
            rows.append(
                [name, *mm, smaller, *told, 1e3 * float(of["dh"].mean()), f"{np.median(of['dh_condition']):.1e}"]
            )
        heads = (
            "assembly",
            "drawing mm",
            "twists mm",
            "times smaller",
            "steps ≤",
            "condition",
            "ms",
            "DH mm",
            "DH condition",
        )
        harness.table("five joints, 50 stations, mean error of 100 others", heads, rows)
    else:
        rows = []
        for k in good[0]["rows"]:
            a = np.array([r["rows"][k] for r in good])
            m = 1e3 * a.mean(axis=0)
            rows.append([k, m[0], m[1], m[0] / m[1], harness.share(a[:, 1] < a[:, 0]), m[2]])
        heads = ("assemblies learned from", "drawing", "with the store", "times smaller", "better in", "flanges alone")
        harness.table("mean error of an assembly that was never measured, mm", heads, rows)


KEYS = ("drawing", "twists", "steps", "condition", "took", "dh", "dh_condition")


def main() -> int:
    given = harness.options(__doc__, seeds=None, names=SEEDS)
    tasks = [
        {"part": part, **more, "seed": given.first + k}
        for part in given.names
        for more in ([{"assembly": name} for name in KNOWN] if part == "experiment" else [{}])
        for k in range(SEEDS[part] if given.seeds is None else given.seeds)
    ]
    results = harness.each(one, tasks, given)
    for part in given.names:
        if good := [r for r in results if r["part"] == part and not r["failed"]]:
            show(part, good)
    return int(bool(harness.failures(results)))


if __name__ == "__main__":
    sys.exit(main())
