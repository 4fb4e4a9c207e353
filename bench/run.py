"""Timings, as ratios against others doing the same work in the same run, on one thread.

    make bench                                            # all of it
    make bench BENCH_ARGS="--only calibration --most 10000"
    make bench BENCH_ARGS="--million --out /tmp/speed"    # growth to a million; speed.md and speed.json

Absolute times belong to the machine; the ratios and the growth with N are what to compare. Each pair is checked to
arrive at the same result. See docs/speed.md.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

BENCH = Path(__file__).resolve().parent
sys.path[0] = str(BENCH.parent / "tests")  # in place of this folder, where "articulation" would be another file
import conftest  # noqa: E402, F401 (finds the install tree)

sys.path.append(str(BENCH / "speed"))
import fits  # noqa: E402
import following  # noqa: E402
import joints  # noqa: E402
import kinematics  # noqa: E402
import report  # noqa: E402
import search  # noqa: E402
import startup  # noqa: E402
import whole  # noqa: E402
from timing import Row, machine_scale  # noqa: E402

import bags  # noqa: E402


def main() -> None:
    """Run everything that was asked for, and print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=int, default=100_000, help="Samples of the largest fit of the table.")
    parser.add_argument("--million", action="store_true", help="Fit a million points as well.")
    parser.add_argument("--before", type=Path, default=None, help="Checkout whose whole runs take turns with these.")
    parser.add_argument("--out", type=Path, default=None, help="Folder of speed.md and speed.json.")
    groups: dict[str, Callable[[], Iterable[Row]]] = {
        "calibration": lambda: fits.rows(scale, chosen.most),
        "kinematics": kinematics.rows,
        "online": following.rows,
        "diagnosis": following.diagnosis,
        "articulation": joints.rows,
        "bags": bags.rows,
        "synthesis": search.rows,
        "start": startup.rows,
        "whole": lambda: whole.rows(scale, chosen.before),
    }
    parser.add_argument("--only", choices=list(groups), action="append", help="Only this group; may be repeated.")
    chosen = parser.parse_args()
    scale = machine_scale()
    rows: list[Row] = []
    for name, group in groups.items():
        if chosen.only and name not in chosen.only:
            continue
        print(f"{name} ...", file=sys.stderr, flush=True)
        rows += group()
    if chosen.million:
        rows += fits.million()
    report.show(rows, scale)
    if chosen.out is not None:
        report.write(rows, scale, chosen.out)


if __name__ == "__main__":
    main()
