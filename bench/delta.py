"""A Delta by annealing, by distances and by points, on the same readings of MuJoCo's closed chains.

make bench NAME=delta ARGS="--seeds 3 --counts 20 50"
"""

from __future__ import annotations

import harness

# isort: split
import sys
import time

import numpy as np
from deltas import NOISE_M, record_delta
from harness import over

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.delta_distances import Pairs, anneal_distances, fit_distances
from modcal_core.calibration.fit import identify
from modcal_core.calibration.initial import procrustes
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.geometry import se3
from modcal_core.robots.delta import Delta
from modcal_core.robots.delta_kinematics import tool_pose

HELD_OUT = 200


def one(task: harness.Task) -> harness.Result:
    """By way of calibrating: held-out RMS [mm], evaluations and CPU seconds."""
    count = task["count"]
    cell, rows, began = record_delta(task["seed"], count + HELD_OUT), [], time.process_time()
    q, y = cell.samples.q, cell.samples.reading
    pairs, rng = Pairs.of_points(y[:count]), np.random.default_rng(task["seed"])

    def note(way: str, points: np.ndarray, evaluations: int) -> None:
        spent, mm = time.process_time() - began, 1e3 * harness.rms(np.linalg.norm(points - y[count:], axis=1))
        rows.append({"N": count, "way": way, "mm": mm, "evaluations": evaluations, "s": spent})

    def tool(delta: Delta) -> np.ndarray:
        """Held-out points, the frame found from the ones that were fitted."""
        T = procrustes(tool_pose(delta, q[:count])[:, :3, 3], y[:count])
        return se3.apply(T, tool_pose(delta, q[count:])[:, :3, 3])

    note("nominal", tool(cell.nominal), 0)
    annealed, went = anneal_distances(cell.nominal, q[:count], pairs, rng)
    note("annealing", tool(annealed), went.evaluations)
    found = fit_distances(cell.nominal, q[:count], pairs, begin=annealed)
    note("annealing, then distances", tool(found.delta), went.evaluations + found.evaluations)
    began = time.process_time()
    found = fit_distances(cell.nominal, q[:count], pairs)
    note("distances", tool(found.delta), found.evaluations)
    began, train = time.process_time(), cell.samples.select(np.arange(count))
    start = fit_cell(cell.nominal, train, Cell())
    fit = identify(start.model, train, choose_parameters(start.model, views_of(train)).parameters)
    points = fit.model.predict(q[count:])[:, :3, 3]
    note("points, frame found", points, 2 * (start.iterations + fit.iterations))
    return {"rows": rows}


def main() -> int:
    given = harness.options(__doc__, seeds=3, first=1, counts=[20, 50, 200])
    results, floor = harness.each(one, harness.tasks(given, count=given.counts), given), 1e3 * NOISE_M * np.sqrt(3.0)
    rows = [row for r in results if not r["failed"] for row in r["rows"]]
    columns = {"held-out mm": over("mm", harness.rms), "to the floor": over("mm", lambda mm: harness.rms(mm) / floor)}
    columns |= {"evaluations": over("evaluations", np.mean), "s": over("s", np.mean)}
    harness.summary("", rows, ("N", "way"), columns)
    return harness.ended(results)


if __name__ == "__main__":
    sys.exit(main())
