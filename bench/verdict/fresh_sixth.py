"""The sixth group of kinds that were written after the last change to the code, with their words, and run once.

Drawn up by class: conventions, regimes, joint columns, motion, description, instrument, mixed sources, use, loads,
drivers, and what the data cannot show; motion, sockets, draw wires and a Delta, which have generators of their own, are
in ``fresh_sixth_cells``.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from arm import GROW, TURN, Arm
from case import Case, calibrated, frozen, kind
from conventions import ORIENTATION, QUATERNION
from fresh_fifth import CARRIED, ROWS, UNRELATED
from fresh_fourth import READINGS, _joints
from fresh_third import _joint_block
from physics import LOAD, tilted
from regimes import BASE, TOOL
from scenarios import Stations
from scipy.spatial.transform import Rotation
from workcell import BEGIN, NOISE_MRAD, PERIOD, Array, Bend, Session, Works, from_

from modcal_core.measurements.recording import (
    SignalTrack,
)

TIMING = (r"\bclock", r"\bstamp", "latency", "delay", r"\btim(?:e|es|ing)\b")
ORIENTED = (*ORIENTATION, *QUATERNION)
sixth = kind("fresh_sixth")


def _known(values: Array) -> Callable[[object], Array]:
    """An error that belongs to the stations by number."""
    return lambda stations: values


def _described(session: Session, old: str, new: str) -> Session:
    assert old in session.urdf
    assert old != new
    return replace(session, urdf=session.urdf.replace(old, new))


def _inner(w: Works) -> int:
    """A joint that is neither the first nor the last."""
    return w.any_joint(1, w.arm.n - 1)


def _axes(forward: Array, rng: np.random.Generator, elevation: float = 0.0) -> Rotation:
    """An instrument's axes (columns in the reading's frame) that sees a direction at azimuth 0 and an elevation."""
    x = forward / np.linalg.norm(forward)
    z = np.cross(x, rng.normal(size=3))
    z /= np.linalg.norm(z)
    upright = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1))
    return upright * Rotation.from_euler("y", elevation)


# --- conventions -----------------------------------------------------------------------------------------------------


@sixth
def scalar_part_recomputed(w: Works, rng: np.random.Generator) -> Case:
    """A compact log keeps x, y, z of quaternions of either sign; w is recomputed later, always as positive."""
    session = w.clean(140)
    quat = session.R.as_quat() * rng.choice([-1.0, 1.0], (140, 1))
    quat[:, 3] = np.abs(quat[:, 3])
    return calibrated(replace(session, values=np.concatenate([session.p, quat], axis=1)), ORIENTED)


@sixth
def gibbs_vector_as_rotation_vector(w: Works, rng: np.random.Generator) -> Case:
    """An instrument writes axis times tan(angle/2), which is taken for axis times angle."""
    session = w.clean(140)
    v = session.R.as_rotvec()
    angle = np.linalg.norm(v, axis=1, keepdims=True)
    return calibrated(replace(session, R=Rotation.from_rotvec(v / angle * np.tan(0.49 * angle))), ORIENTED)


@sixth
def euler_angles_in_gons(w: Works, rng: np.random.Generator) -> Case:
    """A surveyor's Euler angles count 400 to the turn, and are read as degrees."""
    session = w.clean(140)
    R = Rotation.from_euler("xyz", session.R.as_euler("xyz") / 0.9)
    return calibrated(replace(session, R=R), (*ORIENTED, r"\bgons?\b"))


@sixth
def quaternion_signs_averaged(w: Works, rng: np.random.Generator) -> Case:
    """Each row is the mean of four readings, whose quaternions came with either sign: some means are nothing."""
    session = w.clean(150)
    quat = np.zeros((150, 4))
    for _ in range(4):
        R = session.R * Rotation.from_rotvec(rng.normal(0, 1e-3 * NOISE_MRAD, (150, 3)))
        quat += rng.choice([-1.0, 1.0], (150, 1)) * R.as_quat(canonical=True)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return calibrated(replace(session, R=Rotation.from_quat(quat)), ORIENTED)


@sixth
def joint_as_share_of_its_range(w: Works, rng: np.random.Generator) -> Case:
    """A driver gives one joint as a number from 0 to 1, from one end of its travel to the other."""
    session, i = w.clean(140), _inner(w)
    low, high = w.arm.range[:, i]
    return calibrated(_joints(session, i, (session.q[:, i] - low) / (high - low)), (w.names[i],))


@sixth
def dial_in_degrees_and_minutes(w: Works, rng: np.random.Generator) -> Case:
    """A joint is read from a dial in degrees and minutes, and 12° 30' is typed as 12.30."""
    session, i = w.clean(150), _inner(w)
    degrees = np.degrees(np.abs(session.q[:, i]))
    typed = np.floor(degrees) + (degrees % 1.0) * 0.6
    return calibrated(_joints(session, i, np.sign(session.q[:, i]) * np.radians(typed)), (w.names[i],))


@sixth
def counter_wraps(w: Works, rng: np.random.Generator) -> Case:
    """A joint's counter of 16 bits has 23 406 counts a radian: beyond 1.4 rad it begins at the other end."""
    session, i = w.clean(150), _inner(w)
    middle = w.arm.range[:, i].mean()
    wrapped = (session.q[:, i] - middle + 1.4) % 2.8 - 1.4 + middle
    return calibrated(_joints(session, i, wrapped), (w.names[i],))


@sixth
def names_counted_from_zero(w: Works, rng: np.random.Generator) -> Case:
    """A list of joints that begins at 0 was read as one that begins at 1: each column has its neighbour's name."""
    session = w.clean(140)
    words = (r"\border\b", "cycl", "permut", "swapped", "exchanged", "another joint", *w.names)
    return calibrated(replace(session, q=np.roll(session.q, -1, axis=1)), words)


# --- regimes ---------------------------------------------------------------------------------------------------------


@sixth
def tared_four_times(w: Works, rng: np.random.Generator) -> Case:
    """The tracker was set to zero on the target where it was, at the beginning and after each break."""
    session = w.clean(150)
    p, R = session.p.copy(), session.R.as_matrix()
    for a, b in ((0, 42), (42, 77), (77, 118), (118, 150)):
        zero = session.R[a].inv()
        p[a:b] = zero.apply(session.p[a:b] - session.p[a])
        R[a:b] = (zero * session.R[a:b]).as_matrix()
    return calibrated(replace(session, p=p, R=Rotation.from_matrix(R)), BASE)


@sixth
def bolted_one_hole_further(w: Works, rng: np.random.Generator) -> Case:
    """For cleaning the tool was taken off, and screwed on again one hole of the flange further: 60 degrees."""
    at, R = w.cell.tool
    turn = Rotation.from_euler("z", 60, degrees=True)
    shift = R.inv().apply(turn.apply(at) - at)
    return calibrated(w.clean(150, w.tool(shift, (R.inv() * turn * R).as_rotvec(), from_(95))), TOOL)


@sixth
def docks_anew(w: Works, rng: np.random.Generator) -> Case:
    """The arm rides on a vehicle that left its dock three times and came back to 3 mm and 3 mrad."""
    bends = []
    for a, b in ((38, 71), (71, 112), (112, 150)):
        shift = np.r_[rng.normal(0, 3e-3, 2), 0.0]

        def inside(s: Stations, a: int = a, b: int = b) -> Array:
            return (np.arange(len(s.t)) >= a) & (np.arange(len(s.t)) < b)

        bends.append(w.base(shift, np.r_[0.0, 0.0, rng.normal(0, 3e-3)], inside))
    return calibrated(w.clean(150, *bends), BASE)


@sixth
def zero_off_for_a_while(w: Works, rng: np.random.Generator) -> Case:
    """After an emergency stop one joint is 1.5 mrad off, until somebody references it again 45 stations later."""
    i = w.any_joint(1, 4)
    off = 1.5e-3 * ((np.arange(150) >= 52) & (np.arange(150) < 97))
    return calibrated(w.clean(150, w.joint(i, _known(off))), (w.names[i],))


@sixth
def pedestal_pin_has_play(w: Works, rng: np.random.Generator) -> Case:
    """The pedestal turns on its pin by 0.7 mrad, to the side of the last move of the first joint."""
    q, again = w.postures(150)
    side = np.sign(np.diff(q[:, 0], prepend=w.arm.range[:, 0].mean()))
    turn = 3.5e-4 * np.outer(side, [0.0, 0.0, 1.0])
    return calibrated(w.observe(q, again, tilted(w, lambda s: turn)), (*BASE, w.names[0], w.arm.parents[0]))


# --- joint columns ---------------------------------------------------------------------------------------------------


@sixth
def joint_reported_after_large_changes(w: Works, rng: np.random.Generator) -> Case:
    """A fieldbus sends one joint only when it has changed by more than 0.3 rad; else the last value stands."""
    session, i = w.clean(150), _inner(w)
    q, last = session.q[:, i].copy(), session.q[0, i]
    for k, x in enumerate(q):
        last = x if abs(x - last) > 0.3 else last
        q[k] = last
    return calibrated(_joints(session, i, q), (w.names[i],))


@sixth
def motor_turn_miscounted(w: Works, rng: np.random.Generator) -> Case:
    """At one station in seven a joint's multi-turn counter is a motor turn off, 1/101 of the joint's, either way."""
    session, i = w.clean(150), w.any_joint(0, 4)
    off = np.zeros(150)
    off[rng.choice(150, 21, replace=False)] = 2 * np.pi / 101
    return calibrated(_joints(session, i, session.q[:, i] + rng.choice([-1.0, 1.0], 150) * off), (w.names[i],))


@sixth
def linkage_bars_unequal(w: Works, rng: np.random.Generator) -> Case:
    """The third joint is driven by a parallelogram from the base, whose bars differ: it errs with both angles."""

    def off(s: Stations) -> Array:
        return 7e-4 * np.sin(s.q[:, 1] + s.q[:, 2] + 0.3) + 3e-4 * np.cos(2.0 * (s.q[:, 1] + s.q[:, 2]))

    return calibrated(w.clean(170, w.joint(2, off)), (w.names[1], w.names[2]))


@sixth
def encoder_disc_scratched(w: Works, rng: np.random.Generator) -> Case:
    """Over a sixth of its travel one joint's encoder is off by 0.9 mrad, with sharp edges."""
    i = w.any_joint(0, 4)
    low, high = w.arm.range[:, i]

    def off(s: Stations) -> Array:
        u = (s.q[:, i] - low) / (high - low)
        return 9e-4 * ((u > 0.55) & (u < 0.72))

    return calibrated(w.clean(170, w.joint(i, off)), (w.names[i],))


# --- description -----------------------------------------------------------------------------------------------------


@sixth
def origin_misdrawn(w: Works, rng: np.random.Generator) -> Case:
    """In the URDF one joint's origin is 12 mm beside its place. A calibration may take that up."""
    session, i = w.clean(140), _inner(w)
    block = _joint_block(session, w.names[i])
    found = re.search(r'<origin[^>]*xyz="([^"]*)"', block)
    assert found is not None
    xyz = np.array([float(v) for v in found[1].split()]) + w.way(0.012)
    drawn = block.replace(f'xyz="{found[1]}"', f'xyz="{" ".join(f"{v:.6f}" for v in xyz)}"')
    words = (w.names[i], w.arm.links[i], w.arm.parents[i])
    return calibrated(_described(session, block, drawn), words, shown="if left")


@sixth
def joint_declared_fixed(w: Works, rng: np.random.Generator) -> Case:
    """A URDF that was made for a cell in which one joint is locked: its type is fixed, while here it moves."""
    session, i = w.clean(140), _inner(w)
    block = _joint_block(session, w.names[i])
    fixed = re.sub(r'type="(?:revolute|continuous)"', 'type="fixed"', block)
    return calibrated(_described(session, block, fixed), (w.names[i],))


@sixth
def joint_declared_prismatic(w: Works, rng: np.random.Generator) -> Case:
    """By a slip of the pen one joint slides in the URDF."""
    session, i = w.clean(140), _inner(w)
    block = _joint_block(session, w.names[i])
    sliding = re.sub(r'type="(?:revolute|continuous)"', 'type="prismatic"', block)
    return calibrated(_described(session, block, sliding), (w.names[i],))


@sixth
def mimic_tag_left_in(w: Works, rng: np.random.Generator) -> Case:
    """The URDF of a palletiser, whose last joint but one is said to follow another; here it has a motor."""
    session, i = w.clean(140), w.arm.n - 2
    block = _joint_block(session, w.names[i])
    tag = f'<mimic joint="{w.names[1]}" multiplier="-1"/></joint>'
    words = (w.names[i], "mimic")
    return calibrated(_described(session, block, block.replace("</joint>", tag)), words, shown="if left")


# --- instrument ------------------------------------------------------------------------------------------------------


@sixth
def line_of_sight_not_square(w: Works, rng: np.random.Generator) -> Case:
    """A tracker's beam is not square to its tilting axis: azimuths are off by 0.5 mrad over the elevation's cosine."""
    session = w.clean(160)
    axes = _axes(session.p.mean(axis=0), rng, np.radians(-40))
    x, y, z = axes.inv().apply(session.p).T
    turn = Rotation.from_rotvec(np.outer(5e-4 * np.sqrt(1.0 + z**2 / (x**2 + y**2)), [0.0, 0.0, 1.0]))
    return calibrated(replace(session, p=(axes * turn * axes.inv()).apply(session.p)), (*READINGS, *BASE))


@sixth
def principal_point_wrong(w: Works, rng: np.random.Generator) -> Case:
    """A camera's principal point is two pixels of a thousand off: positions are sheared with their depth."""
    session = w.clean(160)
    forward = session.p.mean(axis=0) / np.linalg.norm(session.p.mean(axis=0))
    side = np.cross(forward, w.way(1.0))
    p = session.p + 2e-3 * np.outer(session.p @ forward, side / np.linalg.norm(side))
    return calibrated(replace(session, p=p), (*READINGS, *BASE))


@sixth
def disparity_in_steps(w: Works, rng: np.random.Generator) -> Case:
    """A stereo camera tells depth from a disparity in steps of 1/48 pixel: a millimetre or two at three metres."""
    session = w.clean(160)
    forward = session.p.mean(axis=0) / np.linalg.norm(session.p.mean(axis=0))
    depth = session.p @ forward
    coarse = 120.0 / (np.round(48.0 * 120.0 / depth) / 48.0)
    words = (*READINGS, "digit", "resolution", "quanti", "round", "depth", "distance", "coarse", r"\bsteps of\b")
    return calibrated(replace(session, p=session.p * (coarse / depth)[:, None]), words)


@sixth
def markers_of_the_body_exchanged(w: Works, rng: np.random.Generator) -> Case:
    """At one station in six a mocap system takes two markers for each other: the body is half a turn and 4 mm off."""
    session = w.clean(150)
    rows = rng.choice(150, 25, replace=False)
    p, R = session.p.copy(), session.R.as_matrix()
    R[rows] = (session.R[rows] * Rotation.from_rotvec(w.way(np.pi))).as_matrix()
    p[rows] += session.R[rows].apply(w.way(4e-3))
    return calibrated(replace(session, p=p, R=Rotation.from_matrix(R)), (*TOOL, *QUATERNION, "target"))


@sixth
def hot_cabinet_under_the_beam(w: Works, rng: np.random.Generator) -> Case:
    """Over a warm cabinet the air bends the beam: in a region of 25 cm the target is seen up to 1.2 mm beside."""
    session = w.clean(180)
    centre = session.p[np.argsort(np.linalg.norm(session.p - session.p.mean(axis=0), axis=1))[30]]
    near = np.exp(-0.5 * (np.linalg.norm(session.p - centre, axis=1) / 0.25) ** 2)
    return calibrated(replace(session, p=session.p + np.outer(near, w.way(1.2e-3))), (*READINGS, *BASE))


@sixth
def compass_deviates(w: Works, rng: np.random.Generator) -> Case:
    """Orientations come from a sensor on the tool whose heading deviates by up to 4 mrad, twice a turn."""
    session = w.clean(160)
    yaw, pitch, roll = session.R.as_euler("ZYX").T
    R = Rotation.from_euler("ZYX", np.stack([yaw + 4e-3 * np.sin(2.0 * yaw + 0.5), pitch, roll], axis=1))
    return calibrated(replace(session, R=R), (*QUATERNION, *READINGS))


@sixth
def beam_locked_anew_at_other_distances(w: Works, rng: np.random.Generator) -> Case:
    """The beam was broken every eighteen stations or so; each time the distance came back some tenths off."""
    session = w.clean(160)
    ends = np.unique(np.r_[np.arange(18, 150, 18) + rng.integers(-4, 5, 8)])
    off = rng.normal(0, 6e-4, len(ends) + 1)[np.searchsorted(ends, np.arange(160), side="right")]
    r = np.linalg.norm(session.p, axis=1)
    words = (*READINGS, *BASE, "distance", r"\brange\b")
    return calibrated(replace(session, p=session.p * (1.0 + off / r)[:, None]), words)


# --- mixed sources ---------------------------------------------------------------------------------------------------


def _drawn(w: Works) -> Works:
    """The cell with the arm of the drawing, tool and tracker being known: that of a controller or a simulation."""
    twin = copy.copy(w)
    twin.cell = copy.copy(w.cell)
    twin.cell.arm = twin.arm = Arm(w.robot)
    return twin


@sixth
def lost_sight_filled_from_the_controller(w: Works, rng: np.random.Generator) -> Case:
    """Where the tracker lost the target a script took the pose that the controller computes from the joints."""
    session = w.clean(160)
    computed = _drawn(w).cell.poses(Stations(session.q, session.t, np.zeros_like(session.q)), ())
    rows = rng.random(160) < 0.25
    p = np.where(rows[:, None], computed.p, session.p)
    R = Rotation.from_matrix(np.where(rows[:, None, None], computed.R.as_matrix(), session.R.as_matrix()))
    return calibrated(replace(session, p=p, R=R), ("comput", "calculat", "controller", "nominal arm"))


@sixth
def also_a_simulation(w: Works, rng: np.random.Generator) -> Case:
    """--also a recording of the simulated cell, which is the drawing without any noise."""
    q, again = _drawn(w).postures(80)
    second = _drawn(w).observe(q, again, begin=3600.0, noise_mm=0.0, noise_mrad=0.0, repeat=0.0)
    steps = (("calibrate", "{first}", "--also", "{second}"),)
    words = ("comput", "calculat", "simulat", "second", r"\brecordings\b", r"\bstep\b", *BASE)
    first = w.clean(90)
    return Case({"first": first, "second": second}, steps, True, words, floor_mm=first.floor_mm)


@sixth
def also_one_row_late(w: Works, rng: np.random.Generator) -> Case:
    """--also a recording in which every reading stands in the row before its own."""
    second = w.clean(80, begin=3600.0)
    late = replace(second, p=np.roll(second.p, -1, axis=0), R=second.R[np.roll(np.arange(80), -1)])
    steps = (("calibrate", "{first}", "--also", "{second}"),)
    words = (*ROWS, *UNRELATED, "second", r"\brecordings\b")
    return Case({"first": w.clean(90), "second": late}, steps, True, words)


# --- use -------------------------------------------------------------------------------------------------------------


@sixth
def hot_hall_today(w: Works, rng: np.random.Generator) -> Case:
    """Calibrated in winter; today every link is 0.3 mm longer a metre. The base is found again."""

    def grown(arm: Arm, stations: Stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.x[:, :, GROW] += 3e-4 * arm.lengths

    words = ("scale", r"\bgrow", "thermal", "temperature", "length", *w.names[1:4], *w.arm.links[:3])
    return frozen(w.clean(130), w.clean(90, grown, begin=15_000_000.0), words, "--refit-base")


@sixth
def joint_softer_today(w: Works, rng: np.random.Generator) -> Case:
    """An elastic arm whose second joint had its belt exchanged for one half as stiff."""
    sample = w.arm.coordinates(rng.uniform(*w.arm.range, (60, w.arm.n)))
    rms = np.sqrt(np.mean(w.arm.holding(sample)[..., TURN] ** 2, axis=0))
    stiffness = np.maximum(rms, 0.1 * rms.max()) / 4e-4
    softer = np.where(np.arange(w.arm.n) == 1, 0.4 * stiffness, stiffness)

    def elastic(k: Array) -> Bend:
        def bend(arm: Arm, stations: Stations, deviation) -> None:  # type: ignore[no-untyped-def]
            deviation.linear[:, TURN] = k

        return bend

    return frozen(w.clean(150, elastic(stiffness)), w.clean(90, elastic(softer), begin=86_400.0), (w.names[1],))


@sixth
def motor_turn_lost_today(w: Works, rng: np.random.Generator) -> Case:
    """The battery of one joint's encoder ran out, and the joint was put back one motor turn off, 1/121 of its own."""
    i, second = w.any_joint(1, 4), w.clean(80, begin=86_400.0)
    today = _joints(second, i, second.q[:, i] + 2 * np.pi / 121)
    return frozen(w.clean(120), today, (w.names[i],))


@sixth
def turned_over_today(w: Works, rng: np.random.Generator) -> Case:
    """A slender probe that sags was calibrated pointing downwards, and points upwards today."""
    q = rng.uniform(*w.arm.range, (900, w.arm.n))
    _, R = w.arm.frames(w.arm.coordinates(q))
    up = (R[:, -1] @ w.cell.tool[1].as_matrix())[:, 2]  # the vertical along the tool's axes

    def sagging(arm: Arm, stations: Stations, deviation) -> None:  # type: ignore[no-untyped-def]
        _, R = arm.frames(deviation.x)
        vertical = (R[:, -1] @ w.cell.tool[1].as_matrix())[:, 2]
        deviation.tool[:, :2] -= 6e-4 * np.abs(vertical[:, 2:]) * vertical[:, :2] + 4e-4 * np.maximum(
            vertical[:, 2:], 0
        )

    down, over = q[up[:, 2] < -0.5][:120], q[up[:, 2] > 0.5][:74]
    first = w.observe(*w.with_returns(down), sagging)
    second = w.observe(*w.with_returns(over), sagging, begin=86_400.0)
    words = (*TOOL, *w.arm.hand, "outside", "beyond", "flange")
    return frozen(first, second, words, shown="if left")


# --- loads -----------------------------------------------------------------------------------------------------------


@sixth
def touches_the_table_when_low(w: Works, rng: np.random.Generator) -> Case:
    """In its lowest postures the tool rests on the table, which lifts it: by up to a millimetre."""
    q, again = w.postures(160)
    p, R = w.arm.frames(w.arm.coordinates(q))
    height = (p[:, -1] + R[:, -1] @ w.cell.tool[0])[:, 2]
    deep = np.maximum(np.quantile(height, 0.22) - height, 0.0)
    lift = 1.2e-3 * deep / deep.max()

    def bend(arm: Arm, stations: Stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tracker[:, 2] -= lift

    words = (*TOOL, *BASE, "height", "contact", *w.names[1:3])
    return calibrated(w.observe(q, again, bend), words)


@sixth
def valve_block_on_the_forearm(w: Works, rng: np.random.Generator) -> Case:
    """On the forearm of an elastic arm sits a valve block of 9 kg that no description knows."""
    body = w.arm._model.body(w.arm.links[2]).id
    elastic = w.elastic(5e-4)  # the springs are those of the arm without it
    w.arm._model.body_mass[body] += 9.0
    w.arm.carry(0.0)
    words = (*CARRIED, w.arm.links[2], r"\bkg\b", r"\bmass")
    return calibrated(w.clean(160, elastic), words, shown="if left")


def _pressing(w: Works, q: Array, force: Array) -> Array:
    """Torques (N, n) by which forces (N) along the tool's axis, at its point, turn the joints."""

    def point(q: Array) -> tuple[Array, Array]:
        p, R = w.arm.frames(w.arm.coordinates(q))
        return p[:, -1] + R[:, -1] @ w.cell.tool[0], (R[:, -1] @ w.cell.tool[1].as_matrix())[:, :, 2]

    at, axis = point(q)
    out = np.empty_like(q)
    for i in range(w.arm.n):
        step = np.zeros(w.arm.n)
        step[i] = 1e-6
        out[:, i] = force * np.sum((point(q + step)[0] - at) / 1e-6 * -axis, axis=1)
    return out


@sixth
def presses_while_measured(w: Works, rng: np.random.Generator) -> Case:
    """At a third of the stations the tool presses on the part with 60 to 120 N, which the recorded efforts show."""
    q, again = w.postures(160)
    kinds = np.unique(q, axis=0, return_inverse=True)[1].ravel()
    force = (rng.uniform(60.0, 120.0, 160) * (rng.random(160) < 0.35))[kinds]
    torque = _pressing(w, q, force)

    def bend(arm: Arm, stations: Stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.x[:, :, TURN] += torque / 6e4

    session = w.observe(q, again, bend, effort=True)
    assert session.effort is not None
    words = ("effort", "torque", "force", *LOAD, *w.names)
    return calibrated(replace(session, effort=session.effort - torque), words)


# --- drivers ---------------------------------------------------------------------------------------------------------


@sixth
def supply_voltage_sags(w: Works, rng: np.random.Generator) -> Case:
    """A joint's potentiometer hangs on the battery, whose voltage is recorded: it falls, and was charged once."""
    i, q, again = w.any_joint(0, 4), *w.postures(160)
    clock = np.arange(0.0, 160 * PERIOD + 1.0, 2.0)
    volt = 25.6 - 2.2 * (clock / clock[-1]) + 1.4 * (clock > 0.6 * clock[-1]) + 0.3 * np.sin(clock / 40.0)
    session = w.observe(q, again)
    scale = 1.0 + 1.2e-3 * (np.interp(session.t, clock, volt) - 24.6)
    signal = SignalTrack("/battery/voltage", BEGIN + clock, volt[:, None], "/battery/voltage")
    session = replace(_joints(session, i, session.q[:, i] * scale), signals=(signal,))
    return calibrated(session, (w.names[i], "battery", "volt"))


@sixth
def turntable_recorded_but_not_described(w: Works, rng: np.random.Generator) -> Case:
    """The arm stands on a turntable, whose angle is in the joint states and whose joint is in no URDF."""
    q, again = w.postures(160)
    angle = rng.uniform(-0.5, 0.5, 20)[np.arange(160) // 8]
    stand, pin = w.cell.tracker[0], np.array([0.35, -0.2, 0.0])

    def bend(arm: Arm, stations: Stations, deviation) -> None:  # type: ignore[no-untyped-def]
        back = Rotation.from_rotvec(np.outer(-angle, [0.0, 0.0, 1.0]))
        deviation.tracker[:, :3] += pin + back.apply(stand - pin) - stand
        deviation.tracker[:, 3:] += back.as_rotvec()

    session = replace(w.observe(q, again, bend), more={"table_joint": angle})
    return calibrated(session, ("table_joint", *BASE, w.names[0]), floor=False)


@sixth
def thermostat_cycles(w: Works, rng: np.random.Generator) -> Case:
    """A heater under the stand goes on and off every 95 s: the arm goes up and down by some tenths of a millimetre."""
    phase = rng.uniform(0, 95.0)

    def saw(s: Stations) -> Array:
        u = (s.t + phase) / 95.0 % 1.0
        return np.where(u < 0.3, u / 0.3, (1.0 - u) / 0.7)

    words = (*BASE, "rhythm", "period", "cycl", r"\btime\b", "drift")
    return calibrated(w.clean(170, w.base(w.way(9e-4), w.way(2e-4), saw)), words)


# --- what the data cannot show: anything but calm will do ------------------------------------------------------------


@sixth
def thirteen_stations_and_a_worn_gear(w: Works, rng: np.random.Generator) -> Case:
    """Thirteen poses of an arm whose second joint errs five times a turn: geometry alone can take that up."""
    bend = w.joint(1, lambda s: 5e-4 * np.sin(5.0 * s.q[:, 1] + 0.7))
    return calibrated(w.clean(13, bend, returns=0), ("station", "readings", "parameters", w.names[1]), shown=False)


@sixth
def all_postures_alike(w: Works, rng: np.random.Generator) -> Case:
    """Only a few degrees of each joint were used of an arm that is elastic: the rest cannot be known from there."""
    session = w.observe(*w.postures(90, 0, 0.48, 0.52), w.elastic(8e-4))
    return calibrated(session, ("range", "posture", "small", "narrow", *w.names), shown="if left")
