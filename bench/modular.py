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

import numpy as np
from harness import over, share
from modules.arms import LIBRARY, five_joints, random_assembly
from modules.test_module_errors import JOINTS, LINKS, TEN, before_calibration, built, measured
from modules.test_twists import PARALLEL, mean_error
from modules.test_twists import measured as named_and_measured
from modules.workshop import Arm, Made, shelf_of

from modcal_core.calibration.adjoint import identify_twists
from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.modules.errors import learn, recording_evidence
from modcal_core.modules.library import chain_of

ASSEMBLIES = (1, 2, 3, 5, 8, 12)  # after so many the next one is looked at
KNOWN = {"published answer": five_joints, "three parallel axes": lambda: PARALLEL}
SEEDS = {"building": 1, "experiment": 10, "reuse": 30}


def building(task: harness.Task) -> harness.Result:
    """How long a chain takes to build [ms]."""
    rng = np.random.default_rng(0)
    many = [random_assembly(rng) for _ in range(300)]
    clock = time.process_time()
    for assembly in many:
        chain_of(assembly, LIBRARY)
    return {"rows": [{"assembly": "any", "ms": 1e3 * (time.process_time() - clock) / len(many)}]}


def experiment(task: harness.Task) -> harness.Result:
    """Mean errors [mm] of the drawing and the twists, with steps, condition and time [ms] of these."""
    rows = []
    for name, assembly in KNOWN.items():
        chain, samples = named_and_measured(assembly(), 100 + task["seed"])
        train, rest = samples.select(np.arange(50)), samples.select(np.arange(50, 150))
        start = fit_cell(chain, train, Cell()).model
        clock = time.process_time()
        fit = identify_twists(start, train)
        took = 1e3 * (time.process_time() - clock)
        drawing, twists = 1e3 * mean_error(start, rest), 1e3 * mean_error(fit.model, rest)
        out = {"assembly": name, "drawing": drawing, "twists": twists, "smaller": drawing / twists, "ms": took}
        rows.append(out | {"steps": fit.iterations, "condition": fit.condition})
    return {"rows": rows}


def reuse(task: harness.Task) -> harness.Result:
    """By assemblies learned from: the next one's mean error [mm] by the drawing, by the store, and of flanges alone."""
    rng, made = np.random.default_rng(1000 + task["seed"]), Made()
    shelf, told, rows = shelf_of(TEN, made, rng), [], []
    for k in range(max(ASSEMBLIES) + 1):
        turns = [int(t) for t in rng.integers(4, size=9)]
        assembly = built(f"a{k}", list(rng.permutation(len(JOINTS))), list(rng.permutation(len(LINKS))), turns)
        samples = measured(assembly, Arm(assembly, shelf, made, rng), rng)
        if k in ASSEMBLIES:
            known, perfect = learn(told, LIBRARY).twists, replace(made, length=0.0, angle=0.0, zero=0.0)
            # of perfect modules: what is left is what no store can know
            bolted = measured(assembly, Arm(assembly, shelf_of(TEN, perfect, rng), made, rng), rng)
            cases = {"drawing": (None, samples), "store": (known, samples), "flanges": (None, bolted)}
            rows.append({"assembly": k} | {n: 1e3 * before_calibration(assembly, *case) for n, case in cases.items()})
        told.append(recording_evidence(assembly, LIBRARY, samples))
    return {"rows": rows}


PARTS = {"building": building, "experiment": experiment, "reuse": reuse}
KEYS = ("drawing", "twists", "smaller", "ms", "condition")
COLUMNS = {
    "building": {"ms": over("ms", np.mean)},
    "experiment": {key: over(key, np.mean) for key in KEYS} | {"steps ≤": over("steps", max)},
    "reuse": {key: over(key, np.mean) for key in ("drawing", "store", "flanges")},
}
COLUMNS["reuse"] |= {
    "times smaller": lambda rows: np.mean([r["drawing"] for r in rows]) / np.mean([r["store"] for r in rows]),
    "better in": lambda rows: share(r["store"] < r["drawing"] for r in rows),
}
TITLES = {
    "building": "assembly to chain",
    "experiment": "five joints, 50 stations, mean error of 100 others, mm",
    "reuse": "mean error of an assembly that was never measured, mm, by assemblies learned from",
}


def main() -> int:
    given = harness.options(__doc__, seeds=None, names=PARTS)
    results = harness.each(PARTS, harness.tasks(given, SEEDS, part=given.names), given)
    for part, own in harness.grouped(results, "part").items():
        harness.summary(TITLES[part], [row for r in own for row in r["rows"]], "assembly", COLUMNS[part])
    return harness.ended(results)


if __name__ == "__main__":
    sys.exit(main())
