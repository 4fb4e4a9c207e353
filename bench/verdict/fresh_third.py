"""The third group of kinds that were written after the last change to the code, with their words, and run once.

Drawn up by class: conventions, time, instrument, surroundings, robot, description, data, use. None is a variant of a
kind elsewhere.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from case import Case, calibrated, kind
from conventions import ORIENTATION
from fresh_again import CLOCK, TRACKER, _written
from regimes import BASE, LEFT_OUT, TOOL
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from workcell import BEGIN, PERIOD, REPEAT, Array, Session, Stations, Works

from modcal_core.measurements.recording import POSE, JointTrack, ReadingTrack, Recording

ROW = (r"\brows?\b", r"\border\b", "station before", "previous", "shift", "late", "delay", *CLOCK)
third = kind("fresh_third")


def _joints(session: Session, q: Array) -> Session:
    return replace(session, q=q)


def _joint_block(session: Session, name: str) -> str:
    found = re.search(rf'<joint name="{name}".*?</joint>', session.urdf, re.DOTALL)
    assert found is not None
    return found[0]


def _origins(session: Session, names: tuple[str, ...], least: float) -> list[str]:
    """The arm's joints of which the origin is farther than ``least`` [m] from the one before."""
    out = []
    for name in names:
        found = re.search(r'<origin[^>]*xyz="([^"]*)"', _joint_block(session, name))
        if found and max(abs(float(v)) for v in found[1].split()) > least:
            out.append(name)
    return out


def _with_origin(session: Session, name: str, factor: float) -> Session:
    block = _joint_block(session, name)

    def other(found: re.Match[str]) -> str:
        return f'{found[1]}xyz="{" ".join(f"{factor * float(v):.9g}" for v in found[2].split())}"'

    changed = re.sub(r'(<origin[^>]*?)xyz="([^"]*)"', other, block)
    assert changed != block
    return replace(session, urdf=session.urdf.replace(block, changed))


def _near(w: Works, name: str) -> tuple[str, ...]:
    i = w.names.index(name)
    return tuple(w.names[max(i - 1, 0) : i + 1])


# --- conventions -----------------------------------------------------------------------------------------------------


@third
def orientations_in_another_frame(w: Works, rng: np.random.Generator) -> Case:
    """Positions are given in the tracker's frame, orientations in that of the room: a static transform was left out."""
    session = w.clean(130)
    return calibrated(replace(session, R=Rotation.random(rng=rng) * session.R), (*ORIENTATION, "frame"))


@third
def tool_offset_turned_backwards(w: Works, rng: np.random.Generator) -> Case:
    """Software takes the offset of the ball off with the transposed orientation."""
    session = w.clean(130)
    p = session.p - session.R.inv().apply(w.way(0.06))
    return calibrated(replace(session, p=p), (*ORIENTATION, *TOOL, "invers", "offset"))


@third
def game_engine_axes(w: Works, rng: np.random.Generator) -> Case:
    """A headset's tracker has left-handed axes, in positions and quaternions alike: y and z are exchanged."""
    session = w.clean(130)
    x, y, z, s = session.R.as_quat().T
    values = np.column_stack([session.p[:, [0, 2, 1]], x, z, y, -s])
    return calibrated(replace(session, values=values), ("mirror", "handed", r"\bax[ei]s\b", r"\by\b"))


@third
def roll_and_yaw_exchanged(w: Works, rng: np.random.Generator) -> Case:
    """An export's columns of roll and yaw were taken for each other."""
    session = w.clean(130)
    angles = session.R.as_euler("xyz")[:, ::-1]
    return calibrated(replace(session, R=Rotation.from_euler("xyz", angles)), ORIENTATION)


@third
def every_joint_the_other_way(w: Works, rng: np.random.Generator) -> Case:
    """A controller counts all its joints the other way round."""
    session = w.clean(130)
    return calibrated(_joints(session, -session.q), ("sign", "direction", "other way", "revers", *w.names))


@third
def two_joints_swapped_one_negated(w: Works, rng: np.random.Generator) -> Case:
    """Encoder cables of two joints that are no neighbours were swapped, one of which counts the other way round."""
    session, i = w.clean(130), w.any_joint(0, w.arm.n - 2)
    q = session.q.copy()
    q[:, [i, i + 2]] = q[:, [i + 2, i]] * [-1.0, 1.0]
    return calibrated(_joints(session, q), (w.names[i], w.names[i + 2]))


# --- time ------------------------------------------------------------------------------------------------------------


@third
def table_one_row_late(w: Works, rng: np.random.Generator) -> Case:
    """Readings were pasted one row too low: each stands beside the posture after its own."""
    session = w.clean(130)
    rows = np.maximum(np.arange(130) - 1, 0)
    return calibrated(replace(session, p=session.p[rows], R=session.R[rows]), ROW)


@third
def one_column_one_row_late(w: Works, rng: np.random.Generator) -> Case:
    """The column of z alone slipped by a row."""
    session = w.clean(130, kind="point")
    p = session.p.copy()
    p[1:, 2] = p[:-1, 2]
    return calibrated(replace(session, p=p), (*ROW, r"\bz\b", r"\bax[ei]s\b", "column"))


@third
def one_joint_one_row_late(w: Works, rng: np.random.Generator) -> Case:
    """One joint is polled by a slow bus: its value is always that of the station before."""
    session, i = w.clean(130), w.any_joint(0, w.arm.n - 1)
    q = session.q.copy()
    q[1:, i] = q[:-1, i]
    return calibrated(_joints(session, q), (w.names[i],))


@third
def smoothed_in_a_spreadsheet(w: Works, rng: np.random.Generator) -> Case:
    """Somebody smoothed the orientations' columns over three rows and left the positions."""
    session = w.clean(130)
    q = session.R.as_quat()
    for k in range(1, len(q)):
        q[k] *= np.sign(q[k] @ q[k - 1]) or 1.0
    mean = q.copy()
    mean[1:-1] = (q[:-2] + 8.0 * q[1:-1] + q[2:]) / 10.0
    return calibrated(replace(session, R=Rotation.from_quat(mean)), (*ORIENTATION, "filter", "smooth", *ROW))


def _stream(w: Works, count: int, rate: float = 25.0) -> tuple[Session, Array, Array, Array, Rotation]:
    """Joint states and readings all the time: the session, times, joints, and what is read without a fault."""
    q, again = w.postures(count)
    session = w.observe(q, again, noise_mm=0.0, noise_mrad=0.0, repeat=0.0)
    half = 0.5 * PERIOD
    when = np.arange(0.0, PERIOD, 1.0 / rate)
    u = np.clip(when / half, 0.0, 1.0)[:, None]
    course = 10 * u**3 - 15 * u**4 + 6 * u**5
    reached = q + w.rng.normal(0, REPEAT, q.shape)

    def way(ends: Array) -> Array:
        start = np.concatenate([ends[:1] - 0.1, ends[:-1]])
        return (start[:, None] + course * (ends - start)[:, None]).reshape(-1, w.arm.n)

    t = np.round((session.t[:, None] - half + when).ravel(), 6)
    seen = w.cell.poses(Stations(way(reached), t, np.ones_like(way(q))), ())
    missed = w.cell.poses(Stations(reached, session.t, np.ones_like(q)), ()).p - session.p
    floor = float(np.hypot(1e3 * np.sqrt(np.mean(np.sum(missed**2, axis=1))), 0.035 / np.sqrt(25.0)))
    return replace(session, floor_mm=floor), t, way(q), seen.p, seen.R


def _recorded(w: Works, session: Session, t: Array, q: Array, p: Array, R: Rotation, read: Array) -> Session:
    """Streams, the readings with noise and with stamps of their own."""
    p = p + w.rng.normal(0, 2e-5, p.shape)
    R = R * Rotation.from_rotvec(w.rng.normal(0, 2e-5, p.shape))
    unknown = np.full_like(q, np.nan)
    joints = JointTrack(w.names, BEGIN + t, q, unknown, unknown, BEGIN + t)
    reading = ReadingTrack(POSE, session.frame, read, np.concatenate([p, R.as_quat()], axis=1), BEGIN + t)
    return _written(session, Recording((joints,), (reading,), (), session.urdf))


@third
def tracker_averages_a_second(w: Works, rng: np.random.Generator) -> Case:
    """The tracker sends the mean of its last second: readings begin to be right when the arm has stood that long."""
    session, t, q, p, R = _stream(w, 90)
    taps = np.ones(25) / 25.0
    mean = lfilter(taps, 1.0, p - p[0], axis=0) + p[0]
    quaternions = R.as_quat()
    turn = np.cumprod(np.r_[1.0, np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0, -1.0, 1.0)])
    quaternions *= turn[:, None]
    slow = lfilter(taps, 1.0, quaternions - quaternions[0], axis=0) + quaternions[0]
    made = _recorded(w, session, t, q, mean, Rotation.from_quat(slow), BEGIN + t)
    return calibrated(made, (*CLOCK, *TRACKER, "filter", "settl", *LEFT_OUT), shown="if left")


@third
def tracker_clock_runs_fast(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's clock gains two milliseconds a second and is set once, at the beginning."""
    session, t, q, p, R = _stream(w, 90)
    return calibrated(_recorded(w, session, t, q, p, R, BEGIN + t + 2e-3 * (t - t[0])), CLOCK, shown="if left")


@third
def clock_set_back(w: Works, rng: np.random.Generator) -> Case:
    """In the middle the tracker's clock is set: from then on its stamps are a second and a half early."""
    session, t, q, p, R = _stream(w, 90)
    read = BEGIN + t + np.where(t > 180.0, 0.0, 1.5)
    return calibrated(_recorded(w, session, t, q, p, R, read), (*CLOCK, *LEFT_OUT), shown="if left")


# --- instruments -----------------------------------------------------------------------------------------------------


@third
def probe_radius_not_taken_off(w: Works, rng: np.random.Generator) -> Case:
    """A ball probe touches the nearest side of a box: the reading is off by its radius along one of the box's axes."""
    session = w.clean(150)
    box = Rotation.random(rng=rng)
    axis = box.inv().apply(session.R.apply([0.0, 0.0, 1.0]))
    side = np.argmax(np.abs(axis), axis=1)
    normal = np.zeros((150, 3))
    normal[np.arange(150), side] = np.sign(axis[np.arange(150), side])
    return calibrated(replace(session, p=session.p - 1e-3 * box.apply(normal)), (*TRACKER, *TOOL, *LEFT_OUT, "target"))


@third
def camera_range_ends(w: Works, rng: np.random.Generator) -> Case:
    """A depth camera writes its greatest distance for everything that is farther."""
    session = w.clean(150)
    p = session.p.copy()
    p[:, 2] = np.minimum(p[:, 2], np.quantile(p[:, 2], 0.8))
    words = (r"\bz\b", "same", "saturat", "clip", "limit", *LEFT_OUT, *TRACKER)
    return calibrated(replace(session, p=p), words)


@third
def half_precision(w: Works, rng: np.random.Generator) -> Case:
    """A driver sends poses in half precision, and a bridge writes them as doubles."""
    session = w.clean(150)
    values = session.raw().astype(np.float16).astype(float)
    return calibrated(replace(session, values=values), ("digit", "round", "resolution", "precision", *TRACKER))


@third
def marker_has_a_symmetry(w: Works, rng: np.random.Generator) -> Case:
    """A square marker is found turned by a quarter at a tenth of the stations."""
    session = w.clean(150)
    quarter = np.where(rng.random(150) < 0.1, 0.5 * np.pi, 0.0)
    turned = session.R * Rotation.from_rotvec(quarter[:, None] * [0.0, 0.0, 1.0])
    return calibrated(replace(session, R=turned), (*ORIENTATION, *LEFT_OUT))


@third
def reference_on_the_first_link(w: Works, rng: np.random.Generator) -> Case:
    """Readings are relative to a reference marker, which somebody stuck to the arm's first link."""
    session = w.clean(140)
    axis = w.cell.tracker[1].inv().apply([0.0, 0.0, 1.0])
    centre = -w.cell.tracker[1].inv().apply(w.cell.tracker[0])
    back = Rotation.from_rotvec(-session.q[:, [0]] * axis)
    other = replace(session, p=back.apply(session.p - centre) + centre, R=back * session.R)
    return calibrated(other, (w.names[0], *BASE))


@third
def scale_jumps_when_recalibrated(w: Works, rng: np.random.Generator) -> Case:
    """A camera recalibrates itself half way: its scale differs by 400 ppm from then on."""
    session = w.clean(150)
    scale = np.where(np.arange(150) < 75, 1.0, 1.0004)[:, None]
    return calibrated(replace(session, p=session.p * scale), (*TRACKER, *BASE, "scale", r"\breading"))
