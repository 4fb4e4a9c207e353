"""Timings as ratios against others doing the same work in the same run, on one thread.

    make bench NAME=speed                                        # all of it
    make bench NAME=speed ARGS="--only calibration --most 10000"
    make bench NAME=speed ARGS="--million"                       # growth to a million

Absolute times belong to the machine; the ratios and the growth with N are what to compare. Each pair is checked to
arrive at the same result. Others are installed into .venv-bench first. See docs/speed.md.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
import conftest  # noqa: F401 (finds the install tree)
import fits
import parts
import peers
import whole
from timing import Row, growth, machine_scale

HEADS = ("work", "modcal, ms", "other", "other, ms", "ratio", "remark")
PARTS = (parts.kinematics, parts.online, parts.diagnosis, parts.articulation, parts.bags, parts.synthesis, parts.start)


def main() -> None:
    """Run everything that was asked for, and print one table."""
    groups: dict[str, Callable[[], Iterable[Row]]] = {
        "calibration": lambda: fits.rows(scale, given.most),
        **{part.__name__: part for part in PARTS},
        "whole": lambda: whole.rows(scale),
    }
    made = harness.parser(__doc__, seeds=0, names=groups)
    made.add_argument("--most", type=int, default=100_000, help="samples of the largest fit of the table")
    made.add_argument("--million", action="store_true", help="fit a million points as well")
    given = harness.parsed(made)
    peers.install()
    scale, rows = machine_scale(), []
    for name in given.names:
        print(f"{name} ...", file=sys.stderr, flush=True)
        rows += groups[name]()
    rows += fits.million() if given.million else []
    harness.table("", HEADS, [row.cells() for row in rows])
    harness.say(*(f"{work}: grows with N to the {exponent:.2f}" for work, exponent in growth(rows).items()))
    harness.say(f"this machine takes {scale:.2f} times as long as that of the published figures")


if __name__ == "__main__":
    main()
