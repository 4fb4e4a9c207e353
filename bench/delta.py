"""A Delta by annealing, by distances and by points, on the same readings of MuJoCo's closed chains.

make bench NAME=delta ARGS="--seeds 3 --counts 20 50"
"""

from __future__ import annotations

import harness

# isort: split
import sys
import time

import numpy as np
from deltas import NOISE_M, RecordedDelta, record_delta

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.delta_distances import Pairs, anneal_distances, fit_distances
from modcal_core.calibration.fit import identify
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
    return apart(y[count:], se3.apply(T, tool_pose(fitted, q[count:])[:, :3, 3]))


def apart(a: np.ndarray, b: np.ndarray) -> float:
    """RMS distance [mm] of points (N, 3) [m]."""
    return 1e3 * harness.rms(np.linalg.norm(a - b, axis=1))


def one(task: harness.Task) -> harness.Result:
    """Held-out RMS [mm], evaluations and CPU seconds by way of calibrating."""
    count = task["count"]
    cell = record_delta(task["seed"], count + HELD_OUT)
    q, pairs = cell.samples.q[:count], Pairs.of_points(cell.samples.reading[:count])
    out, began = {ROWS[0]: (missed(cell.nominal, cell, count), 0, 0.0)}, time.process_time()
    annealed, went = anneal_distances(cell.nominal, q, pairs, np.random.default_rng(task["seed"]))
    out[ROWS[1]] = (missed(annealed, cell, count), went.evaluations, time.process_time() - began)
    found = fit_distances(cell.nominal, q, pairs, begin=annealed)
    evaluations = went.evaluations + found.evaluations
    out[ROWS[2]] = (missed(found.delta, cell, count), evaluations, time.process_time() - began)
    began = time.process_time()
    found = fit_distances(cell.nominal, q, pairs)
    out[ROWS[3]] = (missed(found.delta, cell, count), found.evaluations, time.process_time() - began)
    began, train = time.process_time(), cell.samples.select(np.arange(count))
    start = fit_cell(cell.nominal, train, Cell())
    fit = identify(start.model, train, choose_parameters(start.model, views_of(train)).parameters)
    spent = time.process_time() - began
    left = apart(cell.samples.reading[count:], fit.model.predict(cell.samples.q[count:])[:, :3, 3])
    return {"ways": {**out, ROWS[4]: (left, 2 * (start.iterations + fit.iterations), spent)}}


def main() -> int:
    parser = harness.parser(__doc__, seeds=3, first=1)
    parser.add_argument("--counts", type=int, nargs="+", default=[20, 50, 200])
    given = harness.parsed(parser)
    results = harness.each(one, harness.tasks(given, count=given.counts), given)
    floor, rows = 1e3 * NOISE_M * np.sqrt(3.0), []
    for count in given.counts:
        runs = [r["ways"] for r in results if r["count"] == count and not r["failed"]]
        for way in ROWS if runs else ():
            mm, (evaluations, spent) = (
                harness.rms([r[way][0] for r in runs]),
                np.mean([r[way][1:] for r in runs], axis=0),
            )
            rows.append(
                [count, way, mm, mm / floor, round(evaluations), spent / np.mean([r["distances"][2] for r in runs])]
            )
    heads = ("N", "way", "held-out mm", "to the floor", "evaluations", "time to that of distances")
    harness.table("", heads, rows)
    return int(bool(harness.failures(results)))


if __name__ == "__main__":
    sys.exit(main())
