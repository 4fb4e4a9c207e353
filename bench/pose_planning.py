"""Planned stations against random ones, on arms of MuJoCo, and what low-rank updates save.

    make planning        # BENCH_ARGS="--arms 40" for more, "--quick" for less

Every arm has all its bodies displaced (0.5 mm, 1 mrad a direction); its readings have the noise of the site, its joints
do not repeat. Both sides choose from the same postures: within limits, seen by the tracker, touching
nothing. The error is that of the calibrated arm at postures of the workspace, against MuJoCo, RMS over the arms;
in brackets 95 % of what drawing the arms again gives. *Foretold* is what the plan said of itself.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from pathlib import Path  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402
from planning.arms import irb1410  # noqa: E402
from planning.sites import hall  # noqa: E402
from planning.studies import Arm  # noqa: E402

from modcal_core.planning.criteria import CRITERIA, criterion  # noqa: E402
from modcal_core.planning.exchange import best_candidate  # noqa: E402
from modcal_core.planning.plan import chosen_stations, min_stations  # noqa: E402
from modcal_core.planning.posture_pool import PosturePool, random_accuracies, survey  # noqa: E402
from modcal_core.robots.chain import Chain  # noqa: E402
from modcal_core.robots.urdf import read_chain  # noqa: E402

WHERE = 200  # postures at which the error is taken


def robots() -> dict[str, Chain]:
    def of(name: str) -> Chain:
        return read_chain((ROOT / "examples" / "robots" / f"{name}.urdf").read_text())

    return {"UR10": of("ur10"), "IRB 1410": irb1410(), "Panda": of("panda")}


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def compared(name: str, there: PosturePool, reading: str, count: int, which: str, arms: int) -> str:
    """One row: both errors, their ratio with its interval, and what was foretold."""
    chain, where = there.model.chain, there.free_q[:WHERE]
    best = chosen_stations(there, count, criterion(which, there.workspace.gamma), 2, np.random.default_rng(1))
    planned, drawn = np.empty(arms), np.empty(arms)
    for seed in range(arms):
        random = np.random.default_rng(seed).choice(len(there.q), count, replace=False)
        arm = Arm.made(chain, there.site, seed)
        planned[seed] = arm.error_after(best.q, reading, where)
        drawn[seed] = arm.error_after(there.q[random], reading, where)
    again = np.random.default_rng(0).integers(arms, size=(1000, arms))
    low, high = np.percentile([rms(planned[i]) / rms(drawn[i]) for i in again], [2.5, 97.5])
    foretold = np.median([a.model for a in random_accuracies(there, count, np.random.default_rng(2))])
    return (
        f"| {name} | {reading} | {count} | {which} | {1e3 * rms(planned):.4f} | {1e3 * best.accuracy.model:.4f} "
        f"| {1e3 * rms(drawn):.4f} | {1e3 * foretold:.4f} "
        f"| {rms(planned) / rms(drawn):.2f} ({low:.2f} to {high:.2f}) | {same_at_random(there, best.accuracy.model)} |"
    )


def same_at_random(there: PosturePool, model: float) -> str:
    """How many random stations are foretold to leave as little."""
    rng = np.random.default_rng(3)
    for count in range(10, len(there.q), 2):
        sets = [rng.choice(len(there.q), count, replace=False) for _ in range(9)]
        if np.median([there.workspace.left(there.rows.covariance(chosen)) for chosen in sets]) <= model:
            return str(count)
    return f"more than {len(there.q)}"


def updates(there: PosturePool) -> str:
    """Time of one exchange's look at all candidates, against determinants of the whole matrices."""
    good = criterion("d", there.workspace.gamma)
    H = np.eye(there.rows.J.shape[2]) + there.rows.information(np.arange(30))
    free = np.ones(len(there.rows), dtype=bool)

    def timed(work: object, runs: int = 7) -> float:
        assert callable(work)
        work()
        taken = []
        for _ in range(runs):
            start = time.perf_counter()
            work()
            taken.append(time.perf_counter() - start)
        return float(np.median(taken))

    def whole() -> np.ndarray:
        return np.asarray(good.value(H + there.rows.J.transpose(0, 2, 1) @ there.rows.J))

    j, value = best_candidate(there.rows, H, good, free)
    assert j == int(np.argmax(whole()))
    assert abs(value - whole()[j]) < 1e-9 * abs(value)
    ratio = timed(whole) / timed(lambda: best_candidate(there.rows, H, good, free))
    return f"{len(there.rows)} candidates: {ratio:.0f} times as fast as whole determinants, the same choice"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=24, help="displaced arms a row")
    parser.add_argument("--quick", action="store_true", help="the UR10 by points alone")
    chosen = parser.parse_args()
    columns = (
        "arm, readings, stations, criterion, planned mm, foretold, random mm, foretold, ratio, random for the same"
    )
    print(f"| {columns.replace(', ', ' | ')} |")
    print("|---" * 10 + "|", flush=True)
    for name, chain in robots().items():
        for reading in ("point", "pose"):
            there = survey(chain, hall(), np.random.default_rng(8), reading)
            least = min_stations(len(there.parameters), reading)
            for count in (least, int(1.5 * least), 3 * least):
                print(compared(name, there, reading, count, "accuracy", chosen.arms), flush=True)
            if name == "UR10" and reading == "point":
                for which in CRITERIA:
                    if which not in ("accuracy", "o1"):  # o1 is d
                        print(compared(name, there, reading, int(1.5 * least), which, chosen.arms), flush=True)
                fast = updates(there)
            if chosen.quick:
                print(f"\n{fast}")
                return 0
    print(f"\n{fast}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
