"""Pulls at what jams, with a force sensor that says something wrong: what does the hand feel, and is it let go?

    make wrong-sensor              # BENCH_ARGS="--held-back" for the scenes kept for judging

Random doors and drawers in MuJoCo that jam on the way or are locked, pulled by the core's operation in this process
(tests/nodes/own_pull.py). What the sensor says departs from the truth in one of these ways, with its noise going on:

* frozen: from 2 mm or 2 mrad before the jam, as soon as more than 0, 3, 12 or 25 N are felt, it says what it said then;
* repeats: the same at 12 N, but to the last digit;
* stuck: from 3 or 12 N on, wherever that is;
* deaf, half: it says a fifth, or half, of what has been added since the first reading;
* unconnected: it says what it said at first;
* sound: nothing is wrong. What is free then must open, what jams must be let go.

Asked of each: the hand feels less than 60 N (1.2 times `max_force_n`), and less than 10 N when it has been let go.
Scenes of seeds below 100 may be looked at to improve impedance/lead_check.py; --held-back runs others.
Ends with exit code 1 where one fails. Writes a table, and with --out the runs as JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import conftest  # noqa: E402, F401 (finds the install tree)
import numpy as np  # noqa: E402
from nodes.own_pull import pull  # noqa: E402
from nodes.reported_efforts import KINDS, ReportedEfforts  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from modcal_core.geometry.so3 import Array  # noqa: E402
from modcal_core.robots.urdf import read_chain  # noqa: E402
from modcal_nodes.simulation.furniture import FREE, draw  # noqa: E402
from modcal_nodes.simulation.furniture_mjcf import Servo  # noqa: E402
from modcal_nodes.simulation.pulling import Pulling, effort_limits  # noqa: E402

URDF = (ROOT / "examples" / "robots" / "panda.urdf").read_text()
CHAIN = read_chain(URDF)
LOOKED_AT, HELD_BACK = 0, 100  # first seeds
LIMIT, LET_GO = 60.0, 10.0  # N
NEAR = 2e-3  # m or rad before the jam
NOISE = np.array([0.2] * 3 + [0.01] * 3)  # N, N m: that of the simulated sensor
DEAF = {"deaf": 0.2, "half": 0.5}
FAULTS = (
    "frozen 0", "frozen 3", "frozen 12", "frozen 25", "repeats 12", "stuck 3", "stuck 12", "deaf", "half",
    "unconnected", "sound",
)  # fmt: skip


class Sensor:
    """What the force sensor says of the wrench (6,) at its place, with one of the faults."""

    def __init__(self, fault: str, world: Pulling, rng: np.random.Generator) -> None:
        self.kind, _, newtons = fault.partition(" ")
        self.force = float(newtons or 0.0)
        self._world, self._rng = world, rng
        self._first: Array | None = None
        self._held: Array | None = None

    def __call__(self, w: Array) -> Array:
        if self._first is None:
            self._first = w
        if self.kind == "sound":
            return w
        if self.kind == "unconnected":
            return self._first + self._noise()
        if self.kind in DEAF:
            return self._first + DEAF[self.kind] * (w - self._first) + self._noise()
        if self._held is None and self._begins(w):
            self._held = w
        if self._held is None:
            return w
        return self._held if self.kind == "repeats" else self._held + self._noise()

    def _begins(self, w: Array) -> bool:
        assert self._first is not None
        near = self.kind == "stuck" or self._world.opened > self._world.scene.stop - NEAR
        return bool(near and np.linalg.norm(w[:3] - self._first[:3]) > self.force)

    def _noise(self) -> Array:
        return NOISE * self._rng.standard_normal(6)


@dataclass(frozen=True)
class Outcome:
    """A pull. stop: where it jams [rad or m], -1 nowhere. peak, left: force, largest and when it was over [N]."""

    seed: int
    kind: str
    grasp: str
    servo: float
    stop: float
    fault: str
    peak: float
    left: float
    opened: float
    said: str

    @property
    def good(self) -> bool:
        """Whether it went as it should."""
        return self.peak < LIMIT and self.left < LET_GO and (self.stop != FREE or self.said.startswith("open to"))


def run(
    seed: int,
    fault: str,
    servo: float,
    stated: float,
    late: float = 0.0,
    lead: float = 0.04,
    efforts: str = "",
    integral: float = 0.0,
    cascaded: bool = False,
) -> Outcome:
    """One pull in the scene of a seed. servo: stiffness of the joints [N m/rad]. stated: arm_stiffness_n_m [N/m].

    late: mean delay of messages [s]. lead: max_joint_lead_rad. efforts: that joint states report, of
    tests/nodes/reported_efforts.py. integral: time [s] in which the servos' integral part doubles a lead; 0: none.
    cascaded: whether that is in a loop of speed.
    """
    rng = np.random.default_rng([seed, 24])
    kind, grasp = ("door", "drawer")[seed % 2], ("weld", "ball")[seed // 2 % 2]
    if fault == "sound" and seed % 4 < 2:
        stop = FREE
    elif seed % 5 == 4 and not fault.startswith(("frozen", "repeats")):
        stop = 0.0
    else:
        stop = float(rng.uniform(0.1, 0.8) if kind == "door" else rng.uniform(0.05, 0.25))
    chosen = {"kind": kind, "grasp": grasp, "stop": stop}
    scene = draw(CHAIN, np.random.default_rng(seed), chosen)
    drives = Servo(effort_limits(URDF, CHAIN.names), servo, integral_s=integral, cascaded=cascaded)
    world = Pulling.of(URDF, CHAIN, scene, rng, drives)
    reports = ReportedEfforts(efforts, URDF, world, np.random.default_rng([seed, 25])) if efforts else None
    stiffness: dict[str, object] = {"arm_stiffness_n_m": stated, "max_joint_lead_rad": lead}
    done = pull(world, URDF, Sensor(fault, world, rng), late, reports, **stiffness)
    for _ in range(50):  # as the arm stands where it was sent last
        world.forget()
        world.advance(0.004)
    left = float(np.linalg.norm(world.peak()[:3]))
    return Outcome(seed, kind, grasp, servo, stop, fault, done.peak, left, done.opened, done.said)


def main() -> int:
    """Run it; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--held-back", action="store_true", help="scenes that were not looked at")
    parser.add_argument("--seed", type=int, default=None, help="of the first scene, instead of 0 or 100")
    parser.add_argument("--every", type=int, default=1, help="so many seeds from one scene to the next")
    parser.add_argument("--only", default="", help="faults that have this word in them")
    parser.add_argument("--verbose", action="store_true", help="a line of every pull, not only of bad ones")
    parser.add_argument("--servo", type=float, default=4000.0, help="stiffness of the joints [N m/rad]")
    parser.add_argument("--stated", type=float, default=100e3, help="arm_stiffness_n_m [N/m]")
    parser.add_argument("--lead", type=float, default=0.04, help="max_joint_lead_rad; 0.022 is true of these servos")
    parser.add_argument("--late", type=float, default=0.0, help="mean delay of messages, as on a busy machine [s]")
    parser.add_argument("--efforts", default="", choices=("", *KINDS), help="what joint states report as effort")
    parser.add_argument("--integral", type=float, default=0.0, help="time of the servos' integral part [s]")
    parser.add_argument("--cascaded", action="store_true", help="the integral part is in a loop of speed")
    parser.add_argument("--out", type=Path, default=None, help="a file for the runs, as JSON")
    chosen = parser.parse_args()
    console, runs = Console(), []
    first = (HELD_BACK if chosen.held_back else LOOKED_AT) if chosen.seed is None else chosen.seed
    faults = [fault for fault in FAULTS if chosen.only in fault]
    world = chosen.servo, chosen.stated, chosen.late, chosen.lead, chosen.efforts, chosen.integral, chosen.cascaded
    for seed in range(first, first + chosen.scenes * chosen.every, chosen.every):
        for fault in faults:
            one = run(seed, fault, *world)
            runs.append(one)
            if chosen.verbose or not one.good:
                said = f"{seed} {one.kind} {one.grasp} {fault}: {one.peak:.0f} N, {one.left:.0f} left; {one.said}"
                console.print(said, soft_wrap=True)
        if chosen.out is not None:
            chosen.out.write_text(json.dumps([asdict(one) for one in runs], indent=1) + "\n")
    console.print(_table(runs, faults))
    return int(not all(one.good for one in runs))


def _table(runs: list[Outcome], faults: list[str]) -> Table:
    table = Table(width=100, title=f"{len(runs)} pulls, servos of {runs[0].servo:g} N m/rad")
    for name in ("sensor", "pulls", "as it should be", "peak N, median", "largest", "left N, largest"):
        table.add_column(name, justify="left" if name == "sensor" else "right")
    number: Callable[[float], str] = lambda value: f"{value:.0f}"  # noqa: E731
    for fault in faults:
        of = [one for one in runs if one.fault == fault]
        peaks = [one.peak for one in of]
        good = sum(one.good for one in of)
        numbers = map(number, (float(np.median(peaks)), max(peaks), max(one.left for one in of)))
        table.add_row(fault, str(len(of)), str(good), *numbers)
    return table


if __name__ == "__main__":
    sys.exit(main())
