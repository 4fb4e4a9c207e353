"""The seventh group of kinds that were written after the last change to the code, with their words, and run once.

Faults that recordings of ordinary users have: exports and spreadsheets, plugs and name spaces, stands, drives, guided
arms, sensors under the wrong name, sources that were put together. Drawn up without a look at the code that judges.
"""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import date

import numpy as np
from arm import TURN, Arm
from case import Case, calibrated, frozen, kind
from conventions import UNIT
from fault import Deviation, Stations
from fresh_fifth import ROWS, UNRELATED
from fresh_fourth import READINGS, _joints
from fresh_sixth import ORIENTED, TIMING
from fresh_sixth_around import _pressing
from fresh_sixth_cells import _moving
from physics import LOAD, _mixed, centres, tilted
from recordings import Plan
from regimes import BASE, TOOL
from scipy.spatial.transform import Rotation
from workcell import BEGIN, PERIOD, Array, Bend, Session, SignalTrack, Works, joined

STATIONS = (r"stations? \d",)
seventh = kind("fresh_seventh")


def _turned(session: Session, rows: Array, turn: Rotation, about: Array, shift: Array) -> Session:
    """These rows' readings turned about a point of the instrument's frame, and shifted."""
    p, R = session.p.copy(), session.R.as_matrix()
    p[rows] = turn.apply(session.p[rows] - about) + about + shift
    R[rows] = (turn * session.R[rows]).as_matrix()
    return replace(session, p=p, R=Rotation.from_matrix(R))


# --- exports and spreadsheets ----------------------------------------------------------------------------------------


@seventh
def wrist_joints_in_degrees(w: Works, rng: np.random.Generator) -> Case:
    """Half of a table was converted: the last three joints are in degrees still, the others in radians."""
    session = w.clean(140)
    q = session.q.copy()
    q[:, -3:] = np.degrees(q[:, -3:])
    return calibrated(replace(session, q=q), (*w.names[-3:], r"\bdegrees?\b"))


@seventh
def pendant_rpy_as_rotation_vector(w: Works, rng: np.random.Generator) -> Case:
    """The pendant was set to show roll, pitch and yaw, and its three numbers were taken for a rotation vector."""
    session = w.clean(140)
    return calibrated(replace(session, R=Rotation.from_rotvec(session.R.as_euler("xyz"))), ORIENTED)


@seventh
def decimal_comma_lost_in_a_joint(w: Works, rng: np.random.Generator) -> Case:
    """A joint's column lost its decimal commas: 45,123 degrees are 45123, and 45,1 are 451."""
    session, i = w.clean(150), w.any_joint(1)
    shown = [f"{x:.3f}".rstrip("0") for x in np.degrees(session.q[:, i])]
    return calibrated(_joints(session, i, np.radians([float(x.replace(".", "")) for x in shown])), (w.names[i],))


@seventh
def angles_turned_into_dates(w: Works, rng: np.random.Generator) -> Case:
    """A spreadsheet took angles of the first joint such as 12.05 for dates: a day's number stands in their place."""
    q, _ = w.postures(150, 0)
    hundredths = rng.integers(100, 2900, 144)
    q = q[:144]
    q[:, 0] = np.radians(hundredths / 100.0)
    q, again = w.with_returns(q)
    shown, column = np.round(100 * np.degrees(q[:, 0])).astype(int), q[:, 0].copy()
    for k, (day, month) in enumerate(zip(shown // 100, shown % 100, strict=True)):
        if 1 <= day <= 28 and 1 <= month <= 12:
            column[k] = np.radians(date(2026, month, day).toordinal() - date(1899, 12, 30).toordinal())
    session = _joints(w.observe(q, again), 0, column)
    return calibrated(session, (w.names[0], "joint states?", *STATIONS))


@seventh
def columns_shifted_by_one(w: Works, rng: np.random.Generator) -> Case:
    """The mean error of the markers, which has no title, stands before x: each value is under the next one's title."""
    session = w.clean(140)
    values = np.column_stack([rng.uniform(1e-4, 6e-4, 140), session.p, session.R.as_quat()[:, :3]])
    return calibrated(replace(session, values=values), (*ORIENTED, r"\bcolumns?\b", r"\bnorm\b", r"\baxes\b"))


@seventh
def numbers_over_a_thousand_cut(w: Works, rng: np.random.Generator) -> Case:
    """Millimetres were exported with a comma between thousands, and cut there: 1,234.56 is 1, and 987.65 is itself."""
    session = w.clean(150)
    p = 1e3 * (session.p - session.p.mean(axis=0) + [0.3, 0.5, 0.4])
    cut = np.where(np.abs(p) >= 1000.0, np.trunc(p / 1000.0), p)
    words = (*UNIT, "coordinate", r"\bcolumns?\b", r"\bcells?\b", "digit", "cut off", "clip", "whole", "thousand")
    return calibrated(replace(session, p=1e-3 * cut), words)


@seventh
def y_up_until_lunch(w: Works, rng: np.random.Generator) -> Case:
    """The first half was exported with y upwards, the second with z upwards, after somebody changed the settings."""
    session = w.clean(150)
    rows = np.flatnonzero(np.arange(150) < 71)
    turn = Rotation.from_euler("x", -90, degrees=True)
    return calibrated(_turned(session, rows, turn, np.zeros(3), np.zeros(3)), (*BASE, r"\bframes?\b", r"\baxes\b"))


@seventh
def also_with_two_columns_exchanged(w: Works, rng: np.random.Generator) -> Case:
    """--also a recording whose y and z of the positions were exchanged when it was exported; orientations are right."""
    second = w.clean(80, begin=3600.0)
    second = replace(second, p=second.p[:, [0, 2, 1]])
    words = ("coordinate", r"\bcolumns?\b", r"\baxes\b", "mirror", "handed", "second", r"\brecordings\b")
    return Case(
        {"first": w.clean(90), "second": second}, (("calibrate", "{first}", "--also", "{second}"),), True, words
    )


@seventh
def orientations_from_the_pendant(w: Works, rng: np.random.Generator) -> Case:
    """Positions are a laser tracker's, aligned with the arm's base; orientations are those that the pendant shows."""
    w.cell.tracker = np.array([0.4, -0.3, 0.1]), Rotation.from_rotvec(rng.normal(0, 5e-4, 3))
    session = w.clean(150)
    _, R = Arm(w.robot).frames(w.arm.coordinates(session.q))
    R = Rotation.from_matrix(R[:, -1]) * w.cell.tool[1]
    return calibrated(replace(session, R=R), ("comput", "calculat", "nominal", *ORIENTED))


# --- rows and columns that do not belong together --------------------------------------------------------------------


@seventh
def joined_by_whole_degrees(w: Works, rng: np.random.Generator) -> Case:
    """Two tables were joined by the first joint in whole degrees: each gets the first reading of its degree."""
    session = w.clean(150)
    _, first, of = np.unique(np.round(np.degrees(session.q[:, 0])), return_index=True, return_inverse=True)
    rows = first[of.ravel()]
    words = (*ROWS, *UNRELATED, "identical", "same reading", r"\bcop(?:y|ied|ies)", "repeated")
    return calibrated(replace(session, p=session.p[rows], R=session.R[rows]), words)


@seventh
def part_of_the_table_sorted_alone(w: Works, rng: np.random.Generator) -> Case:
    """Forty rows were marked and sorted by z, the columns of the readings only."""
    session = w.clean(150)
    rows = np.arange(150)
    rows[62:102] = 62 + np.argsort(session.p[62:102, 2])
    return calibrated(replace(session, p=session.p[rows], R=session.R[rows]), (*ROWS, *UNRELATED))


@seventh
def joint_column_filled_as_a_series(w: Works, rng: np.random.Generator) -> Case:
    """Lost cells of one joint were filled by dragging: 26 rows hold an even series from one end to the other."""
    session, i = w.clean(150), w.any_joint(1)
    column = session.q[:, i].copy()
    column[84:110] = np.linspace(column[83], column[110], 28)[1:-1]
    return calibrated(_joints(session, i, column), (w.names[i],))


@seventh
def namespace_of_the_second_arm_since(w: Works, rng: np.random.Generator) -> Case:
    """A cell has two arms of one type. After a restart the joint states that were recorded are the other one's."""
    session = w.clean(150)
    q = session.q.copy()
    q[96:] = rng.uniform(*w.arm.range, (54, w.arm.n))
    return calibrated(replace(session, q=q), (*UNRELATED, *STATIONS, "joint states?"))


@seventh
def gripper_width_in_the_last_joints_column(w: Works, rng: np.random.Generator) -> Case:
    """The last of the exported joints is the gripper's width, open or closed; the arm's last joint is not there."""
    session = w.clean(140)
    width = np.where(rng.random(140) < 0.5, 0.0, 0.08) + rng.normal(0, 1e-4, 140)
    return calibrated(_joints(session, w.arm.n - 1, width), (w.names[-1],))


@seventh
def encoder_cable_breaks_when_bent(w: Works, rng: np.random.Generator) -> Case:
    """Where the joint before it is bent far, one joint's encoder has no contact, and its last value stands."""
    session, i = w.clean(160), w.any_joint(1, w.arm.n - 1)
    bent = session.q[:, i - 1] > np.quantile(session.q[:, i - 1], 0.8)
    column = session.q[:, i].copy()
    for k in range(1, 160):
        column[k] = column[k - 1] if bent[k] else column[k]
    return calibrated(_joints(session, i, column), (w.names[i],))


# --- stands, drives, tools -------------------------------------------------------------------------------------------


@seventh
def stand_rocks_on_its_short_foot(w: Works, rng: np.random.Generator) -> Case:
    """One of four feet is short: the stand tips by 0.8 mrad to the side on which the arm's weight is."""
    q, again = w.postures(160)
    azimuth = rng.uniform(0, 2 * np.pi)
    lean = centres(w, q)[:, :2] @ [np.cos(azimuth), np.sin(azimuth)]
    turn = 4e-4 * np.outer(np.sign(lean - np.median(lean)), [-np.sin(azimuth), np.cos(azimuth), 0.0])
    return calibrated(w.observe(q, again, tilted(w, lambda s: turn)), (*BASE, w.names[0], w.arm.parents[0]))


@seventh
def cart_creeps_on_its_castors(w: Works, rng: np.random.Generator) -> Case:
    """The cart's brakes are weak: with each move of the arm it rolls and turns a little, some tenths in the end."""
    walk = np.zeros((160, 6))
    walk[:, :2] = np.cumsum(rng.normal(0, 6e-5, (160, 2)), axis=0)
    walk[:, 5] = np.cumsum(rng.normal(0, 5e-5, 160))

    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        deviation.tracker += walk

    return calibrated(w.clean(160, bend), (*BASE, w.names[0], w.arm.parents[0]))


@seventh
def arm_stops_at_its_limit(w: Works, rng: np.random.Generator) -> Case:
    """One joint stops at its software limit, short of a tenth of the goals; the table holds the goals."""
    i = w.any_joint(1, w.arm.n - 1)
    low, high = w.arm.range[:, i]
    end = low + 0.9 * (high - low)
    return calibrated(w.clean(160, w.joint(i, lambda s: np.minimum(end - s.q[:, i], 0.0))), (w.names[i],))


@seventh
def last_third_led_by_hand(w: Works, rng: np.random.Generator) -> Case:
    """In the last third somebody led the arm by its tool, and went on pushing while it was measured: 30 to 80 N."""
    q, again = w.postures(150)
    force = rng.uniform(30.0, 80.0, 150) * rng.choice([-1.0, 1.0], 150) * (np.arange(150) >= 100)
    off = _pressing(w, q, force) / 6e4

    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        deviation.x[:, :, TURN] += off

    state = rng.bit_generator.state
    free = w.observe(q, again)
    rng.bit_generator.state = state
    led = w.observe(q, again, bend)
    pushed = 1e3 * float(np.sqrt(np.mean(np.sum((led.p - free.p) ** 2, axis=1))))
    words = (*STATIONS, *LOAD, "scatter", "spread", "repeat", "force", r"\bnoise of", r"\btime\b")
    return calibrated(replace(led, floor_mm=float(np.hypot(led.floor_mm, pushed))), words)


@seventh
def spindle_warms_and_cools_at_lunch(w: Works, rng: np.random.Generator) -> Case:
    """The spindle that the target sits on grows by 0.7 mm while it runs, and shrinks again during the break."""
    axis, tau, rest = w.way(7e-4), 170.0, 420.0
    noon = 80 * PERIOD

    def warmth(t: Array) -> Array:
        before = 1.0 - np.exp(-np.minimum(t, noon) / tau)
        left = (1.0 - np.exp(-noon / tau)) * np.exp(-rest / tau)
        after = 1.0 - (1.0 - left) * np.exp(-np.maximum(t - noon - rest, 0.0) / tau)
        return np.where(t <= noon, before, after)

    bend = w.tool(axis, np.zeros(3), lambda s: warmth(s.t))
    session = joined(w.clean(80, bend, returns=3), w.clean(80, bend, returns=3, begin=noon + rest))
    return calibrated(session, (*TOOL, *w.arm.hand))


@seventh
def resolver_drifts_to_and_fro(w: Works, rng: np.random.Generator) -> Case:
    """One joint's resolver drifts slowly by 0.8 mrad to and fro, as the cabinet's fan starts and stops."""
    i, phase = w.any_joint(1, w.arm.n - 1), rng.uniform(0, 2 * np.pi)
    bend = w.joint(i, lambda s: 8e-4 * np.sin(2 * np.pi * s.t / 350.0 + phase))
    return calibrated(w.clean(160, bend), (w.names[i],))


@seventh
def body_on_the_forearm_for_a_while(w: Works, rng: np.random.Generator) -> Case:
    """After the tool was hidden for a moment, motion capture gave its name to the body on the forearm for a while."""
    session, k = w.clean(150), w.arm.n - 4
    p, R = w.arm.frames(w.arm.coordinates(session.q))
    eye, body = w.cell.tracker[1].inv(), Rotation.random(rng=rng)
    other = eye.apply(p[:, k] + R[:, k] @ w.way(0.12) - w.cell.tracker[0]) + rng.normal(0, 2e-5, (150, 3))
    rows = (np.arange(150) >= 57) & (np.arange(150) < 83)
    turned = (eye * Rotation.from_matrix(R[:, k]) * body).as_matrix()
    session = replace(
        session,
        p=np.where(rows[:, None], other, session.p),
        R=Rotation.from_matrix(np.where(rows[:, None, None], turned, session.R.as_matrix())),
    )
    return calibrated(session, (*TOOL, *STATIONS, w.arm.links[k], "another (?:body|link|target)"))


# --- sensors and descriptions ----------------------------------------------------------------------------------------


@seventh
def temperature_plugs_exchanged(w: Works, rng: np.random.Generator) -> Case:
    """Two drives' temperatures are recorded, each under the other one's name; one of the joints follows its own."""
    i, other = w.any_joint(1, 3), w.arm.n - 2
    clock = np.arange(0.0, 170 * PERIOD + 1.0, 5.0)
    own = 24.0 + 17.0 * (1.0 - np.exp(-clock / 240.0)) + 2.0 * np.sin(clock / 37.0)
    strange = 26.0 + 6.0 * np.sin(clock / 80.0 + 1.0) + 3.0 * np.cos(clock / 23.0)
    bend = w.joint(i, lambda s: 6e-5 * (np.interp(s.t, clock, own) - 24.0))
    signals = tuple(
        SignalTrack(f"/drive_{k + 1}/temperature", BEGIN + clock, values[:, None], f"/drive_{k + 1}/temperature")
        for k, values in ((i, strange), (other, own))
    )
    return calibrated(replace(w.clean(170, bend), signals=signals), (w.names[i],))


@seventh
def effort_columns_exchanged(w: Works, rng: np.random.Generator) -> Case:
    """An elastic arm; the efforts of its shoulder and of its elbow stand in each other's column."""
    session, elbow = w.clean(150, w.elastic(5e-4), effort=True), 2 if w.arm.n == 6 else 3
    assert session.effort is not None
    effort = session.effort.copy()
    effort[:, [1, elbow]] = effort[:, [elbow, 1]]
    words = ("effort", "torque", *LOAD, w.names[1], w.names[elbow])
    return calibrated(replace(session, effort=effort), words, shown="if left")


@seventh
def right_angles_of_two_decimals(w: Works, rng: np.random.Generator) -> Case:
    """A URDF out of a CAD export, whose angles have two decimals: 1.57. A calibration may take that up."""
    session = w.clean(140)

    def rounded(found: re.Match[str]) -> str:
        return 'rpy="' + " ".join(f"{float(v):.2f}" for v in found[1].split()) + '"'

    text = re.sub(r'rpy="([^"]*)"', rounded, session.urdf)
    assert text != session.urdf
    return calibrated(replace(session, urdf=text), (*w.names, *w.arm.links, "urdf"), shown="if left")


@seventh
def seam_between_two_trackers(w: Works, rng: np.random.Generator) -> Case:
    """Two trackers see half of the cell each, and were joined over three points: 0.5 mm and 0.4 mrad at the seam."""
    session = w.clean(170)
    middle = session.p.mean(axis=0)
    far = np.flatnonzero((session.p - middle) @ w.way(1.0) > 0.0)
    session = _turned(session, far, Rotation.from_rotvec(w.way(4e-4)), middle, w.way(5e-4))
    return calibrated(session, (*READINGS, *BASE, "instrument", w.names[0]))


# --- motion, other days ----------------------------------------------------------------------------------------------


@seventh
def drives_follow_their_goals(w: Works, rng: np.random.Generator) -> Case:
    """While the arm moves its goals are recorded as joint states; each drive follows after its own 5 to 40 ms."""
    late = rng.uniform(5e-3, 40e-3, w.arm.n)

    def bend(plan: Plan) -> Bend:
        t = plan.stations.t

        def behind(arm: Arm, stations: Stations, deviation: Deviation) -> None:
            for i in range(arm.n):
                there = np.interp(t - late[i], plan.t, plan.q[:, i])
                deviation.x[:, i, TURN] += there - np.interp(t, plan.t, plan.q[:, i])

        return behind

    return calibrated(_moving(w, bend), (*TIMING, *w.names, r"\blags?\b", "goal", "speed", "veloc"))


@seventh
def backlash_since_the_crash(w: Works, rng: np.random.Generator) -> Case:
    """Since a crash one gear has 0.8 mrad of play, taken up by the way it came; the calibration is from before."""
    i = w.any_joint(1, 4)
    second = w.clean(90, w.joint(i, lambda s: 4e-4 * s.way[:, i]), begin=86_400.0)
    return frozen(w.clean(120), second, (w.names[i],))


@seventh
def also_before_a_joint_was_mastered(w: Works, rng: np.random.Generator) -> Case:
    """--also yesterday's recording, before one joint was mastered anew: its zero was 2.5 mrad elsewhere."""
    i, second = w.any_joint(1, w.arm.n - 1), w.clean(80, begin=-86_400.0)
    second = _joints(second, i, second.q[:, i] + 2.5e-3)
    steps = (("calibrate", "{first}", "--also", "{second}"),)
    return Case({"first": w.clean(90), "second": second}, steps, True, (w.names[i],))


# --- what the data hardly show: anything but calm will do ------------------------------------------------------------


@seventh
def part_left_in_the_gripper_at_three_stations(w: Works, rng: np.random.Generator) -> Case:
    """At three stations of 150 an elastic arm holds a part of 6 kg that somebody forgot to put down."""
    q, again = w.postures(150)
    _, of, count = np.unique(q, axis=0, return_inverse=True, return_counts=True)
    once = np.flatnonzero(count[of.ravel()] == 1)
    heavy = np.isin(np.arange(150), rng.choice(once, 3, replace=False))
    return calibrated(_mixed(w, q, again, heavy, 6.0), (*LOAD, *STATIONS, *w.names), shown=False)
