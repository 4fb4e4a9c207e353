"""Cells to measure in: an arm of MuJoCo with planted faults, and who measures one station after the other there.

The truth is that of ``bench/undeclared``: another engine, bodies displaced in all directions, effects that are not
written as modcal writes them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from fault import Fault, Stations
from recordings import BEGIN, NOISE_MM, NOISE_MRAD, Cell, plant
from scenarios import SCENARIOS
from scipy.spatial.transform import Rotation

from modcal_core.calibration.noise import errors
from modcal_core.calibration.store import Calibration
from modcal_core.measurements.samples import Samples
from modcal_core.measuring.advice import Advice, Advisor
from modcal_core.measuring.choose import Pool, of_robot
from modcal_core.measuring.proof import Goal
from modcal_core.measuring.refit import Refit, refit
from modcal_core.measuring.session import FRAME, Session, Station
from modcal_core.planning.site import Noise, Site
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import Inertias, read_inertias

Array = np.ndarray
EACH = 8.0  # s from one station to the next
REPEATS = 1e-5  # rad, per joint
TRUTH = 400  # random postures at which the error is taken


@dataclass
class Bench:
    """One cell. kind: of the readings. noise: times that of bench/undeclared. repeats: [rad] per joint."""

    robot: str
    scenario: str
    seed: int
    kind: str = "point"
    noise: float = 1.0
    repeats: float = REPEATS
    now: float = 0.0
    last: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, 26])
        self.cell = Cell(self.robot, rng)
        self.faults: tuple[Fault, ...] = plant(self.cell, SCENARIOS[self.scenario], rng, 600.0)
        self.chain: Chain = read_chain(self.cell.arm.urdf, None, self.cell.arm.tip)
        self.inertias: Inertias | None = read_inertias(self.cell.arm.urdf, self.chain)
        ranges = zip(self.cell.arm.names, *self.cell.arm.range, strict=True)
        self.site = Site(limits={n: (float(a), float(b)) for n, a, b in ranges}, noise=Noise(position=2e-5))
        self.pool: Pool = of_robot(self.chain, self.site, self.kind, np.random.default_rng(self.seed))
        self.begin(0)

    def begin(self, seed: int) -> None:
        """Another measurement in the same cell, with noise of its own."""
        self._rng = np.random.default_rng([self.seed, 27, seed])
        self.now, self.last = 0.0, np.zeros(self.chain.n)

    def measure(self, station: Station) -> Station:
        """Go to a station, from the side that is asked for, and read."""
        self.now += EACH
        way = np.sign(station.asked - self.last)
        if station.approach is not None:
            way = np.where(station.approach != 0.0, station.approach, way)
        self.last = station.asked
        told = Stations(station.asked[None], np.array([self.now]), way[None])
        reached = replace(told, q=told.q + self._rng.normal(0.0, self.repeats, told.q.shape))
        poses = self.cell.poses(reached, self.faults)
        reading = poses.p[0] + self._rng.normal(0.0, self.noise * 1e-3 * NOISE_MM, 3)
        if self.kind == "pose":
            turned = poses.R[0] * Rotation.from_rotvec(self._rng.normal(0.0, self.noise * 1e-3 * NOISE_MRAD, 3))
            reading = np.r_[reading, turned.as_quat()]
        return station.measured(reading, stamp=BEGIN + self.now, approach=way)

    def done(self, session: Session) -> Session:
        """The session with its pending stations measured."""
        for number in session.pending:
            session = session.with_station(number, self.measure(session.stations[number]))
        return session

    def refit(self, session: Session) -> Refit:
        """The model from everything measured."""
        return refit(session.samples(session.fitted), self.chain, 0, None, self.inertias)

    def run(self, goal: Goal, planned: bool) -> Advice:
        """A measurement from beginning to end."""
        self.begin(0)
        advisor = Advisor(self.chain, self.pool, goal, 0, None, self.inertias, planned)
        session = Session(self.chain.names, self.kind)
        while (advice := advisor.advise(session, self.now)).outcome is None:
            session = self.done(advice.session)
        return advice

    def _at_random(self, seed: int) -> tuple[np.random.Generator, Array, Array]:
        """Random allowed postures and the side from which each is reached."""
        rng = np.random.default_rng([self.seed, seed])
        q = self.pool.q[self.pool.order[-TRUTH:]]
        return rng, q, rng.choice([-1.0, 1.0], q.shape)

    def floor(self) -> float:
        """RMS over space [m] of what the arm does not repeat at random allowed postures, as its truth has it."""
        rng, q, way = self._at_random(29)
        off = (np.zeros_like(q), rng.normal(0.0, self.repeats, q.shape))
        p = [self.cell.poses(Stations(q + o, np.zeros(len(q)), way), self.faults).p for o in off]
        return float(np.sqrt(np.mean(np.sum((p[1] - p[0]) ** 2, axis=1))))

    def error(self, calibration: Calibration) -> float:
        """RMS [m] of the distance between where the model has the tool and where it is, at random allowed postures.

        What the arm does not repeat is part of it; the instrument's noise never is.
        """
        rng, q, way = self._at_random(28)
        now = np.full(len(q), self.now)
        off = rng.normal(0.0, self.repeats, q.shape)
        exact = self.cell.poses(Stations(q + off, now, way), self.faults)
        samples = as_samples(self.chain.names, q, exact.p, way, self.now)
        return float(np.sqrt(np.mean(errors(calibration.calibrated, samples).position_norm ** 2)))


def as_samples(names: tuple[str, ...], q: Array, p: Array, way: Array, now: float) -> Samples:
    """Points p (N, 3) read at postures q (N, n), all of them now."""
    samples = Samples.from_arrays(q, points=p, names=names)
    return replace(samples, frames=(FRAME,), approach=way, stamps=np.full(len(q), BEGIN + now))
