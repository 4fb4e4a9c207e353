"""How much faster a pick and place gets by the limits of each posture than by constant ones, and what the drives give.

    python bench/limits.py [--postures 2000] [--seed 0] [--rounds 60]

See tests/robots/pick_and_place.py. Every timing is played in MuJoCo, which reads the arm by itself. Constant bounds
depend on how the box's weights share the torque among the joints; besides equal ones, those that make this very path
fastest are sought. Exits with 1 where a drive gives more than it can, or the limits of each posture are no faster.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import conftest  # noqa: E402, F401 (finds the install tree)
import numpy as np  # noqa: E402
from robots.pick_and_place import PickAndPlace  # noqa: E402

from modcal_core.robots.acceleration import Window  # noqa: E402
from modcal_core.robots.fastest_motion import constant_bounds  # noqa: E402
from modcal_core.robots.path_timing import Timing  # noqa: E402

_COARSE = 150  # places, while weights are sought


def best_weights(job: PickAndPlace, windows: Window, rounds: int, rng: np.random.Generator) -> np.ndarray:
    """Weights of the joints for which constant bounds go this path fastest, by trying steps of all sizes."""
    at, best = np.zeros(6), job.by_constants(windows, np.ones(6), _COARSE).duration
    for k in range(rounds):
        tried = np.clip(at + rng.normal(scale=2.0 / (1.0 + 4.0 * k / rounds), size=6), -6.0, 6.0)
        duration = job.by_constants(windows, np.exp(tried), _COARSE).duration
        if duration < best:
            at, best = tried, duration
    return np.exp(at)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--postures", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=60)
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    job = PickAndPlace()
    q = job.workspace(chosen.postures, rng)
    along = job.path.at(np.linspace(0.0, job.path.length, 200))[0]
    rest, moving, here = job.windows(q, None), job.windows(q, rng), job.windows(along, None)
    timings: dict[str, Timing] = {"torque of each posture": job.by_torque()}
    for name, windows in (
        ("workspace, at rest", rest),
        ("workspace, at any speed", moving),
        ("this path, at rest", here),
    ):
        timings[f"constant: {name}"] = job.by_constants(windows)
    # the rows of most postures never matter: seek with those that could, then take all
    weights = best_weights(job, job.windows(q[:: max(1, len(q) // 200)], None), chosen.rounds, rng)
    timings["constant: workspace, at rest, best weights for this path"] = job.by_constants(rest, weights)
    fast = timings["torque of each posture"].duration
    print("| limits | time [s] | ratio | most torque | farthest off the path [mrad] |")
    print("| --- | --- | --- | --- | --- |")
    failed = False
    for name, timing in timings.items():
        played = job.play(timing)
        use = float(np.abs(played.torque / job.drives.torque).max())
        print(
            f"| {name} | {timing.duration:.2f} | {timing.duration / fast:.2f} | {use:.0%} | {1e3 * played.miss:.1f} |"
        )
        failed |= use >= 1.0 or timing.duration < fast
    lower, upper = constant_bounds(rest)
    print("\nconstant bounds of the workspace, at rest [rad/s²]:", np.round(lower, 2), np.round(upper, 2))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
