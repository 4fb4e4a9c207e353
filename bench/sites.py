"""Cells of all benches: an arm of ``arms.py``, its tool, a tracker, what is wrong with them, and what is recorded.

A fault is a *bend*: it adds to how the arm is when its joints are said to be somewhere. What no model can predict of a
recording is known exactly. From modcal comes the writing of bags alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from arms import TURN, Arm, Array
from scipy.spatial.transform import Rotation

from modcal_core.measurements.recording import POINT, POSE, JointTrack, ReadingTrack, Recording, SignalTrack
from modcal_msgs_py.recording_write import write_recording

Rng = np.random.Generator
BEGIN = 1.7e9  # s
PERIOD = 4.0  # s from station to station
NOISE_MM, NOISE_MRAD, REPEAT = 0.02, 0.02, 1e-5  # per axis; per joint [rad]
RETURNS = 6
EFFORT_NOISE = 0.05  # N m
RATE, MOVE, DWELL = 25.0, 1.2, 0.6  # Hz, s, s; of point_to_point
JOINT_RATE, TRACKER_RATE, SPEED = 125.0, 50.0, 0.3  # Hz, Hz, m/s; of a course
EXACT: dict[str, Any] = {"noise_mm": 0.0, "noise_mrad": 0.0, "repeat": 0.0}


@dataclass(frozen=True)
class Stations:
    """Postures q (m, n) [rad], times t (m,) since the session began [s], way each joint came (m, n): −1 or 1.

    path: times and postures on the way; None: straight from station to station.
    """

    q: Array
    t: Array
    came: Array
    path: tuple[Array, Array] | None = None


class Deviation:
    """How the arm is when its joints are said to be at the stations' q. Bends add to it one after the other.

    x: coordinates (m, n, 4) before springs; linear, cubic: stiffness (n, 4); tool, tracker: twists (m, 6) that move
    them, linear part first, in the tool's frame and along the world's axes; scale: of the readings; payload: mass at
    the flange [kg].
    """

    def __init__(self, arm: Arm, stations: Stations) -> None:
        self.x = arm.coordinates(stations.q)
        self.linear, self.cubic = np.full((arm.n, 4), np.inf), np.zeros((arm.n, 4))
        self.tool, self.tracker = np.zeros((len(stations.t), 6)), np.zeros((len(stations.t), 6))
        self.scale, self.payload = 1.0, 0.0


Bend = Callable[[Stations, Deviation], None]


def off(part: str, where: Any, by: Callable[[Stations], Any]) -> Bend:
    """Adds what ``by`` says to a part of the deviation (x, tool, tracker) at an index."""

    def bend(s: Stations, d: Deviation) -> None:
        getattr(d, part)[where] += by(s)

    return bend


def turned(i: Any, error: Callable[[Stations], Array]) -> Bend:
    """A joint, or all, off by an error (m,) [rad]."""
    return off("x", np.s_[:, i, TURN], error)


def twisted(part: str, twist: Array, when: Callable[[Stations], Any]) -> Bend:
    """The tool, or the tracker, moved by a twist (6,) where ``when`` (m,) says, or in so far."""
    return off(part, np.s_[:], lambda s: np.asarray(when(s), dtype=float)[:, None] * twist)


def sprung(where: Any, linear: Any, cubic: Any = 0.0, payload: float = 0.0) -> Bend:
    """Springs in coordinates by an index of (n, 4), and a payload [kg]."""

    def bend(s: Stations, d: Deviation) -> None:
        d.linear[where], d.cubic[where] = linear, cubic
        d.payload += payload

    return bend


def carrying(bend: Bend, kg: float) -> Bend:
    """The same with a payload."""

    def both(s: Stations, d: Deviation) -> None:
        bend(s, d)
        d.payload += kg

    return both


def rms(v: Array) -> float:
    """Root of the mean square of the lengths of vectors (m, …)."""
    return float(np.sqrt(np.mean(np.sum(v**2, axis=-1))))


def unit(v: Array) -> Array:
    """Vectors of length one."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def turn_noise(rng: Rng, size: float, count: int) -> Rotation:
    """Small random turns [rad per axis]."""
    return Rotation.from_rotvec(rng.normal(0, size, (count, 3)))


def quintic(u: Array) -> Array:
    """A smooth way from 0 to 1."""
    return 10 * u**3 - 15 * u**4 + 6 * u**5


def flow(t: Array, ends: Array, reached: Array, move: float, pause: float, begin: float = 0.0) -> Array:
    """Joints at times t (m,) on the way through ends (N, n), each reached at a time (N,) and left after a pause.

    move: how long each way takes [s]; begin: how far before the first end the way begins [rad].
    """
    before = np.concatenate([ends[:1] - begin, ends[:-1]])
    k = np.clip(np.searchsorted(reached + pause, t), 0, len(ends) - 1)
    return before[k] + quintic(np.clip((t - reached[k] + move) / move, 0.0, 1.0))[:, None] * (ends - before)[k]


def joint_track(
    names: Sequence[str], stamps: Array, q: Array, effort: Array | None = None, topic: str = ""
) -> JointTrack:
    """Joint states without speeds."""
    unknown = np.full_like(q, np.nan)
    more = {"topic": topic} if topic else {}
    return JointTrack(tuple(names), stamps, q, unknown, unknown if effort is None else effort, stamps, **more)


def reading(stamps: Array, values: Array, kind: str = POSE, frame: str = "tracker") -> ReadingTrack:
    """Readings with the stamps of their arrival."""
    return ReadingTrack(kind, frame, stamps, values, stamps)


def poses(p: Array, R: Rotation) -> Array:
    """Rows x y z qx qy qz qw."""
    return np.concatenate([p, R.as_quat()], axis=1)


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

    def only(self, rows: Any) -> Session:
        """These stations alone, or in this order."""
        columns = ("t", "q", "p", "R", "again", "came", "effort", "values")
        kept = {name: None if (column := getattr(self, name)) is None else column[rows] for name in columns}
        return replace(self, more={name: column[rows] for name, column in self.more.items()}, **kept)

    def raw(self) -> Array:
        """What a topic would hold: x y z, for poses with qx qy qz qw after it."""
        if self.values is not None:
            return self.values
        return self.p if self.kind == POINT else poses(self.p, self.R)

    def recording(self) -> Recording:
        """The session as modcal's own arrays, to be written."""
        if self.spoken is not None or self.stream:
            return self.spoken(self) if self.spoken is not None else self._streamed()
        effort = np.full((len(self), len(self.names) + len(self.more)), np.nan)
        if self.effort is not None:
            effort[:, : len(self.names)], effort[:, len(self.names) :] = self.effort, 0.0
        stamps = self.epoch + self.t
        joints = joint_track((*self.names, *self.more), stamps, np.column_stack([self.q, *self.more.values()]), effort)
        return Recording(
            (joints,), (reading(stamps, self.raw(), self.kind, self.frame),), self.signals, self.urdf or None
        )

    def _streamed(self) -> Recording:
        """Joint states all the time, readings while the arm stands: the first half of each period it moves."""
        rng, half, (_, _, mm, deg) = np.random.default_rng(len(self)), 0.5 * PERIOD, self.stated
        t = (self.t[:, None] - half + np.arange(0.0, PERIOD, 1.0 / 25.0)).ravel()
        when = 0.3 + np.arange(0.0, half - 0.5, 1.0 / self.stream)
        k = len(when)
        p = np.repeat(self.p, k, axis=0) + rng.normal(0, 1e-3 * mm / np.sqrt(3.0), (k * len(self), 3))
        turn = Rotation.from_rotvec(np.radians(rng.normal(0, deg / np.sqrt(3.0), (k * len(self), 3))))
        values = poses(p, Rotation.from_quat(np.repeat(self.R.as_quat(), k, axis=0)) * turn)
        joints = joint_track(self.names, BEGIN + np.round(t, 6), flow(t, self.q, self.t, half, half, 0.1))
        read = BEGIN + np.round((self.t[:, None] + when).ravel() + 1.3e-3, 6)
        told = reading(read, values[:, : 3 if self.kind == POINT else 7], self.kind, self.frame)
        return Recording((joints,), (told,), self.signals, self.urdf)

    def write(self, folder: Path) -> Path:
        """The bag of it."""
        write_recording(self.recording(), folder)
        return folder


def floor_of(sessions: Sequence[Session]) -> float:
    """The floor of several together [mm]."""
    return float(np.sqrt(np.average([s.floor_mm**2 for s in sessions], weights=[len(s) for s in sessions])))


def joined(*sessions: Session) -> Session:
    """Several in one recording, in the order of their stamps."""
    columns = [name for name in ("t", "q", "p", "again", "came", "effort") if getattr(sessions[0], name) is not None]
    kept: dict[str, Any] = {name: np.concatenate([getattr(s, name) for s in sessions]) for name in columns}
    R = Rotation.concatenate([s.R for s in sessions])
    whole = replace(sessions[0], R=R, floor_mm=floor_of(sessions), values=None, **kept)
    return whole.only(np.argsort(whole.t, kind="stable"))


@dataclass(frozen=True)
class Seen:
    """Tool poses (m,) in the tracker's frame [m]."""

    p: Array
    R: Rotation


class Cell:
    """A displaced arm, its tool (place, turn), the tracker beside it, and how they are measured.

    noise: of the instrument [mm, mrad], and how joints return [rad]. by_meant: whether faults go by the postures that
    are meant, and not by those that are reached.
    """

    noise = NOISE_MM, NOISE_MRAD, REPEAT
    period, epoch, by_meant = PERIOD, BEGIN, False

    def __init__(self, robot: str, rng: Rng) -> None:
        self.robot, self.rng = robot, rng
        self.settle_in(Arm.of(robot, rng))
        way = rng.normal(size=3)
        self.tool = rng.uniform(0.05, 0.15) * way / np.linalg.norm(way), Rotation.random(rng=rng)
        azimuth, distance = rng.uniform(0, 2 * np.pi), rng.uniform(2.0, 4.0)
        stand = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), rng.uniform(0.3, 1.5)])
        self.tracker = stand, Rotation.random(rng=rng)

    def settle_in(self, arm: Arm) -> None:
        """This arm stands here."""
        self.arm, self.names, self.urdf = arm, arm.names, arm.urdf

    def poses(self, stations: Stations, bends: Sequence[Bend] = (), reached: Stations | None = None) -> Seen:
        """Where the tool is at stations, as a tracker without noise sees it."""
        d = Deviation(self.arm, reached or stations)
        for bend in bends:
            bend(stations if self.by_meant or reached is None else reached, d)
        self.arm.carry(d.payload)
        p, R = self.arm.frames(self.arm.settle(d.x, d.linear, d.cubic))
        return self.seen(p[:, -1], Rotation.from_matrix(R[:, -1]), d)

    def seen(self, p: Array, tip: Rotation, d: Deviation) -> Seen:
        """What the tracker sees of a tip."""
        tool = tip * self.tool[1]
        at = p + tip.apply(self.tool[0]) + tool.apply(d.tool[:, :3])
        eye = (Rotation.from_rotvec(d.tracker[:, 3:]) * self.tracker[1]).inv()
        gone = self.tracker[0] + d.tracker[:, :3]
        return Seen(d.scale * eye.apply(at - gone), eye * (tool * Rotation.from_rotvec(d.tool[:, 3:])))

    def observe(
        self,
        q: Array,
        again: Array | None = None,
        *bends: Bend,
        begin: float = 0.0,
        kind: str = POSE,
        effort: bool = False,
        period: float | None = None,
        **noise: float,
    ) -> Session:
        """What a recorder notes of visits to q (N, n), with bends. noise: noise_mm, noise_mrad, repeat."""
        usual = dict(zip(EXACT, self.noise, strict=True))
        mm, mrad, slip = (usual | noise).values()
        N, rng, root = len(q), self.rng, np.sqrt(3.0)
        t, came = begin + (period or self.period) * np.arange(N), np.sign(np.diff(q, axis=0, prepend=self.begins(q)))
        meant = Stations(q, t, came)
        exact = self.poses(meant, bends)
        real = self.poses(meant, bends, replace(meant, q=q + rng.normal(0, slip, q.shape)))
        p = real.p + rng.normal(0, 1e-3 * mm, (N, 3))
        R = real.R * turn_noise(rng, 1e-3 * mrad, N)
        missed = np.degrees(float(np.sqrt(np.mean((exact.R.inv() * real.R).magnitude() ** 2))))
        stated = 1e3 * rms(real.p - exact.p), missed, root * mm, np.degrees(root * 1e-3 * mrad)
        zero = np.zeros_like(q)
        torque = self.arm.driving(q, zero, zero) + rng.normal(0, EFFORT_NOISE, q.shape) if effort else None
        made: dict[str, Any] = {"effort": torque, "stated": stated, "came": came, "epoch": self.epoch}
        again = np.zeros(N, bool) if again is None else again
        return Session(self.names, self.urdf, t, q.copy(), p, R, 1e3 * rms(p - exact.p), again, kind, **made)

    def begins(self, q: Array) -> Array:
        """From where the first posture is reached (1, n): the middle of the joints' ranges."""
        return self.arm.range.mean(axis=0)[None]

    def clean(self, count: int, *bends: Bend, returns: int = RETURNS, **options: Any) -> Session:
        """A recording of random postures, six of them twice."""
        return self.observe(*self.postures(count, returns), *bends, **options)

    def way(self, size: float) -> Array:
        """A random vector of a length."""
        return size * unit(self.rng.normal(size=3))

    def any_joint(self, low: int = 0, high: int | None = None) -> int:
        return int(self.rng.integers(low, len(self.names) if high is None else high))

    def postures(self, count: int, returns: int = RETURNS, low: float = 0.0, high: float = 1.0) -> tuple[Array, Array]:
        """Random postures (count, n) in a part of the joints' ranges, and which are second visits, (count,)."""
        lower, upper = self.arm.range
        q = lower + (upper - lower) * self.rng.uniform(low, high, (count - returns, self.arm.n))
        return self.with_returns(q, returns)

    def with_returns(self, q: Array, returns: int = RETURNS) -> tuple[Array, Array]:
        """Postures with second visits among them, spread over the run, two joints or more from the other side."""
        for _ in range(200):
            order = self._order(q, returns)
            again = np.array([i in order[:k] for k, i in enumerate(order)])
            came = np.sign(np.diff(q[order], axis=0, prepend=self.arm.range.mean(axis=0)[None]))
            pairs = [(order.index(order[k]), int(k)) for k in np.flatnonzero(again)]
            if all(k - i > 1 and np.sum(came[i] * came[k] < 0) >= 2 for i, k in pairs):
                return q[order], again
        raise ArithmeticError("no tour comes back from other sides")

    def _order(self, q: Array, returns: int) -> list[int]:
        count, rng = len(q), self.rng
        order = list(range(count))
        for i in rng.choice(np.arange(1, int(0.7 * count)), returns, replace=False):
            here = order.index(i)
            places = list(range(here + 3, len(order) + 1))
            places = list(rng.choice(places, min(len(places), 12), replace=False))
            came = np.sign(q[i] - q[order[here - 1]])
            order.insert(max(places, key=lambda k: int(np.sum(came * np.sign(q[i] - q[order[k - 1]]) < 0))), int(i))
        return order

    def springs(self, sag: float) -> Array:
        """Stiffness (n,) [N m/rad] of joints that give by some ``sag`` [rad] under the arm's weight."""
        load = np.sqrt(
            np.mean(self.arm.loads(self.rng.uniform(*self.arm.range, (60, self.arm.n)))[..., TURN] ** 2, axis=0)
        )
        return np.maximum(load, 0.1 * load.max()) / sag

    def elastic(self, sag: float = 4e-4, payload: float = 0.0) -> Bend:
        """Such joints, and a payload [kg]."""
        return sprung(np.s_[:, TURN], self.springs(sag), 0.0, payload)


@dataclass(frozen=True)
class Plan:
    """What the arm is told to do: stamps since the session's beginning [s], and motion (m, n) of the joint states.

    stations: what the tracker is asked for, and when; ends: the rows of the joint states that belong to them.
    """

    t: Array
    q: Array
    v: Array
    a: Array
    stations: Stations
    ends: Array | None


def point_to_point(arm: Arm, rng: Rng, count: int, begin: float) -> Plan:
    """Random postures, with smooth moves between them and a short stand at each."""
    q = rng.uniform(*arm.range, (count + 1, arm.n))
    t, rows, now, ends = [], [], begin, []
    for a, b in pairwise(q):
        move = MOVE * rng.uniform(0.9, 1.1)
        s = np.arange(0.0, move + DWELL + 0.5 / RATE, 1.0 / RATE)
        u = np.clip(s / move, 0.0, 1.0)[:, None]
        v, w = 30 * u**2 * (1 - u) ** 2 / move, 60 * u * (1 - u) * (1 - 2 * u) / move**2
        rows.append(np.stack([a + (b - a) * quintic(u), (b - a) * v, (b - a) * w]))
        t.append(now + s)
        now += s[-1] + 1.0 / RATE
        ends.append(len(s))
    motion, last = np.concatenate(rows, axis=1), np.cumsum(ends) - 1
    stamps = np.round(np.concatenate(t), 6)
    return Plan(stamps, *motion, stations=Stations(q[1:], stamps[last], np.sign(np.diff(q, axis=0))), ends=last)


def course(cell: Cell, rng: Rng, duration: float, begin: float) -> Plan:
    """A smooth course of several sines a joint, at a speed of the tool that is usual for a tracker."""
    arm = cell.arm
    f, phase = rng.uniform(0.03, 0.2, (3, arm.n)), rng.uniform(0, 2 * np.pi, (3, arm.n))
    share = rng.dirichlet(np.full(3, 4.0), arm.n).T * 0.5 * np.ptp(arm.range, axis=0)

    def motion(t: Array, pace: float) -> Array:
        w = 2 * np.pi * f * pace
        sine, cosine = np.sin(t[:, None, None] * w + phase), np.cos(t[:, None, None] * w + phase)
        parts = (share * sine, share * w * cosine, -share * w**2 * sine)
        q, v, a = (part.sum(axis=1) for part in parts)
        return np.stack([arm.range.mean(axis=0) + q, v, a])

    s, pace = np.arange(0.0, duration, 1.0 / TRACKER_RATE), 1.0
    for _ in range(5):
        q = motion(s, pace)[0]
        p = cell.poses(Stations(q, s, np.zeros_like(q))).p
        pace *= SPEED / rms(np.diff(p, axis=0)) / TRACKER_RATE
    fine = np.arange(0.0, duration, 1.0 / JOINT_RATE)
    # the tracker runs on its own beat, and while joint states are there
    s = s[(s > 0.1) & (s < duration - 0.1)] + 0.37 / TRACKER_RATE
    q = motion(s, pace)[0]
    stations = Stations(q, np.round(begin + s, 6), np.zeros_like(q))
    return Plan(np.round(begin + fine, 6), *motion(fine, pace), stations=stations, ends=None)
