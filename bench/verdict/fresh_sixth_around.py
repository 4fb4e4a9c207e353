"""The sixth group, what stands around the arm: instrument, mixed sources, use, loads, drivers, what no data show."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
from arm import GROW, TURN, Arm
from case import Case, calibrated, frozen
from conventions import QUATERNION
from fault import Stations
from fresh_fifth import ROWS, UNRELATED
from fresh_fifth_arm import CARRIED
from fresh_fourth import READINGS, _joints
from fresh_sixth import _axes, sixth
from physics import LOAD
from regimes import BASE, TOOL
from scipy.spatial.transform import Rotation
from workcell import BEGIN, PERIOD, Array, Bend, Works

from modcal_core.measurements.recording import (
    SignalTrack,
)

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
