"""Modular arms: calibration after re-assembly, and what a store of module errors is worth. Figures for docs/modules.md.

    .venv/bin/python bench/modular.py [--workshops N]

The truth is the workshop of the tests: frames of modules moved directly, flanges bolted anew each time, a laser tracker
of 0.02 mm per axis that sees a ball on the gripper.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import sys  # noqa: E402
import time  # noqa: E402
from dataclasses import replace  # noqa: E402
from pathlib import Path  # noqa: E402

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import click  # noqa: E402
import numpy as np  # noqa: E402
from modules.arms import LIBRARY, five_joints, random_assembly  # noqa: E402
from modules.test_module_errors import JOINTS, LINKS, TEN, before_calibration, built, measured  # noqa: E402
from modules.test_twists import PARALLEL, DhFit, mean_error  # noqa: E402
from modules.test_twists import measured as named_and_measured  # noqa: E402
from modules.workshop import Arm, Made, shelf_of  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from modcal_core.calibration.adjoint import identify_twists  # noqa: E402
from modcal_core.calibration.cell import Cell, fit_cell  # noqa: E402
from modcal_core.modules.assembly import Assembly  # noqa: E402
from modcal_core.modules.errors import learn  # noqa: E402
from modcal_core.modules.poe import chain_of  # noqa: E402
from modcal_core.modules.recording_evidence import recording_evidence  # noqa: E402

ASSEMBLIES = (1, 2, 3, 5, 8, 12)  # after so many the next one is looked at


def experiment(console: Console, seeds: int) -> None:
    """The source's experiment: 50 stations calibrate five joints, 100 others score."""
    table = Table(title="five joints, 50 stations, mean error of 100 others", box=None)
    for name in (
        "assembly",
        "drawing mm",
        "twists mm",
        "times smaller",
        "steps",
        "condition",
        "ms",
        "DH mm",
        "DH condition",
    ):
        table.add_column(name, justify="right")
    for name, assembly in (("published answer", five_joints()), ("three parallel axes", PARALLEL)):
        rows = []
        for seed in range(seeds):
            chain, samples = named_and_measured(assembly, 100 + seed)
            train, rest = samples.select(np.arange(50)), samples.select(np.arange(50, 150))
            start = fit_cell(chain, train, Cell()).model
            clock = time.process_time()
            fit = identify_twists(start, train)
            took = time.process_time() - clock
            dh = DhFit(chain, start, train)
            left = mean_error(dh.fitted(30), rest)
            before, after = mean_error(start, rest), mean_error(fit.model, rest)
            rows.append([before, after, before / after, fit.iterations, fit.condition, took, left, dh.condition()])
        m = np.mean(rows, axis=0)
        steps = int(np.max([r[3] for r in rows]))
        numbers = (
            f"{1e3 * m[0]:.2f}",
            f"{1e3 * m[1]:.4f}",
            f"{m[2]:.0f}",
            f"≤ {steps}",
            f"{m[4]:.0f}",
            f"{1e3 * m[5]:.1f}",
        )
        table.add_row(name, *numbers, f"{1e3 * m[6]:.3f}", f"{np.median([r[7] for r in rows]):.1e}")
    console.print(table)


def reuse(console: Console, workshops: int) -> None:
    """Assemblies of the same ten modules in random order and turns; each next one before its own calibration."""
    errors: dict[int, list[list[float]]] = {k: [] for k in ASSEMBLIES}
    for seed in range(workshops):
        rng, made = np.random.default_rng(1000 + seed), Made()
        shelf = shelf_of(TEN, made, rng)
        told = []
        for k in range(max(ASSEMBLIES) + 1):
            turns = [int(t) for t in rng.integers(4, size=9)]
            assembly = built(f"a{k}", list(rng.permutation(len(JOINTS))), list(rng.permutation(len(LINKS))), turns)
            samples = measured(assembly, Arm(assembly, shelf, made, rng), rng)
            if k in ASSEMBLIES:
                known = learn(told, LIBRARY).twists
                bolted_alone = before_calibration(assembly, None, _without_module_errors(assembly, made, rng))
                row = [before_calibration(assembly, e, samples) for e in (None, known)]
                errors[k].append([*row, bolted_alone])
            told.append(recording_evidence(assembly, LIBRARY, samples))
    table = Table(title="mean error of an assembly that was never measured, mm", box=None)
    for name in ("assemblies learned from", "drawing", "with the store", "times smaller", "better in", "flanges alone"):
        table.add_column(name, justify="right")
    for k, rows in errors.items():
        a = np.array(rows)
        m = 1e3 * a.mean(axis=0)
        better = f"{int((a[:, 1] < a[:, 0]).sum())} of {len(a)}"
        table.add_row(str(k), f"{m[0]:.2f}", f"{m[1]:.2f}", f"{m[0] / m[1]:.1f}", better, f"{m[2]:.2f}")
    console.print(table)


def _without_module_errors(assembly: Assembly, made: Made, rng: np.random.Generator):  # type: ignore[no-untyped-def]
    """The same assembly of perfect modules: what is left is what no store can know."""
    perfect = replace(made, length=0.0, angle=0.0, zero=0.0)
    return measured(assembly, Arm(assembly, shelf_of(TEN, perfect, rng), made, rng), rng)


def building(console: Console) -> None:
    """How long a chain takes to build."""
    rng = np.random.default_rng(0)
    many = [random_assembly(rng) for _ in range(300)]
    clock = time.process_time()
    for assembly in many:
        chain_of(assembly, LIBRARY)
    console.print(f"assembly to chain: {1e3 * (time.process_time() - clock) / len(many):.2f} ms")


@click.command()
@click.option("--workshops", type=int, default=30, show_default=True)
@click.option("--seeds", type=int, default=10, show_default=True)
def main(workshops: int, seeds: int) -> None:
    """Print the tables."""
    console = Console(width=140)
    building(console)
    experiment(console, seeds)
    reuse(console, workshops)


if __name__ == "__main__":
    main()
