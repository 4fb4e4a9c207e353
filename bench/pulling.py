"""Random doors and drawers, pulled open: how hard the hand pulls at the handle, and how far they come.

    python bench/pulling.py [--scenes 50] [--seed 0] [--out FOLDER]

An arm in MuJoCo, see modcal_nodes/simulation/furniture.py. Prints a table.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import conftest  # noqa: E402, F401 (finds the install tree)
import numpy as np  # noqa: E402
from nodes.plain_pulls import Pull, Way, learnt_wrong, pull, straight  # noqa: E402

from modcal_core.robots.urdf import read_chain  # noqa: E402
from modcal_nodes.simulation.furniture import Furniture, draw  # noqa: E402
from modcal_nodes.simulation.pulling import Pulling  # noqa: E402

URDF = (ROOT / "examples" / "robots" / "panda.urdf").read_text()
CHAIN = read_chain(URDF)
PLAIN: dict[str, tuple[Callable[[Furniture], Way], bool]] = {
    "stiff, straight": (straight, False),
    "admittance, straight": (straight, True),
    "stiff, learnt wrong": (learnt_wrong, False),
    "admittance, learnt wrong": (learnt_wrong, True),
}


def scene(seed: int) -> Furniture:
    """The scene of a seed: a door or a drawer."""
    return draw(CHAIN, np.random.default_rng(seed))


def row(name: str, pulls: list[Pull]) -> str:
    peak, mean = np.array([p.peak for p in pulls]), np.array([p.mean for p in pulls])
    share = np.array([p.opened / p.goal for p in pulls])
    return (
        f"| {name} | {np.median(peak):.1f} | {peak.max():.1f} | {np.median(mean):.1f} | {mean.max():.1f} "
        f"| {100.0 * np.median(share):.0f} % | {sum(p.done for p in pulls)} of {len(pulls)} |"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    scenes = {seed: scene(seed) for seed in range(chosen.seed, chosen.seed + chosen.scenes)}
    print(
        "| | peak N | largest | mean N | largest | opened | to the goal |\n| --- | --- | --- | --- | --- | --- | --- |"
    )
    for name, (way, compliant) in PLAIN.items():
        pulls = [
            pull(Pulling.of(URDF, CHAIN, s, np.random.default_rng(seed)), way(s), compliant)
            for seed, s in scenes.items()
        ]
        print(row(name, pulls), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
