"""How near the true tool comes to 50 wishes, before and after calibration, and how near it could come at all.

    python bench/closed_loop.py [--stations 150] [--poses 50] [--visits 4] [--seed 21]

A simulated cell, whose arm bends and whose elbow has a gear error, is recorded and calibrated; the corrector commands.
See tests/nodes/closed_loop.py. Exits with 1 where the tool misses by more than 1.3 times what the arm does not repeat.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import conftest  # noqa: E402, F401 (finds the install tree)
from nodes.closed_loop import close_the_loop  # noqa: E402

LIMIT = 1.3


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stations", type=int, default=150)
    parser.add_argument("--poses", type=int, default=50)
    parser.add_argument("--visits", type=int, default=4)
    parser.add_argument("--seed", type=int, default=21)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        outcome = close_the_loop(Path(folder), chosen.stations, chosen.poses, chosen.visits, chosen.seed)
    print(outcome.table())
    return int(outcome.corrected.rms_mm > LIMIT * outcome.floor.rms_mm or outcome.refused > 0)


if __name__ == "__main__":
    sys.exit(main())
