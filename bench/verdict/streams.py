"""What the eighth group and the healthy cells need besides: streams of the whole way, other arms, what they weigh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import date

import numpy as np
from case import Scene, export
from scipy.spatial.transform import Rotation
from sites import turned as off_by
from transforms import *
from world import EACH, EPOCH, World

WAITS = 3.0  # s, of the EACH from one station to the next
RATE, READS = 50.0, 20.0  # Hz, of joint states and of readings
READ_MM, READ_MRAD, SLIP = 0.04, 0.05, 8e-6  # per axis; per joint [rad]
Spoil = Callable[[Scene, Array, Array], tuple[Array, Array]]  # of stamps and values of readings (m,), (m, 7)
More = Callable[[Scene, Array, Array], tuple[tuple[str, ...], Array, Array]]  # of stamps and joints (m,), (m, n)
STEPS = {  # joints that deflect under weight [rad/N m]
    "soft": lambda c, k: waits(c, off_by(slice(None), lambda s: k * c.torques(s.q)), "compliance"),
}


def went(t: Array, stations: Array, rest: Array) -> Array:
    """Joints at times t (m,), between stations (N, n) that are reached at rest[k] and left WAITS later."""
    return flow(t, stations, rest, EACH - WAITS, WAITS)


def flowing(c: Scene, count: int, spoil: Spoil | None = None, more: More | None = None) -> None:
    """Stations, recorded with all that lies between. spoil: of readings; more: names, stamps, joints of another."""
    session, root = c.clean(count, noise_mm=0.0, noise_mrad=0.0), np.sqrt(3.0)
    (arm_mm, arm_deg, _, _), dwell = session.stated, np.sqrt(WAITS * READS)
    eye_mm, eye_deg = root * READ_MM / dwell, float(np.degrees(root * 1e-3 * READ_MRAD)) / dwell
    stated = arm_mm, arm_deg, eye_mm, eye_deg

    def spoken(s: Session) -> Recording:
        rng = np.random.default_rng([3, len(s)])
        slip, begin, end = rng.normal(0, SLIP, s.q.shape), s.t[0] - 2.0, s.t[-1] + WAITS + 0.5
        t, read = np.arange(begin, end, 1 / RATE), np.arange(begin + 0.013, end, 1 / READS)
        seen = c.sees(went(read, s.q + slip, s.t))
        p = seen.p + rng.normal(0, 1e-3 * READ_MM, seen.p.shape)
        values = poses(p, seen.R * Rotation.from_rotvec(rng.normal(0, 1e-3 * READ_MRAD, p.shape)))
        read, values = (read, values) if spoil is None else spoil(c, read, values)
        q = went(t, s.q, s.t)
        tracks = (joint_track(s.names, EPOCH + t, q), *((joint_track(*more(c, EPOCH + t, q)),) if more else ()))
        return Recording(tracks, (reading(EPOCH + np.round(read, 6), values, frame=s.frame),), s.signals, s.urdf)

    c.session = replace(session, floor_mm=float(np.hypot(arm_mm, eye_mm)), stated=stated, spoken=spoken)


def smoothed(seconds: float) -> Spoil:
    """A first-order filter on everything that is read."""
    a = np.exp(-1 / (READS * seconds))

    def spoil(c: Scene, t: Array, values: Array) -> tuple[Array, Array]:
        signs = np.cumprod(np.r_[1.0, np.sign(np.sum(values[1:, 3:] * values[:-1, 3:], axis=1))])
        out = filtered(np.c_[values[:, :3], values[:, 3:] * signs[:, None]], [1 - a], [1, -a])
        out[:, 3:] /= np.linalg.norm(out[:, 3:], axis=1, keepdims=True)
        return t, out

    return spoil


def hung(c: Scene, t: Array, values: Array) -> tuple[Array, Array]:
    """Ten times the last reading comes again for nine seconds."""
    out = values.copy()
    for k in (np.linspace(0.07, 0.93, 10) * len(t)).astype(int):
        out[k : k + int(9 * READS)] = values[k]
    return t, out


def computed(c: Scene, t: Array, values: Array) -> tuple[Array, Array]:
    """Poses of the nominal flange in the base, 40 ms late and to a micrometre."""
    nominal = World(c.robot, np.random.default_rng(0))
    nominal.rebuild(0.0)
    nominal.tool = nominal.eye = np.zeros(3), Rotation.identity()
    seen = nominal.sees(went(t - 0.04, c.q, c.t))
    return t, np.round(poses(seen.p, seen.R), 6)


def built(c: Scene, robot: str) -> None:
    """A cell of another arm."""
    c.w = type(c.w)(robot, c.rng)


def turning(c: Scene, *joints: int) -> None:
    """A UR5e whose joints of these numbers turn by more than one turn; i is the last of them."""
    c.w, c.i = World("ur5e", c.rng), joints[-1]
    c.w.arm.range[:, list(joints)] = [[-5.5], [5.5]]


def drooping(c: Scene) -> None:
    """The link behind the third joint bends by what it holds, 3 mrad per metre of it that lies flat."""
    axis = np.array(c.joints[2].axis, float)
    x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])  # across the axis, as in arms.py

    def bent(s: Stations, d: Deviation) -> None:
        p, R = c.at(s).links
        turn = np.cross(p[:, -2] - p[:, 2], [0.0, 0.0, -3e-3])
        before = Rotation.from_rotvec(np.outer(s.q[:, 2], axis)) * Rotation.from_matrix(R[:, 2]).inv()
        d.x[:, 2, 1:] += before.apply(turn) @ np.stack([x, np.cross(axis, x), axis], axis=1)

    waits(c, bent)


def elsewhere(c: Scene, when: Of, p: Of = "p", R: Of = "R", form: str = "matrix") -> None:
    """Readings of other positions or orientations, put together in a form, at the stations that ``when`` says."""
    here, new, old = c.of(when), *(getattr(turn, f"as_{form}")() for turn in (c.of(R), c.R))
    turned = np.where(here.reshape(-1, *[1] * (old.ndim - 1)), new, old)
    at = np.where(here[:, None], c.of(p), c.p)
    c.session = replace(c.session, p=at, R=getattr(Rotation, f"from_{form}")(turned))


def as_dates(c: Scene) -> list[float]:
    """The column of a joint; where an angle's hundredths of a degree are a date, the day's number."""
    out = []
    for x, (day, month) in zip(c.x, (divmod(round(100 * np.degrees(x)), 100) for x in c.x), strict=True):
        known = 1 <= day <= 28 and 1 <= month <= 12
        out.append(np.radians(date(2026, month, day).toordinal() - date(1899, 12, 30).toordinal()) if known else x)
    return out


def warmth(c: Scene) -> Array:
    """How warm a spindle is that runs, has a break of 420 s after 80 stations, and runs on (N,)."""
    tau, noon, rest = 170.0, 80 * PERIOD, 420.0
    left = (1.0 - np.exp(-noon / tau)) * np.exp(-rest / tau)
    after = 1.0 - (1.0 - left) * np.exp(-np.maximum(c.t - noon - rest, 0.0) / tau)
    return np.where(c.t <= noon, 1.0 - np.exp(-np.minimum(c.t, noon) / tau), after)


def along(plan: Plan, late: Array) -> Array:
    """Joints of a plan at its stations, each by so many seconds earlier (m, n)."""
    return np.stack([np.interp(plan.stations.t - s, plan.t, plan.q[:, i]) for i, s in enumerate(late)], axis=1)


export(globals(), STEPS)
