"""A joint with hysteresis is commanded to 200 places, forth and back: where does the true tool come to?

    make bench NAME=hysteresis ARGS="--seeds 6 --paths 200"

The arm is MuJoCo's, the friction Bouc and Wen's or LuGre's, integrated along all that the joints do (bench/undeclared).
The same places are commanded by the nominal arm, by geometry alone and by the corrector, which knows of the past what
it saw since the first path. A tick is *corrected* with the effect and without it.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import harness

# isort: split
sys.path.insert(0, str(Path(__file__).with_name("undeclared")))
import numpy as np
import recordings
import sites
from arms import ROBOTS, Array
from scenarios import hysteresis

from modcal_core.calibration.store import Calibration
from modcal_core.correction.commander import compensate
from modcal_core.correction.correction import ArmState, Correction
from modcal_core.errors import NotReachable
from modcal_core.geometry import se3
from modcal_core.measurements.dwells import Approach
from modcal_core.robots import inverse
from modcal_msgs_py.recording_write import write_recording

STEP = 0.02  # rad between postures on the way
MOST_MS = 0.3  # of a tick, that the effect may add


def way(q: Array, to: Array) -> Array:
    """Postures behind q on the straight way to another, the last one included."""
    count = max(int(np.ceil(np.abs(to - q).max() / STEP)), 1)
    return np.asarray(q + np.linspace(0.0, 1.0, count + 1)[1:, None] * (to - q))


def ticks_ms(correction: Correction, at: ArmState) -> float:
    """Median time of a tick."""
    took = []
    for _ in range(60):
        begun = time.perf_counter()
        correction.corrected(at)
        took.append(1e3 * (time.perf_counter() - begun))
    return float(np.median(took))


def one(task: harness.Task) -> harness.Result:
    """Calibrate an arm, command it in three ways, and look where its tool is."""
    robot = list(ROBOTS)[task["seed"] % len(ROBOTS)]
    rng = np.random.default_rng([2611, task["seed"]])
    cell = sites.Cell(robot, rng)
    plan = sites.point_to_point(cell.arm, rng, recordings.STATIONS, 0.0)
    plan = replace(plan, stations=replace(plan.stations, path=(plan.t, plan.q)))
    faults = recordings.plant(cell, (hysteresis,), rng, float(plan.t[-1]))
    with harness.scratch() as folder:
        write_recording(recordings.record(cell, plan, faults, rng, False, True)[0], folder / "bag")
        harness.succeeded("calibrate", folder / "bag", "--out", folder / "out")
        calibration = Calibration.load(folder / "out")
    families = [e.family for e in calibration.calibrated.effects]
    own = calibration.calibrated
    plain = replace(calibration, calibrated=own.with_effects(tuple(e for e in own.effects if e.family != "hysteresis")))
    correction, others = Correction(calibration), {"nominal": calibration.nominal, "geometry": calibration.geometric}
    places = rng.uniform(*cell.arm.range, (task["paths"] + 1, cell.arm.n))
    poses = calibration.geometric.predict(places)
    goals = [T for k in range(task["paths"]) for T in (poses[k], poses[k + 1])]
    near = places[np.repeat(np.arange(task["paths"]), 2) + np.tile([0, 1], task["paths"])]
    also = sum(family not in ("hysteresis", "residual") for family in families)
    result: harness.Result = {"named": "hysteresis" in families, "also": also}
    missed, reached = {}, np.ones(len(goals), bool)
    for name in ("nominal", "geometry", "corrected"):
        approach, path, ends, stamp = Approach(), [cell.arm.range.mean(axis=0)], [], 0.0
        approach.update(path[0])
        for k, (goal, seed) in enumerate(zip(goals, near, strict=True)):
            try:
                if name == "corrected":
                    came = approach.direction, np.nan * seed, (), approach.path.copy()
                    at = ArmState(stamp, path[-1], 0.0 * seed, *came)
                    frame = calibration.frames[0]
                    q = compensate(correction, goal, seed, at, "tool", frame, tolerance_m=1e-6).q
                else:
                    model = others[name]
                    tip = se3.inverse(model.T_frame_base[0]) @ goal @ se3.inverse(model.T_tip_tool)
                    q = inverse(model.serial, tip, seed, tolerance=1e-7)
            except NotReachable:  # a stretched arm is shorter by one model than by another
                reached[k], q = False, seed
            for posture in way(path[-1], q):
                approach.update(posture)
                path.append(posture)
            ends.append(len(path) - 1)
            stamp += 4.0
        q, t = np.array(path), 1e4 + 0.04 * np.arange(len(path))
        stations = sites.Stations(q[ends], t[ends], np.sign(q[ends] - q[np.array(ends) - 1]), (t, q))
        true = cell.poses(stations, [fault.bend for fault in faults])
        missed[name] = 1e3 * (true.p - np.array(goals)[:, :3, 3])
    result |= {name: sites.rms(error[reached]) for name, error in missed.items()}
    result["reached"] = int(reached.sum())
    result["tick ms"] = ticks_ms(correction, at) - ticks_ms(Correction(plain), at)
    return result


def main() -> int:
    """Exit code: 0 where a tick takes no longer than it may."""
    given = harness.options(__doc__, seeds=6, paths=200)
    results = harness.each(one, harness.tasks(given, paths=[given.paths]), given)
    harness.rows(
        "Tool error [mm RMS]", results, ("nominal", "geometry", "corrected", "reached", "named", "also", "tick ms")
    )
    slow = [r["tick ms"] > MOST_MS for r in results if not r["failed"]]
    return harness.ended(results, (f"at most {MOST_MS} ms more a tick", not any(slow)))


if __name__ == "__main__":
    sys.exit(main())
