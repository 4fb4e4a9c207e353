"""The sixth group of kinds that were written after the last change to the code, with their words, and run once.

Drawn up by class: conventions, regimes, joint columns, motion, description, instrument, mixed sources, use, loads,
drivers, and what the data cannot show; motion, sockets, draw wires and a Delta, which have generators of their own, are
in ``fresh_sixth_cells``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from case import Case, calibrated, kind
from conventions import ORIENTATION, QUATERNION
from fault import Stations
from fresh_fourth import _joints
from fresh_third import _joint_block
from physics import tilted
from regimes import BASE, TOOL
from scipy.spatial.transform import Rotation
from workcell import NOISE_MRAD, Array, Session, Works, from_

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
