"""A table of how much each scenario's faults move the tool, before and after the best displacement of every body."""

from __future__ import annotations

import argparse
from itertools import cycle

import numpy as np
from arm import ROBOTS
from recordings import COURSE, STATIONS, Cell, course, plant, point_to_point, sizes
from rich.console import Console
from rich.table import Table
from scenarios import MOVING, SCENARIOS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=12)
    seeds = parser.parse_args().seeds
    table = Table("scenario", "fault", "mm", "mrad", "mm left by geometry", "mrad left", "÷ noise, least to most")
    for name, makers in SCENARIOS.items():
        if "+" in name or not makers:
            continue
        found = []
        for seed, robot in zip(range(seeds), cycle(ROBOTS), strict=False):
            rng = np.random.default_rng([seed, 1])
            cell = Cell(robot, rng)
            moving = makers[0].__name__ in MOVING
            plan = course(cell, rng, COURSE, 0.0) if moving else point_to_point(cell.arm, rng, STATIONS, 0.0)
            faults = plant(cell, makers, rng, float(plan.t[-1]))
            found += sizes(cell, plan, faults)
        keys = ("mm", "mrad", "visible_mm", "visible_mrad")
        middle = [float(np.median([getattr(s, key) for s in found])) for key in keys]
        over = sorted(s.over_noise for s in found)
        table.add_row(name, faults[0].size, *(f"{v:.3f}" for v in middle), f"{over[0]:.1f} to {over[-1]:.1f}")
    Console().print(table)


if __name__ == "__main__":
    main()
