"""What measuring on order is worth, in cells of MuJoCo and by replay of real grids.

    make measure                                  # everything
    make measure BENCH_ARGS="goal --cells 6"      # one part: bound, goal, impossible, ties, replay

bound: how few stations could do at all, chosen and at random, by their information matrices.
goal: stations until 0.1 mm are proven, chosen and at random under the same rule, proof included; whether what was
promised is true. impossible: goals below what the arm repeats; whether they are refused, and how good the arm then is
beside 400 planned stations. ties: pairs of explanations that one recording leaves open. replay: how many stations of a
recorded grid give the error of the whole grid.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import json  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).parent))

from cells import Bench, run  # noqa: E402

from modcal_core.measuring.goal import Goal  # noqa: E402

ARMS = ("ur10", "panda", "xarm7")
# effects of the arm that a frozen model can hold; what jumps or drifts while it is measured has no error to promise
FAULTS = (
    "none", "compliance", "compliance_all", "gear_harmonic", "encoder_eccentricity", "bearing_tilt", "wrist_coupling",
    "gear_ratio", "axis_wobble", "hose_drag", "approach_backlash", "hardening_spring", "gear_harmonic+compliance",
)  # fmt: skip
GOAL = 1e-4  # m
PLANNED = 400  # stations that a refusal is compared with


def cells(count: int, first: int) -> list[tuple[str, str, str, int]]:
    """(arm, fault, kind of reading, seed) of so many cells; first: seed of the first."""
    rng = np.random.default_rng(first - 74)
    order = [(a, f) for f in FAULTS for a in ARMS]
    picked = [order[i] for i in rng.permutation(len(order))]
    return [(*picked[k % len(order)], ("point", "pose")[k % 2], first + k) for k in range(count)]


def goal(count: int, noise: float, first: int) -> None:
    """Stations until the goal is proven, chosen and at random."""
    rows = []
    for robot, fault, kind, seed in cells(count, first):
        began = time.process_time()
        bench = Bench(robot, fault, seed, kind, noise)
        row: dict[str, object] = {"cell": f"{robot} {fault} {kind} {seed}"}
        for name, planned in (("planned", True), ("random", False)):
            advice = run(bench, Goal(GOAL), planned)
            assert advice.outcome is not None
            assert advice.refitted is not None
            s = advice.status
            row[name] = {
                "ending": advice.outcome.ending, "stations": s.measured, "fit": s.fitted, "proof": s.proving,
                "true_mm": 1e3 * bench.error(advice.refitted.calibration),
            }  # fmt: skip
        row["s"] = round(time.process_time() - began, 1)
        rows.append(row)
        print(json.dumps(row), flush=True)
    both = [r for r in rows if r["planned"]["ending"] == r["random"]["ending"] == "proven"]  # type: ignore[index]
    ratio = [r["planned"]["stations"] / r["random"]["stations"] for r in both]  # type: ignore[index]
    proven = [r[n] for r in rows for n in ("planned", "random") if r[n]["ending"] == "proven"]  # type: ignore[index]
    kept = [p["true_mm"] <= 1e3 * GOAL for p in proven]  # type: ignore[index]
    print(
        f"goal {1e3 * GOAL:g} mm: {len(rows)} cells, both proven in {len(both)}; stations planned / random: "
        f"median {np.median(ratio):.2f} ({np.percentile(ratio, 25):.2f} to {np.percentile(ratio, 75):.2f}); "
        f"medians {np.median([r['planned']['stations'] for r in both]):.0f} and "  # type: ignore[index]
        f"{np.median([r['random']['stations'] for r in both]):.0f}; promise kept in {sum(kept)} of {len(kept)}"  # type: ignore[index]
    )


def impossible(count: int, first: int) -> None:
    """Goals of six tenths of what the arm repeats."""
    from best import best_error

    refused, ratios = 0, []
    for robot, fault, kind, seed in cells(count, first):
        began = time.process_time()
        bench = Bench(robot, fault, seed, kind, repeats=4e-5)
        floor = bench.floor()
        advice = run(bench, Goal(0.6 * floor), True)
        assert advice.outcome is not None
        assert advice.refitted is not None
        error = bench.error(advice.refitted.calibration)
        best = best_error(bench, PLANNED)
        refused += advice.outcome.ending == "no_station_helps"
        ratios.append(error / best)
        row = {
            "cell": f"{robot} {fault} {kind} {seed}", "ending": advice.outcome.ending,
            "stations": advice.status.measured, "floor_mm": 1e3 * floor, "true_mm": 1e3 * error, "best_mm": 1e3 * best,
            "said": advice.outcome.sentence, "s": round(time.process_time() - began, 1),
        }  # fmt: skip
        print(json.dumps(row), flush=True)
    print(
        f"impossible: {refused} of {count} refused; error over that of {PLANNED} planned stations: median "
        f"{np.median(ratios):.3f}, {np.mean(np.array(ratios) <= 1.1):.0%} within 1.1, largest {max(ratios):.2f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", nargs="?", choices=["bound", "goal", "impossible", "ties", "replay"])
    parser.add_argument("--cells", type=int, default=30)
    parser.add_argument("--noise", type=float, default=1.0, help="times the tracker's noise of bench/undeclared")
    parser.add_argument("--first", type=int, default=100, help="seed of the first cell: another one makes fresh cells")
    chosen = parser.parse_args()
    if chosen.part in (None, "bound"):
        from bound import bound

        bound(GOAL, chosen.noise)
    if chosen.part in (None, "goal"):
        goal(chosen.cells, chosen.noise, chosen.first)
    if chosen.part in (None, "impossible"):
        impossible(chosen.cells, chosen.first)
    if chosen.part in (None, "ties"):
        from ties import ties

        ties(chosen.cells)
    if chosen.part in (None, "replay"):
        import replay

        sys.argv[1:] = []
        replay.main([])
    return 0


if __name__ == "__main__":
    sys.exit(main())
