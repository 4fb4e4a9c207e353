"""How near the true tool comes to 50 wishes, before and after calibration, and how near it could come at all.

    make bench NAME=closed_loop ARGS="--stations 150 --poses 50 --visits 4 --seed 21"

A simulated cell, whose arm bends and whose elbow has a gear error, is recorded and calibrated; the corrector commands.
See tests/nodes/closed_loop.py. Exits with 1 where the tool misses by more than 1.3 times what the arm does not repeat.
"""

from __future__ import annotations

import harness

# isort: split
import sys

import conftest  # noqa: F401 (finds the install tree)
from nodes.closed_loop import close_the_loop

LIMIT = 1.3


def main() -> int:
    given = harness.options(__doc__, seeds=0, stations=150, poses=50, visits=4, seed=21)
    with harness.scratch() as folder:
        outcome = close_the_loop(folder, given.stations, given.poses, given.visits, given.seed)
    harness.say(outcome.table())
    near = outcome.corrected.rms_mm <= LIMIT * outcome.floor.rms_mm
    return harness.met((f"{LIMIT} times the floor", near), ("every wish reached", outcome.refused == 0))


if __name__ == "__main__":
    sys.exit(main())
