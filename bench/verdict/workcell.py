"""A cell whose truth is known: postures visited, some of them twice, and what an instrument reads of them.

The arm is that of bench/undeclared: MuJoCo's kinematics and statics of a URDF with displaced bodies. Nothing comes from
modcal but the writing of bags.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).resolve().parents[1] / "undeclared"))
from fault import Deviation, Fault, Stations
from recordings import Cell

from modcal_core.measurements.recording import POINT, POSE, JointTrack, ReadingTrack, Recording, SignalTrack
from modcal_msgs_py.recording_write import write_recording

Array = np.ndarray
Bend = Callable[[Any, Stations, Deviation], None]
BEGIN = 1.7e9  # s
PERIOD = 4.0  # s from station to station
NOISE_MM, NOISE_MRAD, REPEAT = 0.02, 0.02, 1e-5  # per axis; per joint [rad]
RETURNS = 6


@dataclass(frozen=True)
class Session:
    """One recording as arrays, a row a station.

    q: what the joints report (N, n). p [m], R: what the tracker reads. floor_mm: RMS of what no model can predict.
    again: whether a station is the second visit of a posture (N,). more: joints besides the arm's, by name (N,).
    values: rows that are written in place of p and R. stated: RMS of what the arm does not repeat and of what the
    instrument adds, (mm, deg, mm, deg). stream: the rate [Hz] of the readings while the arm stands at each station;
    0: one reading a station, with the stamp of its joint state. came: the side from which each joint came (N, n).
    spoken: what is recorded in place of one reading a station. epoch: the stamp of t = 0 [s].
    """

    names: tuple[str, ...]
    urdf: str
    t: Array
    q: Array
    p: Array
    R: Rotation
    floor_mm: float
    again: Array
    kind: str = POSE
    effort: Array | None = None
    more: dict[str, Array] = field(default_factory=dict)
    signals: tuple[SignalTrack, ...] = ()
    values: Array | None = None
    frame: str = "tracker"
    stated: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    stream: float = 0.0
    came: Array | None = None
    spoken: Callable[[Session], Recording] | None = None
    epoch: float = BEGIN

    def __len__(self) -> int:
        return len(self.t)

    def only(self, rows: Array) -> Session:
        """These stations alone."""
        columns = ("t", "q", "p", "R", "again", "came", "effort", "values")
        kept = {name: None if (column := getattr(self, name)) is None else column[rows] for name in columns}
        return replace(self, more={name: column[rows] for name, column in self.more.items()}, **kept)

    def raw(self) -> Array:
        """What a topic would hold: x y z, for poses with qx qy qz qw after it."""
        if self.values is not None:
            return self.values
        return self.p if self.kind == POINT else np.concatenate([self.p, self.R.as_quat()], axis=1)

    def recording(self) -> Recording:
        """The session as modcal's own arrays, to be written."""
        if self.spoken is not None or self.stream:
            return self.spoken(self) if self.spoken is not None else self._streamed()
        effort = np.full((len(self), len(self.names) + len(self.more)), np.nan)
        if self.effort is not None:
            effort[:, : len(self.names)], effort[:, len(self.names) :] = self.effort, 0.0
        stamps = self.epoch + self.t
        joints = joint_track((*self.names, *self.more), stamps, np.column_stack([self.q, *self.more.values()]), effort)
        reading = ReadingTrack(self.kind, self.frame, stamps, self.raw(), stamps)
        return Recording((joints,), (reading,), self.signals, self.urdf or None)

    def _streamed(self) -> Recording:
        """Joint states all the time, readings while the arm stands: the first half of each period it moves."""
        rng = np.random.default_rng(len(self))
        half, rate = 0.5 * PERIOD, 25.0
        u = np.clip(np.arange(0.0, PERIOD, 1.0 / rate) / half, 0.0, 1.0)[:, None]
        course = 10 * u**3 - 15 * u**4 + 6 * u**5
        before = np.concatenate([self.q[:1] - 0.1, self.q[:-1]])
        q = (before[:, None] + course * (self.q - before)[:, None]).reshape(-1, self.q.shape[1])
        t = (self.t[:, None] - half + np.arange(len(u)) / rate).ravel()
        when = 0.3 + np.arange(0.0, half - 0.5, 1.0 / self.stream)
        k = len(when)
        _, _, mm, deg = self.stated
        p = np.repeat(self.p, k, axis=0) + rng.normal(0, 1e-3 * mm / np.sqrt(3.0), (k * len(self), 3))
        turn = Rotation.from_rotvec(np.radians(rng.normal(0, deg / np.sqrt(3.0), (k * len(self), 3))))
        R = Rotation.from_quat(np.repeat(self.R.as_quat(), k, axis=0)) * turn
        values = np.concatenate([p, R.as_quat()], axis=1)[:, : 3 if self.kind == POINT else 7]
        stamps, read = BEGIN + np.round(t, 6), BEGIN + np.round((self.t[:, None] + when).ravel() + 1.3e-3, 6)
        joints = joint_track(self.names, stamps, q)
        return Recording((joints,), (ReadingTrack(self.kind, self.frame, read, values, read),), self.signals, self.urdf)

    def write(self, folder: Path) -> Path:
        """The bag of it."""
        write_recording(self.recording(), folder)
        return folder


def joint_track(names: tuple[str, ...], stamps: Array, q: Array, effort: Array | None = None) -> JointTrack:
    """Joint states without speeds."""
    unknown = np.full_like(q, np.nan)
    return JointTrack(names, stamps, q, unknown, unknown if effort is None else effort, stamps)


def joined(first: Session, second: Session) -> Session:
    """Both in one recording, in the order of their stamps; the floor is that of both."""
    both = [first, second]
    mean = np.average([s.floor_mm**2 for s in both], weights=[len(s) for s in both])
    columns = [name for name in ("t", "q", "p", "again", "came", "effort") if getattr(first, name) is not None]
    kept: dict[str, Any] = {name: np.concatenate([getattr(s, name) for s in both]) for name in columns}
    whole = replace(
        first, R=Rotation.concatenate([s.R for s in both]), floor_mm=float(np.sqrt(mean)), values=None, **kept
    )
    return whole.only(np.argsort(whole.t, kind="stable"))


class Cellwork:
    """What every cell does: random vectors and joints, and recordings of what is true of it."""

    names: tuple[str, ...]
    urdf: str
    rng: np.random.Generator
    noise = NOISE_MM, NOISE_MRAD, REPEAT
    period, epoch = PERIOD, BEGIN
    begins: Callable[[Array], Array]  # of the postures: from where (1, n) the first one is reached
    truth: Callable[[Stations, Stations, tuple[Bend, ...]], tuple[Array, Rotation]]  # of reached, meant: where it is
    postures: Callable[[int, int], tuple[Array, Array]]

    def observe(
        self,
        q: Array,
        again: Array | None = None,
        *bends: Bend,
        begin: float = 0.0,
        kind: str = POSE,
        noise_mm: float | None = None,
        noise_mrad: float | None = None,
        repeat: float | None = None,
        effort: bool = False,
        period: float | None = None,
    ) -> Session:
        """What a recorder notes of visits to q (N, n), with faults that bend the truth."""
        asked = zip((noise_mm, noise_mrad, repeat), self.noise, strict=True)
        mm, mrad, slip = (usual if given is None else given for given, usual in asked)
        N, rng, root = len(q), self.rng, np.sqrt(3.0)
        t, came = begin + (period or self.period) * np.arange(N), np.sign(np.diff(q, axis=0, prepend=self.begins(q)))
        meant = Stations(q, t, came)
        p0, R0 = self.truth(meant, meant, bends)
        p1, R1 = self.truth(replace(meant, q=q + rng.normal(0, slip, q.shape)), meant, bends)
        p = p1 + rng.normal(0, 1e-3 * mm, (N, 3))
        R = R1 * Rotation.from_rotvec(rng.normal(0, 1e-3 * mrad, (N, 3)))
        turned = np.degrees(float(np.sqrt(np.mean((R0.inv() * R1).magnitude() ** 2))))
        stated = 1e3 * _rms(p1 - p0), turned, root * mm, np.degrees(root * 1e-3 * mrad)
        zero = np.zeros_like(q)
        torque = self.arm.driving(q, zero, zero) + rng.normal(0, 0.05, q.shape) if effort else None  # type: ignore[attr-defined]
        made = {"effort": torque, "stated": stated, "came": came, "epoch": self.epoch}
        again = np.zeros(N, bool) if again is None else again
        return Session(self.names, self.urdf, t, q.copy(), p, R, 1e3 * _rms(p - p0), again, kind, **made)

    def way(self, size: float) -> Array:
        """A random vector of a length."""
        v = self.rng.normal(size=3)
        return size * v / np.linalg.norm(v)

    def any_joint(self, low: int = 0, high: int | None = None) -> int:
        return int(self.rng.integers(low, len(self.names) if high is None else high))

    def clean(self, count: int, *bends: Bend, returns: int = RETURNS, **options: Any) -> Session:
        """A recording of random postures, six of them twice."""
        return self.observe(*self.postures(count, returns), *bends, **options)

    def joint(self, i: int, error: Callable[[Stations], Array]) -> Bend:
        """A joint that is off by what ``error`` (N,) says [rad]."""

        def bend(arm: Any, stations: Stations, deviation: Any) -> None:
            deviation.x[:, i, 3] += error(stations)

        return bend

    def moved(self, part: str, shift: Array, turn: Array, when: Callable[[Stations], Array]) -> Bend:
        """The tool, or the tracker, moved by a twist (shift [m], rotation vector) where ``when`` (N,) says."""
        step = np.concatenate([shift, turn])

        def bend(arm: Any, stations: Stations, deviation: Any) -> None:
            moved = getattr(deviation, part)
            moved += np.asarray(when(stations), dtype=float)[:, None] * step

        return bend


class Works(Cellwork):
    """A displaced arm with tool and tracker, and how it is measured."""

    def __init__(self, robot: str, rng: np.random.Generator) -> None:
        self.cell, self.rng, self.robot = Cell(robot, rng), rng, robot
        self.arm = self.cell.arm
        self.names, self.urdf = self.arm.names, self.arm.urdf

    def postures(self, count: int, returns: int = RETURNS, low: float = 0.0, high: float = 1.0) -> tuple[Array, Array]:
        """Random postures (count, n) in a part of the joints' ranges, and which are second visits, (count,)."""
        lower, upper = self.arm.range
        q = lower + (upper - lower) * self.rng.uniform(low, high, (count - returns, self.arm.n))
        return self.with_returns(q, returns)

    def with_returns(self, q: Array, returns: int = RETURNS) -> tuple[Array, Array]:
        """Postures with second visits among them, spread over the run, two joints or more from the other side."""
        for _ in range(200):
            order, again = self._order(q, returns)
            came = np.sign(np.diff(q[order], axis=0, prepend=self.arm.range.mean(axis=0)[None]))
            pairs = [(int(np.flatnonzero(order == order[k])[0]), int(k)) for k in np.flatnonzero(again)]
            if all(k - i > 1 and np.sum(came[i] * came[k] < 0) >= 2 for i, k in pairs):
                return q[order], again
        raise ArithmeticError("no tour comes back from other sides")

    def _order(self, q: Array, returns: int) -> tuple[Array, Array]:
        count, rng = len(q), self.rng
        order = list(range(count))
        first = rng.choice(np.arange(1, int(0.7 * count)), returns, replace=False)
        for i in first:
            places = [k for k in range(order.index(i) + 3, len(order) + 1)]
            places = list(rng.choice(places, min(len(places), 12), replace=False))
            here = order.index(i)
            came = np.sign(q[i] - q[order[here - 1]])
            best = max(places, key=lambda k: int(np.sum(came * np.sign(q[i] - q[order[k - 1]]) < 0)))
            order.insert(best, int(i))
        seen: set[int] = set()
        again = np.array([i in seen or bool(seen.add(i)) for i in order])  # type: ignore[func-returns-value]
        return np.array(order), again

    def begins(self, q: Array) -> Array:
        """The middle of the joints' ranges."""
        return self.arm.range.mean(axis=0)[None]

    def truth(self, reached: Stations, meant: Stations, bends: tuple[Bend, ...]) -> tuple[Array, Rotation]:
        """By MuJoCo; faults go by the postures that are reached."""
        seen = self.cell.poses(reached, tuple(Fault((), (), (), "", bend) for bend in bends))
        return seen.p, seen.R

    def elastic(self, sag: float = 4e-4, payload: float = 0.0) -> Bend:
        """Joints that give by some ``sag`` [rad] under the arm's weight, and a payload [kg]."""
        sample = self.arm.coordinates(self.rng.uniform(*self.arm.range, (60, self.arm.n)))
        rms = np.sqrt(np.mean(self.arm.holding(sample)[..., 3] ** 2, axis=0))
        stiffness = np.maximum(rms, 0.1 * rms.max()) / sag

        def bend(arm: Any, stations: Stations, deviation: Deviation) -> None:
            deviation.linear[:, 3] = stiffness
            deviation.payload += payload

        return bend


def _rms(v: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(v**2, axis=1))))
