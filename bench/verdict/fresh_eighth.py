"""The eighth group: conventions and tables, two things wrong at once among them. Cells of eighth_cell.py.

Drawn up, with its words, before a look at the code that judges; run once as it came.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from case import Case, calibrated, frozen, kind
from eighth_cell import UR5, UR5E, Take, World, Wrong, after, described
from scipy.spatial.transform import Rotation

Array = np.ndarray
eighth = kind("fresh_eighth")
BASE = (r"\bbase\b", "tracker", "instrument")
TOOL = (r"\btool\b", "target", "flange")
TURNED = ("quaternion", "orientation", "euler", "w x y z", "xyzw", "convention")
UNIT = ("millimet", r"\bmm\b", "unit", "scale", "metre")
HAND = ("handed", "mirror", "coordinate", r"\baxes\b", r"\baxis\b", "sign")
ROWS = (r"\brows?\b", "station", "posture", "order", "shift", "late", "belong")


def rows_from(take: Take, share: float) -> Array:
    """Stations behind this share of a recording (N,)."""
    return np.arange(len(take)) >= int(share * len(take))


def joints_with(take: Take, i: int, column: Array) -> Take:
    """Another column for one joint."""
    q = take.q.copy()
    q[:, i] = column
    return replace(take, q=q)


def written(take: Take, rows: Array, p: Array | None = None, R: Rotation | None = None) -> Take:
    """Other positions or turns in these rows."""
    here = take.p if p is None else np.where(rows[:, None], p, take.p)
    turn = take.R.as_matrix() if R is None else np.where(rows[:, None, None], R.as_matrix(), take.R.as_matrix())
    return replace(take, p=here, R=Rotation.from_matrix(turn))


def w_first(take: Take, rows: Array | None = None) -> Take:
    """Quaternions written w x y z in these rows."""
    values = take.raw().copy()
    rows = np.ones(len(take), bool) if rows is None else rows
    values[rows, 3:] = values[rows][:, [6, 3, 4, 5]]
    return replace(take, values=values)


def moved(w: World, share: float, part: str, shift: float, turn: float):  # type: ignore[no-untyped-def]
    """Base or tool elsewhere behind a share of the stations."""
    step = np.r_[w.way(shift), w.way(turn)]

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        return Wrong(**{part: np.outer(np.arange(len(q)) >= int(share * len(q)), step)})

    return fault


# --- two things wrong at once ----------------------------------------------------------------------------------------


@eighth
def w_first_and_the_tool_bent(w: World, rng: np.random.Generator) -> Case:
    """Quaternions w x y z, and the tool was bent half way."""
    return calibrated(w_first(w.plain(150, moved(w, 0.55, "tool", 4e-3, 0.03))), (*TURNED, *TOOL))


@eighth
def w_first_and_a_joint_negated(w: World, rng: np.random.Generator) -> Case:
    """Quaternions w x y z, and one joint counts the other way."""
    i, take = w.some(), w.plain(140)
    return calibrated(w_first(joints_with(take, i, -take.q[:, i])), (*TURNED, w.names[i]))


@eighth
def millimetres_and_the_tripod_kicked(w: World, rng: np.random.Generator) -> Case:
    """Millimetres in the last third, and at the same time the tripod was kicked by 3 mm."""
    take = w.plain(150, moved(w, 0.66, "base", 3e-3, 2e-3))
    return calibrated(written(take, rows_from(take, 0.66), 1e3 * take.p), (*UNIT, *BASE))


@eighth
def degrees_and_two_joints_swapped(w: World, rng: np.random.Generator) -> Case:
    """All joints in degrees, and the names of two that follow each other exchanged."""
    i, take = w.some(1, w.n - 1), w.plain(140)
    q = np.degrees(take.q)
    q[:, [i, i + 1]] = q[:, [i + 1, i]]
    return calibrated(replace(take, q=q), (r"\bdegrees?\b", w.names[i], w.names[i + 1]))


@eighth
def left_handed_until_the_base_moved(w: World, rng: np.random.Generator) -> Case:
    """The first half in a left-handed frame; when somebody put that right, the origin went elsewhere."""
    take = w.plain(150, moved(w, 0.5, "base", 0.05, 0.02))
    flip = np.diag([1.0, -1.0, 1.0])
    first = ~rows_from(take, 0.5)
    turn = Rotation.from_matrix(flip @ take.R.as_matrix() @ flip)
    return calibrated(written(take, first, take.p @ flip, turn), (*HAND, *BASE, *ROWS))


@eighth
def sign_and_zero_of_a_joint(w: World, rng: np.random.Generator) -> Case:
    """A joint of the bag counts the other way than in the URDF, from a right angle on."""
    i, take = w.some(), w.plain(140)
    return calibrated(joints_with(take, i, np.pi / 2 - take.q[:, i]), (w.names[i],))


@eighth
def two_joints_swapped_and_both_negated(w: World, rng: np.random.Generator) -> Case:
    """Two joints under each other's name and with the other sign."""
    i, take = w.some(1, w.n - 1), w.plain(140)
    q = take.q.copy()
    q[:, [i, i + 1]] = -q[:, [i + 1, i]]
    return calibrated(replace(take, q=q), (w.names[i], w.names[i + 1]))


@eighth
def tool_bent_and_backlash(w: World, rng: np.random.Generator) -> Case:
    """One gear has play of a milliradian, and the tool was knocked by 0.6 mm."""
    i, knock = w.some(1, 4), moved(w, 0.4, "tool", 6e-4, 5e-4)

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        play = np.zeros_like(q)
        play[:, i] = 5e-4 * came[:, i]
        return replace(knock(q, t, came), joints=play)

    return calibrated(w.plain(160, fault), (w.names[i],))


# --- units and columns of some parts ---------------------------------------------------------------------------------


@eighth
def y_in_inches(w: World, rng: np.random.Generator) -> Case:
    """Points, of which y is in inches and x and z in metres."""
    take = w.plain(150, kind="point")
    return calibrated(replace(take, p=take.p * [1.0, 39.3701, 1.0]), (*UNIT, "inch", r"\by\b", "coordinate"))


@eighth
def left_handed_points(w: World, rng: np.random.Generator) -> Case:
    """Points of a left-handed frame: x is written with the other sign."""
    take = w.plain(150, kind="point")
    return calibrated(replace(take, p=take.p * [-1.0, 1.0, 1.0]), (*HAND, "x"))


@eighth
def rail_in_millimetres(w: World, rng: np.random.Generator) -> Case:
    """The rail counts millimetres, everything else is in metres and radians."""
    w = World("rail", rng)
    take = w.plain(140)
    return calibrated(joints_with(take, 0, 1e3 * take.q[:, 0]), (*UNIT, "rail_joint"))


@eighth
def rail_runs_the_other_way(w: World, rng: np.random.Generator) -> Case:
    """The rail counts from its other end."""
    w = World("rail", rng)
    take = w.plain(140)
    return calibrated(joints_with(take, 0, 1.5 - take.q[:, 0]), ("rail_joint",))


@eighth
def scara_z_in_millimetres(w: World, rng: np.random.Generator) -> Case:
    """A SCARA's quill counts millimetres."""
    w = World("scara", rng)
    take = w.plain(120)
    return calibrated(joints_with(take, 2, 1e3 * take.q[:, 2]), (*UNIT, "scara_z"))


@eighth
def quill_screws_when_it_turns(w: World, rng: np.random.Generator) -> Case:
    """A SCARA's quill is a ball screw spline: turning the last joint lifts it by 20 mm a turn, not made up for."""
    w = World("scara", rng)

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        lift = np.zeros_like(q)
        lift[:, 2] = 0.02 * q[:, 3] / (2 * np.pi)
        return Wrong(lift)

    return calibrated(w.plain(140, fault), ("scara_z", "scara_4"))


# --- encoders --------------------------------------------------------------------------------------------------------


@eighth
def turn_of_the_motor_lost(w: World, rng: np.random.Generator) -> Case:
    """The battery of an encoder fails: from some station on its joint is off by one turn of the motor, 1 in 101."""
    i, take = w.some(1), w.plain(150)
    return calibrated(joints_with(take, i, take.q[:, i] - rows_from(take, 0.6) * 2 * np.pi / 101), (w.names[i],))


@eighth
def odd_gear_and_a_folded_angle(w: World, rng: np.random.Generator) -> Case:
    """A gear errs twice and a half a turn, and its joint, which turns by more than that, is written within ±π."""
    w = World("ur5e", rng)
    i = 5
    w.low[i], w.high[i] = -5.5, 5.5

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        off = np.zeros_like(q)
        off[:, i] = 2.5e-3 * np.sin(2.5 * q[:, i] + 0.4)
        return Wrong(off)

    take = w.plain(170, fault)
    folded = (take.q[:, i] + np.pi) % (2 * np.pi) - np.pi
    return calibrated(joints_with(take, i, folded), (w.names[i],))


@eighth
def gear_ratio_and_a_folded_angle(w: World, rng: np.random.Generator) -> Case:
    """A joint's motor counts 0.05 % too much, and its angle, of one turn and three quarters, is written within ±π."""
    w = World("ur5e", rng)
    i = 4
    w.low[i], w.high[i] = -5.5, 5.5

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        off = np.zeros_like(q)
        off[:, i] = 5e-4 * q[:, i]
        return Wrong(off)

    take = w.plain(160, fault)
    return calibrated(joints_with(take, i, (take.q[:, i] + np.pi) % (2 * np.pi) - np.pi), (w.names[i],))


@eighth
def whole_turns_come_and_go(w: World, rng: np.random.Generator) -> Case:
    """Since a restart the last joint's angle is a whole turn larger: the frozen curve of its gear is asked outside."""
    i = w.n - 1

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        off = np.zeros_like(q)
        off[:, i] = 2.5e-3 * np.sin(3 * q[:, i] + 0.4)
        return Wrong(off)

    second = w.plain(70, fault, begin=86400.0)
    second = joints_with(second, i, second.q[:, i] + 2 * np.pi)
    return frozen(w.plain(150, fault), second, (w.names[i],), shown="if left")


# --- descriptions, arms ----------------------------------------------------------------------------------------------


@eighth
def urdf_of_the_older_series(w: World, rng: np.random.Generator) -> Case:
    """A UR5e with the URDF of a UR5: lengths off by 2 to 7 cm, which a fit may find."""
    w = World("ur5e", rng)
    words = ("urdf", "description", *w.names, *BASE)
    assert UR5E[0].xyz != UR5[0].xyz
    return calibrated(replace(w.plain(150), urdf=described(UR5)), words, shown="if left")


@eighth
def another_arm_from_the_middle_on(w: World, rng: np.random.Generator) -> Case:
    """In one bag: the first half of one arm, the second of the next of its series on the same foot, with its tool."""
    first = w.plain(80)
    w.rebuild()
    second = w.plain(80, begin=500.0)
    return calibrated(after(first, second), (*ROWS, *w.names, "robot", *BASE, *TOOL))


@eighth
def user_frame_since_noon(w: World, rng: np.random.Generator) -> Case:
    """After a break the tracker's software writes in a user's frame: exactly 100 mm further along x."""
    take = w.plain(150)
    return calibrated(written(take, rows_from(take, 0.7), take.p + [0.1, 0.0, 0.0]), BASE)


@eighth
def middle_third_twice_the_tool_offset(w: World, rng: np.random.Generator) -> Case:
    """For a while an offset of the tool was applied twice, 12 mm along its axis."""
    take = w.plain(150)
    rows = (np.arange(150) >= 50) & (np.arange(150) < 100)
    return calibrated(written(take, rows, take.p + take.R.apply([0.0, 0.0, 0.012])), TOOL)


@eighth
def whole_bag_written_twice(w: World, rng: np.random.Generator) -> Case:
    """A gear errs with 70 cycles a turn; each row stands twice, the second time with a stamp a millisecond later."""
    i = w.some(1, 4)

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        off = np.zeros_like(q)
        off[:, i] = 8e-4 * np.sin(70 * q[:, i] + 1.0)
        return Wrong(off)

    take = w.plain(110, fault)
    twice = take.only(np.repeat(np.arange(110), 2))
    return calibrated(replace(twice, t=twice.t + np.tile([0.0, 1e-3], 110)), (w.names[i], "twice", "repeat", "cop"))
