"""Fits beside what can be reached: recordings whose floor is known, calibrated, and what was left of them.

python bench/fits/geometry.py --only cube --seeds 4
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import zlib
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parent))
from hard_cells import DISTANCE, KINDS, Fitted

STAGES = ("nominal", "geometric", "final")
MOST = 1.1  # times the floor


def fitted(cell: Fitted, seed: int, geometry_only: bool) -> dict[str, object]:
    """What a calibration of this recording leaves [mm], how it judges it, and what it found besides geometry."""
    from modcal_core.calibration.cell import Cell
    from modcal_core.calibration.distances import Distance
    from modcal_core.loop import calibrate
    from modcal_core.preprocess import prepare
    from modcal_core.robots.urdf import read_chain

    chain = read_chain(cell.urdf, tip=cell.tip)
    samples = prepare(cell.recording, chain).samples
    known = Cell(tuple(Distance(pair, DISTANCE) for pair in cell.distances))
    begun = time.perf_counter()
    done = calibrate(samples, chain, np.random.default_rng(seed), known, look_for_effects=not geometry_only)
    left = {stage: 1e3 * float(np.sqrt(np.nanmean(done.report.errors[stage].position_norm ** 2))) for stage in STAGES}
    moved = done.scored.model.T_tip_tool[:3, 3] - done.calibration.nominal.T_tip_tool[:3, 3]
    return {
        **left,
        "tool_moved_mm": 1e3 * float(np.linalg.norm(moved)),
        "distance_mm": max((1e3 * abs(d.residual) for d in done.report.distances), default=0.0),
        "status": done.report.judged.status,
        "rejected": done.report.rejected,
        "effects": [f"{e.family} {e.place}" for e in done.scored.model.effects],
        "s": time.perf_counter() - begun,
    }


def main() -> None:
    """Print a row for each recording, then one for each kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="kinds whose name holds one of these, comma between")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=100, help="first seed")
    parser.add_argument("--geometry-only", action="store_true", help="look for no effects")
    parser.add_argument("--json", type=Path, help="a line for each recording goes here")
    asked = parser.parse_args()
    print(f"{'recording':<28}{'floor':>8}" + "".join(f"{s:>11}" for s in STAGES) + "   ÷ floor  status")
    summary = []
    for kind in [k for k in KINDS if any(part in k for part in asked.only.split(","))]:
        ratios = []
        for seed in range(asked.first, asked.first + asked.seeds):
            cell = KINDS[kind](np.random.default_rng([zlib.crc32(kind.encode()), seed]))
            row = fitted(cell, seed, asked.geometry_only)
            ratio = float(row["final"]) / cell.floor_mm  # type: ignore[arg-type]
            ratios.append(ratio)
            sizes = "".join(f"{row[stage]:11.3f}" for stage in STAGES)
            more = (
                f"{row['status']:<12} tool {row['tool_moved_mm']:.0f} mm  {row['s']:.1f} s  {', '.join(row['effects'])}"  # type: ignore[arg-type]
            )
            print(f"{kind} {seed:<{27 - len(kind)}}{cell.floor_mm:8.3f}{sizes}{ratio:9.2f}  {more}", flush=True)
            if asked.json:
                with asked.json.open("a") as stream:
                    stream.write(json.dumps({"kind": kind, "seed": seed, "floor": cell.floor_mm, **row}) + "\n")
        inside = float(np.mean(np.array(ratios) <= MOST))
        summary.append((kind, len(ratios), float(np.median(ratios)), max(ratios), inside))
    print(
        f"\n| {'recording':<24} | seeds | ÷ floor, median | worst | at most {MOST:g} |\n| --- | --: | --: | --: | --: |"
    )
    for kind, n, median, worst, inside in summary:
        print(f"| {kind:<24} | {n} | {median:.2f} | {worst:.2f} | {inside:.0%} |")


if __name__ == "__main__":
    main()
