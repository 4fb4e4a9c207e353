"""How much faster a pick and place gets by the limits of each posture than by constant ones, and what the drives give.

    make bench NAME=limits ARGS="--postures 2000 --seed 0 --rounds 60"

See tests/robots/pick_and_place.py. Every timing is played in MuJoCo, which reads the arm by itself. Constant bounds
depend on how the box's weights share the torque among the joints; besides equal ones, those that make this very path
fastest are sought. Exits with 1 where a drive gives more than it can, or the limits of each posture are no faster.
"""

from __future__ import annotations

import harness

# isort: split
import sys

import conftest  # noqa: F401 (finds the install tree)
import numpy as np
from robots.pick_and_place import PickAndPlace

from modcal_core.robots.acceleration import Window
from modcal_core.robots.fastest_motion import constant_bounds

COARSE = 150  # places, while weights are sought


def best_weights(job: PickAndPlace, windows: Window, rounds: int, rng: np.random.Generator) -> np.ndarray:
    """Weights of the joints for which constant bounds go this path fastest, by trying steps of all sizes."""
    at, best = np.zeros(6), job.by_constants(windows, np.ones(6), COARSE).duration
    for k in range(rounds):
        tried = np.clip(at + rng.normal(scale=2.0 / (1.0 + 4.0 * k / rounds), size=6), -6.0, 6.0)
        duration = job.by_constants(windows, np.exp(tried), COARSE).duration
        if duration < best:
            at, best = tried, duration
    return np.exp(at)


def main() -> int:
    given = harness.options(__doc__, seeds=0, postures=2000, seed=0, rounds=60)
    rng, job = np.random.default_rng(given.seed), PickAndPlace()
    q = job.workspace(given.postures, rng)
    along = job.path.at(np.linspace(0.0, job.path.length, 200))[0]
    rest = job.windows(q, None)
    windows = {"workspace, at rest": rest, "workspace, at any speed": job.windows(q, rng)}
    windows["this path, at rest"] = job.windows(along, None)
    timings = {"torque of each posture": job.by_torque()}
    timings |= {f"constant: {name}": job.by_constants(box) for name, box in windows.items()}
    # the rows of most postures never matter: seek with those that could, then take all
    weights = best_weights(job, job.windows(q[:: max(1, len(q) // 200)], None), given.rounds, rng)
    timings["constant: workspace, at rest, best weights for this path"] = job.by_constants(rest, weights)
    fast, rows, right = timings["torque of each posture"].duration, [], []
    for name, timing in timings.items():
        played = job.play(timing)
        use = float(np.abs(played.torque / job.drives.torque).max())
        rows.append([name, timing.duration, timing.duration / fast, f"{use:.0%}", 1e3 * played.miss])
        right.append((f"{name}: within torque, and no faster", use < 1.0 and timing.duration >= fast))
    harness.table("", ("limits", "time [s]", "ratio", "most torque", "farthest off the path [mrad]"), rows)
    lower, upper = constant_bounds(rest)
    harness.say(f"constant bounds of the workspace, at rest [rad/s²]: {np.round(lower, 2)} {np.round(upper, 2)}")
    return harness.met(*right)


if __name__ == "__main__":
    sys.exit(main())
