"""How few stations of a recorded grid give the error of the whole grid: chosen ones, and random ones beside them.

    python bench/measure/replay.py ur5 --first 8 --divisions 3 --chosen
    python bench/measure/replay.py ipa --chosen

Three tenths of the grid, in blocks, are never offered: the error is taken there. The whole is the rest, all of it
fitted; a share is of that rest. A division is a split of the grid. The whole is fitted twice, with small curves behind
its effects and without, and shares are given over both.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modcal_core.calibration.score import errors
from modcal_core.measurements.samples import Samples
from modcal_core.measuring import refit as refitting
from modcal_core.measuring.advice import Advisor
from modcal_core.measuring.goal import Goal
from modcal_core.measuring.pool import of_recording
from modcal_core.measuring.refit import refit
from modcal_core.measuring.session import POINT, POSE, Session
from modcal_core.robot import Robot
from modcal_nodes.measuring.measurers import Replay, one_a_station

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
HELD = 0.3
LARGE = 3000  # stations offered, of which a refit takes minutes
WITHIN = 1.1  # of the whole grid's error


@dataclass(frozen=True)
class Grid:
    """name; robot; samples, one a station; block: stations that are held out together; limit: share that is claimed."""

    name: str
    robot: Robot
    samples: Samples
    block: int
    limit: float


def ur5() -> Grid:
    """The UR5 of serial_robots: 1 000 points of a laser tracker."""
    with (DATA / "serial_robots" / "ur5_grid.csv").open() as stream:
        table = list(csv.DictReader(stream))

    def columns(*names: str) -> np.ndarray:
        return np.array([[float(row[name]) for name in names] for row in table])

    q = np.radians(columns(*(f"joint_{k}" for k in range(1, 7))))
    reached = 1e-3 * (columns("x_t", "y_t", "z_t") - columns("x_dif", "y_dif", "z_dif"))
    robot = Robot.from_table(ROOT / "examples" / "robots" / "ur5.yaml")
    samples = Samples.from_arrays(q, points=reached).of_joints(robot.names)
    return Grid("UR5 grid", robot, samples, 5, 0.35)


def ipa() -> Grid:
    """Series A of the IPA's UR10: 11 911 poses of a laser tracker."""
    from modcal_nodes.cli.main import run
    from modcal_nodes.cli.robot import described
    from modcal_nodes.io.recorded import opened

    with tempfile.TemporaryDirectory() as scratch:
        bag = Path(scratch) / "a"
        mapping = ROOT / "examples" / "import" / "ipa_ur10_series_a.yaml"
        if run(["import", str(mapping), "--data", str(DATA), "--out", str(bag)]):
            sys.exit("series A cannot be imported")
        opened_bag = opened(bag)
        robot = described(opened_bag.recording, None, None, None, None)
        samples = one_a_station(opened_bag.samples(robot, 0.5))
    return Grid("IPA UR10, series A", robot, samples, 200, 0.15)


def divided(grid: Grid, seed: int) -> tuple[Samples, Samples]:
    """The stations that are offered, and those that score."""
    block = np.arange(len(grid.samples)) // grid.block
    rng = np.random.default_rng(seed)
    held = np.isin(block, rng.permutation(block[-1] + 1)[: round(HELD * (block[-1] + 1))])
    return grid.samples.select(~held), grid.samples.select(held)


def rms(model: object, samples: Samples) -> float:
    """RMS error [m]."""
    return float(np.sqrt(np.mean(errors(model, samples).position_norm ** 2)))  # type: ignore[arg-type]


@dataclass(frozen=True)
class Whole:
    """Errors [m] that all stations offered leave: by the model as it is now, and by the one without small curves."""

    now: float
    searched: float

    @classmethod
    def of(cls, grid: Grid, offered: Samples, scored: Samples, seed: int) -> Whole:
        """Fitted twice, and printed."""
        began, left = time.process_time(), []
        curves = refitting.with_residual_curves
        for keep in (True, False):
            refitting.with_residual_curves = curves if keep else lambda fit, *_: fit  # type: ignore[assignment]
            found = refit(offered, grid.robot.mechanism, seed, None, grid.robot.inertias)
            left.append(rms(found.calibration.calibrated, scored))
        refitting.with_residual_curves = curves
        labels = [e.label for e in found.calibration.calibrated.effects]
        print(
            f"{grid.name}, division {seed}: {len(offered)} of {len(grid.samples)} stations leave "
            f"{1e3 * left[0]:.4f} mm at the other {len(scored)}, without small curves {1e3 * left[1]:.4f} mm; "
            f"{time.process_time() - began:.0f} s; {labels}",
            flush=True,
        )
        return cls(*left)


def replayed(grid: Grid, planned: bool, whole: Whole, seed: int) -> None:
    """Print how the error falls with the share of stations."""
    robot = grid.robot
    offered, scored = divided(grid, seed)
    how = "chosen" if planned else "random"
    measurer = Replay(offered)
    pool = of_recording(offered.q, np.random.default_rng(seed))
    goal = Goal(None, stations=max(int(grid.limit * len(offered)), 20))
    session = Session(robot.names, POSE if measurer.kind == POSE else POINT)
    reached: int | None = None
    while True:
        # half as many again each time, of a large recording twice as many, for time: what is asked is how few do, not
        # how few one could stop at
        batch = max(12, len(session.rows()) // (1 if len(offered) > LARGE else 2))
        advisor = Advisor(robot.mechanism, pool, goal, seed, None, robot.inertias, planned, batch)
        advice = advisor.advise(session)
        session = advice.session
        if advice.refitted is not None:
            n = len(session.rows())
            error = rms(advice.refitted.calibration.calibrated, scored)
            reached = (reached or n) if error <= WITHIN * whole.now else None
            print(
                f"  {how} {n:5d} ({n / len(offered):.1%}): {1e3 * error:.4f} mm, {error / whole.now:.3f} of the "
                f"whole's, {error / whole.searched:.3f} without small curves; {len(advice.status.effects)} effects",
                flush=True,
            )
        if advice.outcome is not None:
            print(f"  {advice.outcome.sentence}")
            break
        for number in session.pending:
            session = session.with_station(number, measurer.measure(session.stations[number]))
    share = "not reached" if reached is None else f"with {reached} stations, {reached / len(offered):.1%}"
    print(f"{grid.name}, division {seed}, {how}: within {WITHIN - 1:.0%} and staying there {share}", flush=True)


def main(arguments: list[str] | None = None) -> None:
    """The grids and divisions that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grids", nargs="*", choices=("ur5", "ipa"), default=["ur5", "ipa"])
    parser.add_argument("--divisions", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="the first division's seed")
    parser.add_argument("--chosen", action="store_true", help="without the random ones beside them")
    asked = parser.parse_args(arguments)
    if not DATA.is_dir():
        sys.exit("no real recordings: ../shared/data is not beside this checkout")
    for make in (ur5, ipa):
        if make.__name__ not in asked.grids:
            continue
        grid = make()
        for seed in range(asked.first, asked.first + asked.divisions):
            whole = Whole.of(grid, *divided(grid, seed), seed)
            for planned in (True,) if asked.chosen else (True, False):
                replayed(grid, planned, whole, seed)


if __name__ == "__main__":
    main()
