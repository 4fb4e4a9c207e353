"""The second group of kinds that were written after the last change to the code, with their words, and run once.

What a metrology engineer, an integrator of ROS drivers and a student in a hurry meet. None is a variant of a kind
elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from case import Case, calibrated, kind
from conventions import ORIENTATION
from physics import LOAD
from regimes import BASE, LEFT_OUT
from scipy.spatial.transform import Rotation
from workcell import BEGIN, PERIOD, REPEAT, Array, Session, Stations, Works

from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording

TRACKER = (r"\btracker\b", r"\binstrument\b", "place of the target", "distance from", "direction in which")
CLOCK = ("clock", "stamp", "delay", "late", r"\btime\b")
again = kind("fresh_again")


@dataclass(frozen=True)
class _Written(Session):
    """A session whose bag holds something else than its arrays say."""

    whole: Recording | None = None

    def recording(self) -> Recording:
        assert self.whole is not None
        return self.whole


def _written(session: Session, whole: Recording) -> _Written:
    return _Written(**{f.name: getattr(session, f.name) for f in fields(session)}, whole=whole)


def _dwells(w: Works, count: int, begin: float = 0.0) -> Session:
    """Streams of joint states and readings, ten readings a second while the arm stands."""
    session = w.observe(*w.postures(count), noise_mm=0.0, noise_mrad=0.0, begin=begin)
    arm_mm, arm_deg, _, _ = session.stated
    eye_mm, eye_deg = 0.02 * np.sqrt(3.0), np.degrees(2e-5 * np.sqrt(3.0))
    floor = float(np.hypot(arm_mm, eye_mm / np.sqrt(15)))
    return replace(session, stream=10.0, stated=(arm_mm, arm_deg, eye_mm, eye_deg), floor_mm=floor)


# --- joint states ----------------------------------------------------------------------------------------------------


@again
def three_joints_in_alphabetical_order(w: Works, rng: np.random.Generator) -> Case:
    """The names of three joints are sorted, their values are not: each stands under the name of the next."""
    session, i = w.clean(130), w.any_joint(0, w.arm.n - 2)
    q = session.q.copy()
    q[:, [i, i + 1, i + 2]] = q[:, [i + 1, i + 2, i]]
    return calibrated(replace(session, q=q), w.names[i : i + 3])


@again
def two_joints_of_other_sign(w: Works, rng: np.random.Generator) -> Case:
    """A driver of another generation counts two joints the other way round."""
    session, both = w.clean(130), rng.choice(w.arm.n, 2, replace=False)
    q = session.q.copy()
    q[:, both] *= -1.0
    return calibrated(replace(session, q=q), tuple(w.names[i] for i in both))


@again
def two_publishers_of_joint_states(w: Works, rng: np.random.Generator) -> Case:
    """A joint_state_publisher that nobody stopped writes zeros between the driver's joint states."""
    session = _dwells(w, 90)
    whole = session.recording()
    (joints,) = whole.joints
    stamps = np.concatenate([joints.stamps, joints.stamps + 0.013])
    q = np.concatenate([joints.position, np.zeros_like(joints.position)])
    order = np.argsort(stamps, kind="stable")
    stamps, q, unknown = stamps[order], q[order], np.full_like(q, np.nan)
    both = JointTrack(joints.names, stamps, q, unknown, unknown, stamps)
    words = ("publish", r"\bjumps?\b", "joint.states?", "two sources", "speed", "velocity")
    return calibrated(_written(session, replace(whole, joints=(both,))), words)


@again
def encoder_bit_lost(w: Works, rng: np.random.Generator) -> Case:
    """The twelfth bit of a joint's encoder is always zero."""
    session, i = w.clean(150), w.any_joint(0, 4)
    bit, q = 2.0 * np.pi / 4096.0, session.q.copy()
    q[:, i] -= bit * (np.floor(q[:, i] / bit) % 2.0)
    return calibrated(replace(session, q=q), (w.names[i],))


@again
def joints_of_three_decimals(w: Works, rng: np.random.Generator) -> Case:
    """All joints are written to a thousandth of a radian, as a table in a report has them."""
    session = w.clean(150)
    return calibrated(replace(session, q=np.round(session.q, 3)), (r"\bdigit", "round", "decimal", "resolution"))


@again
def efforts_of_the_station_before(w: Works, rng: np.random.Generator) -> Case:
    """An elastic arm with a payload; efforts are those of the station before."""
    session = w.clean(150, w.elastic(6e-4, payload=5.0), effort=True)
    assert session.effort is not None
    late = np.concatenate([session.effort[:1], session.effort[:-1]])
    return calibrated(replace(session, effort=late), ("effort", *LOAD, *w.names), shown="if left")


# --- clocks ----------------------------------------------------------------------------------------------------------


@again
def readings_stamped_on_arrival(w: Works, rng: np.random.Generator) -> Case:
    """Readings all the time, stamped where they are received, a third of a second after they were taken."""
    q, again = w.postures(90)
    session = w.observe(q, again, noise_mm=0.0, noise_mrad=0.0, repeat=0.0)
    rate, half, late = 25.0, 0.5 * PERIOD, 0.35
    when = np.arange(0.0, PERIOD, 1.0 / rate)
    u = np.clip(when / half, 0.0, 1.0)[:, None]
    course = 10 * u**3 - 15 * u**4 + 6 * u**5
    reached = q + rng.normal(0, REPEAT, q.shape)

    def way(ends: Array) -> Array:
        start = np.concatenate([ends[:1] - 0.1, ends[:-1]])
        return (start[:, None] + course * (ends - start)[:, None]).reshape(-1, w.arm.n)

    t = np.round((session.t[:, None] - half + when).ravel(), 6)
    seen = w.cell.poses(Stations(way(reached), t, np.ones_like(way(q))), ())
    missed = w.cell.poses(Stations(reached, session.t, np.ones_like(q)), ()).p - session.p
    p = seen.p + rng.normal(0, 2e-5, seen.p.shape)
    R = seen.R * Rotation.from_rotvec(rng.normal(0, 2e-5, seen.p.shape))
    unknown = np.full((len(t), w.arm.n), np.nan)
    stamps, read = BEGIN + t, BEGIN + t + late
    joints = JointTrack(w.names, stamps, way(q), unknown, unknown, stamps)
    reading = ReadingTrack(session.kind, session.frame, read, np.concatenate([p, R.as_quat()], axis=1), read)
    floor = float(np.hypot(1e3 * np.sqrt(np.mean(np.sum(missed**2, axis=1))), 0.035 / np.sqrt(25.0)))
    whole = Recording((joints,), (reading,), (), session.urdf)
    return calibrated(_written(replace(session, floor_mm=floor), whole), CLOCK, shown="if left")


@again
def stamps_of_whole_seconds(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's export cuts stamps to whole seconds; the arm stands for two."""
    session = _dwells(w, 90, begin=0.5)
    whole = session.recording()
    (reading,) = whole.readings
    cut = np.floor(reading.stamps)
    track = ReadingTrack(reading.kind, reading.frame, cut, reading.values, cut)
    return calibrated(_written(session, replace(whole, readings=(track,))), CLOCK, shown="if left")


# --- instruments -----------------------------------------------------------------------------------------------------


@again
def beam_bends_while_the_air_warms(w: Works, rng: np.random.Generator) -> Case:
    """Sun on the floor: the beam is bent upwards, by the square of its length, ever more."""
    session = w.clean(150)
    up = w.cell.tracker[1].inv().apply([0.0, 0.0, 1.0])
    far = np.sum(session.p**2, axis=1, keepdims=True)
    warm = (session.t / session.t[-1])[:, None]
    return calibrated(replace(session, p=session.p + 8e-5 * warm * far * up), (*TRACKER, *BASE, r"\btime\b", "drift"))


@again
def range_constant_wrong(w: Works, rng: np.random.Generator) -> Case:
    """The constant of another ball is set in the tracker: every distance is two millimetres too long."""
    session = w.clean(150)
    along = session.p / np.linalg.norm(session.p, axis=1, keepdims=True)
    return calibrated(replace(session, p=session.p + 2e-3 * along), (*TRACKER, r"\bbase\b", "scale"), shown="if left")


@again
def tracker_warms_up(w: Works, rng: np.random.Generator) -> Case:
    """A tracker that was just switched on: its scale settles by 150 ppm."""
    session = w.clean(150)
    scale = 1.0 + 1.5e-4 * np.exp(-session.t[:, None] / 150.0)
    return calibrated(replace(session, p=session.p * scale), (*TRACKER, *BASE, "scale", r"\btime\b", "drift"))


@again
def tracker_changes_face(w: Works, rng: np.random.Generator) -> Case:
    """A tracker that was never adjusted looks with either face, whichever is nearer: 0.15 mrad to one side or other."""
    session = w.clean(150)
    turn = 1.5e-4 * rng.choice([-1.0, 1.0], 150)
    p = Rotation.from_rotvec(np.outer(turn, [0.0, 0.0, 1.0])).apply(session.p)
    return calibrated(replace(session, p=p), (*TRACKER, *LEFT_OUT, r"\breturns?\b", r"\bjump"))


@again
def lens_distorts(w: Works, rng: np.random.Generator) -> Case:
    """A camera whose lens was calibrated for its middle: towards the rim points stand too far out."""
    session = w.clean(160)
    middle = session.p.mean(axis=0) / np.linalg.norm(session.p.mean(axis=0))
    depth = session.p @ middle
    across = session.p - depth[:, None] * middle
    radius = np.linalg.norm(across, axis=1, keepdims=True) / depth[:, None]
    return calibrated(replace(session, p=session.p + 0.02 * radius**2 * across), (*TRACKER, *BASE, r"\breading"))


@again
def planar_marker_flips(w: Works, rng: np.random.Generator) -> Case:
    """A flat marker may be seen tilted one way or the other: a fifth of the orientations took the wrong one."""
    session = w.clean(150)
    sight = session.p / np.linalg.norm(session.p, axis=1, keepdims=True)
    normal = session.R.apply([0.0, 0.0, 1.0])
    along = np.sum(normal * sight, axis=1, keepdims=True)
    flipped = 2.0 * along * sight - normal
    axis = np.cross(normal, flipped)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arccos(np.clip(np.sum(normal * flipped, axis=1), -1.0, 1.0))
    wrong = rng.random(150) < 0.2
    turn = Rotation.from_rotvec(np.where(wrong, angle, 0.0)[:, None] * axis)
    return calibrated(replace(session, R=turn * session.R), (*ORIENTATION, *LEFT_OUT))


# --- arms and stands -------------------------------------------------------------------------------------------------


@again
def brakes_let_the_arm_down(w: Works, rng: np.random.Generator) -> Case:
    """Brakes close before the reading and two joints drop by their free play, whichever way their load pulls."""

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        load = arm.holding(arm.coordinates(stations.q))[..., 3]
        deviation.x[:, 1:3, 3] -= 3e-4 * np.sign(load[:, 1:3])

    return calibrated(w.clean(160, bend), (*LOAD, *w.names[1:3]))


@again
def gear_worn_in_one_half(w: Works, rng: np.random.Generator) -> Case:
    """The second joint's gear errs in the half of its range in which it has always worked."""
    middle = w.arm.range[:, 1].mean()
    worn = w.joint(1, lambda s: 7e-4 * np.sin(17.0 * s.q[:, 1]) * (s.q[:, 1] > middle))
    return calibrated(w.clean(200, worn), (w.names[1],))


@again
def gear_error_grows_with_load(w: Works, rng: np.random.Generator) -> Case:
    """A gear's error is as large as the load on its teeth."""
    i, cycles = w.any_joint(1, 4), int(rng.integers(5, 30))

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        load = arm.holding(arm.coordinates(stations.q))[:, i, 3]
        size = 5e-4 * load / np.sqrt(np.mean(load**2))
        deviation.x[:, i, 3] += size * np.sin(cycles * stations.q[:, i])

    return calibrated(w.clean(200, bend), (w.names[i],))


@again
def pulley_of_an_odd_ratio(w: Works, rng: np.random.Generator) -> Case:
    """A pulley out of centre that turns 2.37 times as fast as its joint."""
    i = w.any_joint(0, 4)
    return calibrated(w.clean(160, w.joint(i, lambda s: 6e-4 * np.sin(2.37 * s.q[:, i] + 0.5))), (w.names[i],))


@again
def differential_wrist_with_backlash(w: Works, rng: np.random.Generator) -> Case:
    """Two wrist joints share a bevel gear: its backlash goes with the sum of their motions."""
    i = w.arm.n - 3

    def off(stations) -> Array:  # type: ignore[no-untyped-def]
        move = np.diff(stations.q, axis=0, prepend=w.arm.range.mean(axis=0)[None])
        return 5e-4 * np.sign(move[:, i] + move[:, i + 1])

    return calibrated(w.clean(180, w.joint(i + 1, off)), (w.names[i], w.names[i + 1]))
