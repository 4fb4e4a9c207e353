"""The fourth group of kinds that were written after the last change to the code, with their words, and run once.

Drawn up by class as the third one: conventions, time, instrument, surroundings, robot, description, data, use.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from case import Case, calibrated, frozen, kind
from conventions import ORIENTATION, QUATERNION
from fresh_again import CLOCK
from fresh_third import _joint_block, _recorded, _stream
from physics import LOAD
from regimes import BASE, TOOL
from scipy.spatial.transform import Rotation
from workcell import BEGIN, Array, Session, Works, from_

from modcal_core.measurements.recording import SignalTrack

READINGS = (
    r"\btracker",
    r"\bcamera",
    "reads wrong",
    r"readings? (?:look|depend)",
    "distance from",
    "place of the target",
)
ORDER = (r"\border\b", r"\btime\b", "changed on the way", r"\bdrift\b", r"stations \d+ to")
fourth = kind("fresh_fourth")


def _joints(session: Session, i: int, column: Array) -> Session:
    q = session.q.copy()
    q[:, i] = column
    return replace(session, q=q)


# --- conventions -----------------------------------------------------------------------------------------------------


@fourth
def positions_in_the_tools_axes(w: Works, rng: np.random.Generator) -> Case:
    """An export gives positions along the tool's own axes, orientations as they should be."""
    session = w.clean(130)
    p = session.R.inv().apply(session.p)
    return calibrated(replace(session, p=p), ("frame", "axes", "invers", "point of the tool", "position"))


@fourth
def orientations_of_the_tool_in_itself(w: Works, rng: np.random.Generator) -> Case:
    """Orientations are relative to that of the first station, on the wrong side: R R0⁻¹ is written as R0⁻¹ R."""
    session = w.clean(130)
    mixed = session.R * Rotation.from_rotvec([0.4, 0.1, -0.7]) * session.R
    return calibrated(replace(session, R=mixed), ORIENTATION)


@fourth
def two_columns_interleaved(w: Works, rng: np.random.Generator) -> Case:
    """Rows of x and z stand exchanged from some station on, after a table was sorted by its header."""
    session, k = w.clean(140, kind="point"), 80
    p = session.p.copy()
    p[k:] = p[k:][:, [2, 1, 0]]
    return calibrated(replace(session, p=p), ("swapped", "column", r"\bx\b", r"\bz\b", "mirror"))


@fourth
def three_joints_cycled_one_negated(w: Works, rng: np.random.Generator) -> Case:
    """Three joints stand under each other's names, one of them with the other sign."""
    session, i = w.clean(130), w.any_joint(0, w.arm.n - 2)
    q = session.q.copy()
    q[:, [i, i + 1, i + 2]] = q[:, [i + 2, i, i + 1]] * [1.0, -1.0, 1.0]
    return calibrated(replace(session, q=q), w.names[i : i + 3])


# --- time ------------------------------------------------------------------------------------------------------------


@fourth
def joint_states_of_the_next_station(w: Works, rng: np.random.Generator) -> Case:
    """The recorder notes the goal that comes next: from the middle on all joint states are one station ahead."""
    session = w.clean(140)
    q = session.q.copy()
    q[70:-1] = q[71:]
    words = ("early", "late", r"\brows?\b", r"\border\b", "stations 7", "station before", *CLOCK)
    return calibrated(replace(session, q=q), words)


@fourth
def tracker_stamps_every_packet_alike(w: Works, rng: np.random.Generator) -> Case:
    """Packets of thirteen readings arrive together and bear one stamp, that of the last."""
    session, t, q, p, R = _stream(w, 80)
    rows = np.minimum((np.arange(len(t)) // 13) * 13 + 12, len(t) - 1)
    read = BEGIN + t[rows] + 1e-4 * np.arange(len(t)) % 13
    return calibrated(_recorded(w, session, t, q, p, R, np.sort(read)), CLOCK, shown="if left")


@fourth
def one_joint_filtered(w: Works, rng: np.random.Generator) -> Case:
    """One joint's position is filtered: 0.2 % of its last move is missing, and 0.1 % of the one before."""
    session, i = w.clean(150), w.any_joint(0, w.arm.n - 2)
    q = session.q[:, i]
    one, two = np.r_[q[0], q[:-1]], np.r_[q[0], q[0], q[:-2]]
    return calibrated(_joints(session, i, q + 2e-3 * (one - q) + 1e-3 * (two - one)), (w.names[i],))


# --- instruments -----------------------------------------------------------------------------------------------------


@fourth
def levelling_lost(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's compensator fails half way: its readings tilt by 0.2 mrad, positions only."""
    session = w.clean(150)
    tilt = np.where(np.arange(150) < 75, 0.0, 2e-4)
    p = Rotation.from_rotvec(np.outer(tilt, w.way(1.0))).apply(session.p)
    return calibrated(replace(session, p=p), (*READINGS, *BASE))


@fourth
def encoder_of_the_tracker_off_centre(w: Works, rng: np.random.Generator) -> Case:
    """The disc of the tracker's vertical axis is off its centre: azimuths err by 0.1 mrad, once a turn."""
    session = w.clean(160)
    azimuth = np.arctan2(session.p[:, 1], session.p[:, 0])
    turn = Rotation.from_rotvec(np.outer(3e-4 * np.sin(azimuth + 0.7) ** 3, [0.0, 0.0, 1.0]))
    return calibrated(
        replace(session, p=turn.apply(session.p)), (*READINGS, "direction in which", *BASE), shown="if left"
    )


@fourth
def camera_rolling_shutter(w: Works, rng: np.random.Generator) -> Case:
    """A stereo camera's depth errs with the square of the distance and the row of the image."""
    session = w.clean(160)
    depth = session.p @ (session.p.mean(axis=0) / np.linalg.norm(session.p.mean(axis=0)))
    row = session.p @ w.way(1.0) / depth
    error = 6e-4 * (row - row.mean()) * depth**2
    along = session.p / np.linalg.norm(session.p, axis=1, keepdims=True)
    return calibrated(replace(session, p=session.p + error[:, None] * along), (*READINGS, *BASE))


@fourth
def marker_print_scaled(w: Works, rng: np.random.Generator) -> Case:
    """The marker was printed 2 % too large: all distances from the camera come out too short, orientations right."""
    session = w.clean(140)
    return calibrated(replace(session, p=0.98 * session.p), (*READINGS, "scale", "length", "long"), shown="if left")


@fourth
def orientation_jitters_at_grazing_sight(w: Works, rng: np.random.Generator) -> Case:
    """A flat marker's orientation is worse the more obliquely it is seen, by half a degree to one side."""
    session = w.clean(160)
    sight = session.R.inv().apply(session.p / np.linalg.norm(session.p, axis=1, keepdims=True))
    oblique = 1.0 - np.abs(sight[:, 2])
    turn = Rotation.from_rotvec(np.outer(8e-3 * oblique**2, [0.0, 1.0, 0.0]))
    return calibrated(replace(session, R=session.R * turn), (*ORIENTATION, *TOOL, "target"))


# --- surroundings ----------------------------------------------------------------------------------------------------


@fourth
def table_sags_where_the_arm_leans(w: Works, rng: np.random.Generator) -> Case:
    """The arm stands on a table that gives by the square of how far the tool reaches over one edge."""
    q, again = w.postures(150)
    p, _ = w.arm.frames(w.arm.coordinates(q))
    over = np.maximum(p[:, -1, 0], 0.0) ** 2
    shift = np.outer(over, [0.0, 0.0, 6e-4])

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tracker[:, :3] += shift

    return calibrated(w.observe(q, again, bend), (*BASE, *LOAD))


@fourth
def pump_runs_now_and_then(w: Works, rng: np.random.Generator) -> Case:
    """A vacuum pump, whose pressure is recorded, pulls the tool's flange: 0.2 mm at full vacuum."""
    clock = np.arange(-10.0, 700.0, 1.0)
    level = np.repeat(rng.uniform(0.0, 1.0, 100), 8)[: len(clock)]
    v = w.way(4e-4)

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tool[:, :3] += np.outer(np.interp(stations.t, clock, level), v)

    signal = SignalTrack("temperature:pump", BEGIN + clock, level[:, None], "/pump/pressure")
    return calibrated(replace(w.clean(150, bend), signals=(signal,)), ("pump", *TOOL))


@fourth
def sun_on_the_column(w: Works, rng: np.random.Generator) -> Case:
    """The arm's column bends towards the shade as the sun comes round: a base that turns to and fro once."""
    v = w.way(5e-4)

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        u = stations.t / stations.t[-1]
        deviation.tracker[:, 3:] += np.outer(np.sin(np.pi * u) ** 2, v)

    return calibrated(w.clean(150, bend), (*BASE, *ORDER))


# --- the robot -------------------------------------------------------------------------------------------------------


@fourth
def joint_slips_at_every_tenth_station(w: Works, rng: np.random.Generator) -> Case:
    """A set screw is loose: a joint slips by 0.2 mrad at random moments, always the same way."""
    i = w.any_joint(1, 5)
    slips = np.cumsum(rng.random(160) < 0.1) * 2e-4
    near = (w.names[i - 1], w.names[i], w.names[i + 1])
    return calibrated(w.clean(160, w.joint(i, lambda s: slips[: len(s.t)])), near)


@fourth
def encoder_of_a_joint_jitters(w: Works, rng: np.random.Generator) -> Case:
    """A joint's encoder is loose: it reads anything within half a milliradian."""
    session, i = w.clean(160), w.any_joint(0, 4)
    return calibrated(_joints(session, i, session.q[:, i] + rng.normal(0, 5e-4, 160)), (w.names[i],))


@fourth
def stiffness_depends_on_the_side(w: Works, rng: np.random.Generator) -> Case:
    """A joint gives twice as much when it is loaded one way as the other."""
    i = w.any_joint(1, 3)

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        load = arm.holding(arm.coordinates(stations.q))[:, i, 3]
        deviation.x[:, i, 3] += 6e-4 * np.where(load > 0.0, 2.0, 1.0) * load / np.sqrt(np.mean(load**2))

    return calibrated(w.clean(160, bend), (w.names[i],))


@fourth
def two_gears_of_one_motor(w: Works, rng: np.random.Generator) -> Case:
    """A joint's gear errs with the difference of two joints, as in a parallelogram drive."""
    i = w.any_joint(0, 4)

    def off(stations) -> Array:  # type: ignore[no-untyped-def]
        return 6e-4 * np.sin(5.0 * (stations.q[:, i] - stations.q[:, i + 1]) + 0.3)

    return calibrated(w.clean(200, w.joint(i, off)), (w.names[i], w.names[i + 1]))


# --- descriptions ----------------------------------------------------------------------------------------------------


@fourth
def rpy_in_reverse_order(w: Works, rng: np.random.Generator) -> Case:
    """Somebody wrote the angles of one joint's origin as yaw, pitch, roll."""
    session = w.clean(130)
    able = []
    for name in w.names[1:]:
        found = re.search(r'rpy="([^"]*)"', _joint_block(session, name))
        if found and abs(float(found[1].split()[0]) - float(found[1].split()[2])) > 0.1:
            able.append((name, found[0], found[1].split()))
    name, text, (r, p, y) = able[int(rng.integers(len(able)))]
    block = _joint_block(session, name)
    urdf = session.urdf.replace(block, block.replace(text, f'rpy="{y} {p} {r}"'))
    i = w.names.index(name)
    return calibrated(replace(session, urdf=urdf), (w.names[i - 1], name))


@fourth
def two_lengths_wrong(w: Works, rng: np.random.Generator) -> Case:
    """Two joints' origins in the URDF are of the short version of the arm: 8 cm less each."""
    session = w.clean(140)
    names = []
    for name in w.names[1:]:
        block = _joint_block(session, name)
        found = re.search(r'xyz="([^"]*)"', block)
        values = [float(v) for v in found[1].split()] if found else []
        if found and max(abs(v) for v in values) > 0.2 and len(names) < 2:
            longest = int(np.argmax(np.abs(values)))
            values[longest] -= 0.08 * np.sign(values[longest])
            text = f'xyz="{" ".join(f"{v:.9g}" for v in values)}"'
            session = replace(session, urdf=session.urdf.replace(block, block.replace(found[0], text)))
            names.append(name)
    near = [w.names[max(w.names.index(name) - 1, 0)] for name in names]
    return calibrated(session, (*names, *near), shown="if left")


# --- data ------------------------------------------------------------------------------------------------------------


@fourth
def half_of_the_joints_never_move(w: Works, rng: np.random.Generator) -> Case:
    """Calibrated with the first three joints moving alone, then used with all of them."""
    q, again = w.postures(120)
    still = q.copy()
    still[:, 3:] = 0.3 * w.arm.range.mean(axis=0)[3:] + 0.2
    second = w.clean(80, begin=5000.0)
    return frozen(w.observe(still, again), second, ("outside", "range", *w.names[3:]), shown="if left")


@fourth
def means_of_two_visits(w: Works, rng: np.random.Generator) -> Case:
    """Of some stations the mean of two readings was noted, of which the second was taken at the next posture."""
    session = w.clean(150)
    p = session.p.copy()
    rows = np.flatnonzero(rng.random(149) < 0.08)
    p[rows] = 0.5 * (session.p[rows] + session.p[rows + 1])
    return calibrated(replace(session, p=p), ("reject", "left out", "outlier", "stations"))


# --- use -------------------------------------------------------------------------------------------------------------


@fourth
def conjugate_today(w: Works, rng: np.random.Generator) -> Case:
    """A frozen calibration; today's driver sends the tracker's orientation in the tool."""
    second = w.clean(80, begin=86_400.0)
    return frozen(w.clean(120), replace(second, R=second.R.inv()), (*QUATERNION, "conjugate", "inver"))


@fourth
def base_frame_of_another_cell(w: Works, rng: np.random.Generator) -> Case:
    """A frozen calibration; positions are given in the room's frame today and orientations in the tracker's."""
    second = w.clean(80, begin=86_400.0)
    room = Rotation.from_rotvec(w.way(0.6))
    moved = replace(second, p=room.apply(second.p) + w.way(0.5))
    return frozen(w.clean(120), moved, ("frame", "orientation", *BASE), "--refit-base")


@fourth
def joint_swapped_for_a_spare(w: Works, rng: np.random.Generator) -> Case:
    """A joint's module was exchanged since: another zero, another gear, another tilt of its axis."""
    i = w.any_joint(1, w.arm.n - 1)

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.x[:, i, 3] += 8e-4 + 4e-4 * np.sin(31.0 * stations.q[:, i])
        deviation.x[:, i, 1] += 6e-4

    return frozen(
        w.clean(130), w.clean(90, bend, begin=86_400.0), (w.names[i - 1], w.names[i], w.names[min(i + 1, w.arm.n - 1)])
    )


@fourth
def tool_frame_restated(w: Works, rng: np.random.Generator) -> Case:
    """Today's controller reports the point of another tool frame, 5 cm farther out; the base is found again."""
    second = w.clean(80, w.tool(w.way(0.05), np.zeros(3), from_(0)), begin=3600.0)
    return frozen(w.clean(120), second, TOOL, "--refit-base")
