"""Fits beside what can be reached: recordings whose floor is known, calibrated, and what was left of them.

python bench/fits/geometry.py --only cube --seeds 4
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parent))
from from_truth import from_truth
from hard_cells import DISTANCE, KINDS, Fitted

STAGES = ("nominal", "geometric", "final")
MAX = 1.1  # times the floor


def fitted(cell: Fitted, seed: int, geometry_only: bool) -> dict[str, Any]:
    """What a calibration of this recording leaves [mm], how it judges it, and what it found besides geometry."""
    from modcal_core.calibration.cell import Cell
    from modcal_core.calibration.distances import Distance
    from modcal_core.loop import calibrate
    from modcal_core.preprocess import prepare
    from modcal_core.robots.urdf import read_chain

    chain = read_chain(cell.urdf, tip=cell.tip)
    samples = prepare(cell.recording, chain).samples
    known = Cell(tuple(Distance(pair, DISTANCE) for pair in cell.distances))
    exact = prepare(cell.exact, chain).samples
    begun = time.perf_counter()
    done = calibrate(samples, chain, np.random.default_rng(seed), known, look_for_effects=not geometry_only)
    left = {stage: 1e3 * float(np.sqrt(np.nanmean(done.report.errors[stage].position_norm ** 2))) for stage in STAGES}
    spent = time.perf_counter() - begun
    if not np.array_equal(exact.stamps, done.report.samples.stamps):
        raise SystemExit("samples with and without noise are not the same stations")
    reachable = from_truth(done, replace(exact, sockets=done.report.samples.sockets), known, cell.tool)
    moved = done.scored.model.T_tip_tool[:3, 3] - done.calibration.nominal.T_tip_tool[:3, 3]
    return {
        **left,
        "tool_moved_mm": 1e3 * float(np.linalg.norm(moved)),
        "distance_mm": max((1e3 * abs(d.residual) for d in done.report.distances), default=0.0),
        "status": done.report.judged.status,
        "rejected": done.report.rejected,
        "effects": [f"{e.family} {e.place}" for e in done.scored.model.effects],
        "values": len(done.scored.parameters),
        "train": len(done.report.sets.train),
        "from_truth": reachable.rms_mm,
        "cost_less_from_truth": reachable.less,
        "truth": reachable.truth_mm,
        "s": spent,
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
    print(f"{'recording':<28}{'floor':>8}" + "".join(f"{s:>11}" for s in STAGES) + "   ÷ floor ÷ truth  status")
    summary = []
    for kind in [k for k in KINDS if any(part in k for part in asked.only.split(","))]:
        rows = []
        for seed in range(asked.first, asked.first + asked.seeds):
            cell = KINDS[kind](np.random.default_rng([zlib.crc32(kind.encode()), seed]))
            rows.append({"kind": kind, "seed": seed, "floor": cell.floor_mm, **fitted(cell, seed, asked.geometry_only)})
            print(_line(rows[-1]), flush=True)
            if asked.json:
                with asked.json.open("a") as stream:
                    stream.write(json.dumps(rows[-1]) + "\n")
        summary.append(_together(kind, rows))
    print(HEAD + "\n".join(summary))


HEAD = (
    f"\n| recording | seeds | ÷ floor, median | worst | at most {MAX:g} | values / readings fitted | expected "
    "| ÷ truth on the same stations, median | worst | ÷ fit begun at the truth, worst |\n"
    + "| --- "
    + "| --: " * 9
    + "|\n"
)


def _line(row: dict[str, Any]) -> str:
    sizes = "".join(f"{row[stage]:11.3f}" for stage in STAGES)
    name = f"{row['kind']} {row['seed']}"
    return (
        f"{name:<28}{row['floor']:8.3f}{sizes}{row['final'] / row['floor']:9.2f}{row['final'] / row['truth']:8.2f}  "
        f"{row['status']:<12} tool {row['tool_moved_mm']:.0f} mm  from the truth {row['from_truth']:.4f} mm, "
        f"cost less by {row['cost_less_from_truth']:.1g}  {row['s']:.1f} s  {', '.join(row['effects'])}"
    )


def _together(kind: str, rows: list[dict[str, Any]]) -> str:
    """A row of the table: over the floor, over the truth on the same stations, and over a fit begun at the truth."""
    over, truth, begun = (np.array([row["final"] / row[k] for row in rows]) for k in ("floor", "truth", "from_truth"))
    values, readings = (round(float(np.mean([row[k] for row in rows]))) for k in ("values", "train"))
    return (
        f"| `{kind}` | {len(rows)} | {np.median(over):.2f} | {over.max():.2f} | {np.mean(over <= MAX):.0%} "
        f"| {values} / {readings} | {np.sqrt(1.0 + values / (3.0 * readings)):.2f} "
        f"| {np.nanmedian(truth):.2f} | {np.nanmax(truth):.2f} | {np.nanmax(begun):.3f} |"
    )


if __name__ == "__main__":
    main()
