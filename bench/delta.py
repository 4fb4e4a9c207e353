"""A Delta by annealing, by distances and by points, on the same readings of MuJoCo's closed chains.

make delta    # BENCH_ARGS="--robots 3 --counts 20 50" narrows
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from deltas import NOISE_M, RecordedDelta, record_delta

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.delta_distances import Pairs, anneal_distances, fit_distances
from modcal_core.calibration.identify import identify
from modcal_core.calibration.initial import procrustes
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.geometry import se3
from modcal_core.robots.delta import Delta
from modcal_core.robots.delta_kinematics import tool_pose

HELD_OUT = 200
ROWS = ("nominal", "annealing", "annealing, then distances", "distances", "points, frame found")


def missed(fitted: Delta, cell: RecordedDelta, count: int) -> float:
    """RMS distance [mm] of held-out readings, the frame found from the ones that were fitted."""
    q, y = cell.samples.q, cell.samples.reading
    T = procrustes(tool_pose(fitted, q[:count])[:, :3, 3], y[:count])
    gap = y[count:] - se3.apply(T, tool_pose(fitted, q[count:])[:, :3, 3])
    return 1e3 * float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


def compare(seed: int, count: int) -> dict[str, tuple[float, int, float]]:
    """(held-out RMS [mm], evaluations, CPU seconds) by way of calibrating."""
    cell = record_delta(seed, count + HELD_OUT)
    q, pairs = cell.samples.q[:count], Pairs.of_points(cell.samples.reading[:count])
    out = {"nominal": (missed(cell.nominal, cell, count), 0, 0.0)}
    began = time.process_time()
    annealed, went = anneal_distances(cell.nominal, q, pairs, np.random.default_rng(seed))
    middle = time.process_time()
    out["annealing"] = (missed(annealed, cell, count), went.evaluations, middle - began)
    polished = fit_distances(cell.nominal, q, pairs, begin=annealed)
    evaluations = went.evaluations + polished.evaluations
    out[ROWS[2]] = (missed(polished.delta, cell, count), evaluations, time.process_time() - began)
    began = time.process_time()
    found = fit_distances(cell.nominal, q, pairs)
    out["distances"] = (missed(found.delta, cell, count), found.evaluations, time.process_time() - began)
    began = time.process_time()
    train = cell.samples.select(np.arange(count))
    start = fit_cell(cell.nominal, train, Cell())
    fit = identify(start.model, train, choose_parameters(start.model, views_of(train)).parameters)
    spent = time.process_time() - began
    gap = cell.samples.reading[count:] - fit.model.predict(cell.samples.q[count:])[:, :3, 3]
    rms = 1e3 * float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))
    out[ROWS[4]] = (rms, 2 * (start.iterations + fit.iterations), spent)
    return out


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--robots", type=int, default=3)
    arguments.add_argument("--counts", type=int, nargs="+", default=[20, 50, 200])
    given = arguments.parse_args()
    floor = 1e3 * NOISE_M * np.sqrt(3.0)
    print("| N | way | held-out mm | to the floor | evaluations | time to that of distances |")
    print("| --- | --- | --- | --- | --- | --- |")
    for count in given.counts:
        runs = [compare(seed, count) for seed in range(1, given.robots + 1)]
        base = np.mean([run["distances"][2] for run in runs])
        for way in ROWS:
            rms = np.sqrt(np.mean([run[way][0] ** 2 for run in runs]))
            evaluations, spent = (np.mean([run[way][k] for run in runs]) for k in (1, 2))
            print(
                f"| {count} | {way} | {rms:.3f} | {rms / floor:.2f} | {evaluations:.0f} | {spent / base:.2g} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
