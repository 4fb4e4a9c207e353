"""Kinds that were written after the last change to the code, with their words, and run once (see README).

What laboratories get wrong: exports, drivers, mountings, targets, statements. None is a variant of a kind elsewhere.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace

import numpy as np
from case import Case, calibrated, frozen, kind
from conventions import ORIENTATION, QUATERNION, UNIT
from physics import LOAD
from regimes import LEFT_OUT
from scipy.spatial.transform import Rotation
from workcell import BEGIN, Array, Session, Works

from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording

TRACKER = (r"\btracker\b", r"\binstrument\b", "place of the target", "distance from", "direction in which")
TARGET = (r"\btool\b", r"\btarget\b", *TRACKER)
fresh = kind("fresh")


def _sight(session: Session) -> Array:
    """Unit vectors from the tracker to the target, as the tool sees them, (N, 3)."""
    return session.R.inv().apply(session.p / np.linalg.norm(session.p, axis=1, keepdims=True))


def _joint(session: Session, i: int, column: Array) -> Session:
    q = session.q.copy()
    q[:, i] = column
    return replace(session, q=q)


# --- joint states ----------------------------------------------------------------------------------------------------


@fresh
def joint_folded_at_a_right_angle(w: Works, rng: np.random.Generator) -> Case:
    """A driver computes a joint's angle by atan where atan2 is meant: beyond 90° it is half a turn off."""
    session, i = w.clean(130), w.any_joint(0, w.arm.n - 1)
    return calibrated(_joint(session, i, np.arctan(np.tan(session.q[:, i]))), (w.names[i],))


@fresh
def joint_clipped(w: Works, rng: np.random.Generator) -> Case:
    """A joint's reported position stops at one radian, as its soft limit says, and the joint does not."""
    session, i = w.clean(140), w.any_joint(0, 5)
    return calibrated(_joint(session, i, np.clip(session.q[:, i], -1.0, 1.0)), (w.names[i],))


@fresh
def joint_without_sign(w: Works, rng: np.random.Generator) -> Case:
    """A joint is sent as an unsigned number."""
    session, i = w.clean(130), w.any_joint(1, w.arm.n - 1)
    return calibrated(_joint(session, i, np.abs(session.q[:, i])), (w.names[i],))


@fresh
def joint_in_gons(w: Works, rng: np.random.Generator) -> Case:
    """A joint is written in gons, 400 to a turn."""
    session, i = w.clean(120), w.any_joint(0, 5)
    return calibrated(_joint(session, i, session.q[:, i] * 200.0 / np.pi), (w.names[i],))


@fresh
def motor_angle_of_a_coupled_joint(w: Works, rng: np.random.Generator) -> Case:
    """A joint's motor is reported: it turns with the joint before it as well."""
    session, i = w.clean(130), w.any_joint(1, w.arm.n - 1)
    return calibrated(_joint(session, i, session.q[:, i] + session.q[:, i - 1]), (w.names[i], w.names[i - 1]))


@fresh
def column_of_currents(w: Works, rng: np.random.Generator) -> Case:
    """The column of a joint's position holds its motor's current."""
    session, i = w.clean(130), w.any_joint(0, 5)
    return calibrated(_joint(session, i, rng.normal(0.0, 0.7, 130)), (w.names[i],))


@fresh
def tracker_in_another_time_zone(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's stamps are of another time zone than the joints'."""
    session = w.clean(100)
    own = {f.name: getattr(session, f.name) for f in fields(session)}
    return calibrated(_Zoned(**own), ("clock", "stamp", "time", "overlap"))


@dataclass(frozen=True)
class _Zoned(Session):
    """Readings that bear stamps an hour later than the joint states they belong to."""

    def recording(self) -> Recording:
        stamps = BEGIN + self.t
        unknown = np.full_like(self.q, np.nan)
        joints = JointTrack(self.names, stamps, self.q, unknown, unknown, stamps)
        late = stamps + 3600.0
        return Recording((joints,), (ReadingTrack(self.kind, self.frame, late, self.raw(), late),), (), self.urdf)


# --- readings --------------------------------------------------------------------------------------------------------


@fresh
def height_in_millimetres(w: Works, rng: np.random.Generator) -> Case:
    """z stands in millimetres, x and y in metres."""
    session = w.clean(120)
    return calibrated(replace(session, p=session.p * [1.0, 1.0, 1e3]), (*UNIT, r"\bz\b", "scale"))


@fresh
def flat_camera(w: Works, rng: np.random.Generator) -> Case:
    """A camera that knows x and y only: z is written as zero."""
    session = w.clean(120)
    return calibrated(replace(session, p=session.p * [1.0, 1.0, 0.0]), (r"\bz\b", "plane", "flat", r"\bax[ei]s\b"))


@fresh
def only_yaw_is_measured(w: Works, rng: np.random.Generator) -> Case:
    """Roll and pitch are written as zero."""
    session = w.clean(120)
    yaw = session.R.as_euler("ZYX")[:, 0]
    return calibrated(replace(session, R=Rotation.from_euler("z", yaw[:, None])), ORIENTATION)


@fresh
def vector_part_as_rotation_vector(w: Works, rng: np.random.Generator) -> Case:
    """The vector part of a quaternion was taken for a rotation vector."""
    session = w.clean(120)
    q = session.R.as_quat(canonical=True)
    return calibrated(replace(session, R=Rotation.from_rotvec(q[:, :3])), (*ORIENTATION, "quaternion"))


@fresh
def quaternions_of_two_decimals(w: Works, rng: np.random.Generator) -> Case:
    """An export writes quaternions to two decimals, positions in full."""
    session = w.clean(130)
    values = session.raw().copy()
    values[:, 3:] = np.round(values[:, 3:], 2)
    return calibrated(replace(session, values=values), (*QUATERNION, "digit", "round"))


@fresh
def positions_of_whole_millimetres(w: Works, rng: np.random.Generator) -> Case:
    """An export writes positions to a millimetre."""
    session = w.clean(130)
    return calibrated(replace(session, p=np.round(session.p, 3)), ("digit", "round", "resolution", *TRACKER))


@fresh
def lost_beam_is_zero(w: Works, rng: np.random.Generator) -> Case:
    """Where the beam is lost, at every ninth station, the reading is the origin."""
    session = w.clean(140)
    lost = (rng.random(140) < 0.11)[:, None]
    quaternions = np.where(lost, [0.0, 0.0, 0.0, 1.0], session.R.as_quat())
    lost_session = replace(session, p=np.where(lost, 0.0, session.p), R=Rotation.from_quat(quaternions))
    return calibrated(lost_session, (*LEFT_OUT, "zero", "origin", "same reading", "lost"))


@fresh
def rows_pasted_twice(w: Works, rng: np.random.Generator) -> Case:
    """The first forty rows are pasted once more at the end, with new stamps: no posture was visited again."""
    session = w.clean(120, w.joint(2, lambda s: 8e-4 * ((2.0 * s.q[:, 2]) % 1.0 - 0.5)), returns=0)
    rows = np.r_[np.arange(120), np.arange(40)]
    pasted = replace(session.only(rows), t=4.0 * np.arange(160.0))
    return calibrated(pasted, ("identical", "cop(y|ied)", "twice", "same reading", "returns show", w.names[2]))


@fresh
def tracker_filters(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's filter has not settled when it is read: some per mille of the last move are missing."""
    session = w.clean(150)
    before = np.concatenate([session.p[:1], session.p[:-1]])
    late = session.p + 8e-4 * (before - session.p)
    return calibrated(replace(session, p=late), (*TRACKER, "filter", "last move", "arrived", "previous"))


@fresh
def orientation_alone_drifts(w: Works, rng: np.random.Generator) -> Case:
    """Orientations come from a gyroscope and drift about the vertical, positions do not."""
    session = w.clean(150)
    drift = Rotation.from_rotvec(np.outer(session.t / session.t[-1], [0.0, 0.0, np.radians(0.4)]))
    return calibrated(replace(session, R=drift * session.R), (*ORIENTATION, "time", "order", "drift"))


@fresh
def orientation_of_another_body(w: Works, rng: np.random.Generator) -> Case:
    """Positions are of the target on the tool, orientations of a marker on the link before the last joint."""
    session, n = w.clean(130), w.arm.n
    axis = session.R.apply(w.cell.tool[1].inv().apply([0.0, 0.0, 1.0]))
    back = Rotation.from_rotvec(-session.q[:, [n - 1]] * axis)
    return calibrated(replace(session, R=back * session.R), (*ORIENTATION, w.names[-1], r"\btool\b"))


@fresh
def magnetic_tracker_near_iron(w: Works, rng: np.random.Generator) -> Case:
    """A magnetic tracker near a piece of iron: readings are bent around one place."""
    session = w.clean(170)
    gap = session.p - session.p[int(rng.integers(170))]
    bump = np.exp(-np.sum(gap**2, axis=1) / (2.0 * 0.25**2))[:, None]
    return calibrated(replace(session, p=session.p + 3e-3 * bump * w.way(1.0)), (*TRACKER, *LEFT_OUT))


@fresh
def seen_in_a_mirror(w: Works, rng: np.random.Generator) -> Case:
    """On one side of the cell the tracker sees the target in a mirror."""
    session, normal = w.clean(150), w.way(1.0)
    height = session.p @ normal
    wall = np.quantile(height, 0.75)
    p = session.p - 2.0 * np.maximum(height - wall, 0.0)[:, None] * normal
    return calibrated(replace(session, p=p), ("mirror", "handed", *LEFT_OUT, *TRACKER))


# --- targets and tools -----------------------------------------------------------------------------------------------


@fresh
def corner_cube_off_centre(w: Works, rng: np.random.Generator) -> Case:
    """A glass reflector's path is longer the more obliquely the beam comes in."""
    session = w.clean(150)
    along = session.p / np.linalg.norm(session.p, axis=1, keepdims=True)
    oblique = 1.0 - np.abs(_sight(session)[:, 2:])
    return calibrated(replace(session, p=session.p + 9e-4 * oblique * along), TARGET)


@fresh
def marker_hidden_from_one_side(w: Works, rng: np.random.Generator) -> Case:
    """From one side one of four balls is hidden, and the body made of the other three sits elsewhere."""
    session = w.clean(150)
    hidden = (_sight(session) @ w.way(1.0) > 0.3)[:, None]
    p = session.p + np.where(hidden, session.R.apply(w.way(7e-4)), 0.0)
    turned = session.R * Rotation.from_rotvec(np.where(hidden, w.way(3e-3), 0.0))
    return calibrated(replace(session, p=p, R=turned), TARGET)


# --- arms ------------------------------------------------------------------------------------------------------------


@fresh
def belt_slips_with_travel(w: Works, rng: np.random.Generator) -> Case:
    """A belt slips a little with all the way that its joint goes forwards."""
    i = w.any_joint(0, 4)

    def off(stations) -> Array:  # type: ignore[no-untyped-def]
        return -3e-5 * np.cumsum(np.maximum(np.diff(stations.q[:, i], prepend=stations.q[0, i]), 0.0))

    near = (w.names[max(i - 1, 0)], w.names[i], w.names[i + 1], *((r"\bbase\b",) if i == 0 else ()))
    return calibrated(w.clean(160, w.joint(i, off)), near)


@fresh
def balancer_pulls(w: Works, rng: np.random.Generator) -> Case:
    """A balancer above the cell pulls the flange of an elastic arm towards itself."""
    hook = np.array([0.4, -0.3, 2.5])

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        tip = arm.frames(deviation.x)[0][:, -1]
        pull = 40.0 * (hook - tip) / np.linalg.norm(hook - tip, axis=1, keepdims=True)
        turned = []
        for i in range(arm.n):
            x = deviation.x.copy()
            x[:, i, 3] += 1e-5
            turned.append(np.sum((arm.frames(x)[0][:, -1] - tip) / 1e-5 * pull, axis=1))
        deviation.x[..., 3] += 2e-5 * np.stack(turned, axis=1)

    return calibrated(w.clean(160, bend), (*LOAD, *w.names))


@fresh
def axis_of_the_description_wrong(w: Works, rng: np.random.Generator) -> Case:
    """In the URDF a joint turns about y in place of z."""
    session, i = w.clean(130), w.any_joint(1, w.arm.n - 1)
    whole = re.search(rf'<joint name="{w.names[i]}".*?</joint>', session.urdf, re.DOTALL)
    assert whole is not None
    x, y, z = re.search(r'<axis xyz="([^"]*)"', whole[0])[1].split()  # type: ignore[index]
    changed = re.sub(r'<axis xyz="[^"]*"', f'<axis xyz="{z} {x} {y}"', whole[0])
    urdf = session.urdf.replace(whole[0], changed)
    return calibrated(replace(session, urdf=urdf), (w.names[i],))


@fresh
def description_in_millimetres(w: Works, rng: np.random.Generator) -> Case:
    """All lengths of the URDF's joints are written in millimetres."""
    session = w.clean(120)

    def longer(found: re.Match[str]) -> str:
        return f'{found[1]}xyz="{" ".join(f"{1e3 * float(v):.9g}" for v in found[2].split())}"'

    joints = re.sub(
        r"<joint .*?</joint>",
        lambda joint: re.sub(r'(<origin [^>]*?)xyz="([^"]*)"', longer, joint[0]),
        session.urdf,
        flags=re.DOTALL,
    )
    assert joints != session.urdf
    return calibrated(replace(session, urdf=joints), (*UNIT, "URDF", "metres"))


@fresh
def remounted_on_a_wall_frozen(w: Works, rng: np.random.Generator) -> Case:
    """An elastic arm is calibrated standing and used hanging on a wall, its base found again."""
    elastic = w.elastic(8e-4)
    first = w.clean(140, elastic)
    w.arm._model.opt.gravity[:] = [9.81, 0.0, 0.0]
    second = w.clean(80, elastic, begin=90_000.0)
    return frozen(first, second, (*LOAD, *w.names, "gravity"), "--refit-base", shown="if left")


# --- statements ------------------------------------------------------------------------------------------------------


def _jagged(w: Works, i: int):  # type: ignore[no-untyped-def]
    """A joint whose error is a saw over its position and the next joint's: no entry of the vocabulary."""
    return w.joint(i, lambda s: 9e-4 * ((1.1 * s.q[:, i] + 0.9 * s.q[:, i + 1]) % 1.0 - 0.5))


@fresh
def microns_stated_as_millimetres(w: Works, rng: np.random.Generator) -> Case:
    """Repeatability and instrument are stated in micrometres where millimetres are meant, of an arm with an error."""
    i = w.any_joint(0, 4)
    session = w.clean(150, _jagged(w, i), returns=0)
    options = ("--repeatability-mm", "20", "--instrument-mm", "35", "--repeatability-deg", "2", "--instrument-deg", "2")
    return calibrated(session, ("stated", "repeatab", *w.names[i : i + 2]), *options, floor=False)


@fresh
def recorded_twice_without_leaving(w: Works, rng: np.random.Generator) -> Case:
    """Every posture is recorded twice without being left: these are no returns, and the arm has an error."""
    i = w.any_joint(0, 4)
    q, _ = w.postures(90, 0)
    session = w.observe(np.repeat(q, 2, axis=0), None, _jagged(w, i))
    return calibrated(session, (w.names[i], w.names[i + 1]), floor=False)
