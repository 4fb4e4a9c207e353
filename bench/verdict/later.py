"""Kinds that were written later than the rest; two rules of the code came after their first run (see README)."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from case import Case, calibrated, frozen, kind
from conventions import ORIENTATION, QUATERNION, UNIT, quaternions
from physics import LOAD, tilted
from regimes import BASE, EITHER, LEFT_OUT, TOOL
from scipy.spatial.transform import Rotation
from workcell import PERIOD, Array, Session, Works, from_

COMPUTED = ("comput", "calculat", "noise-free|no noise|without noise")
READING = (r"\btracker\b", r"\breading", "scale", r"\bbase\b", "instrument")
later = kind("later")


def _mixed(session: Session, other: Array, rows: Array) -> Session:
    """Raw values of which some rows are written otherwise."""
    return replace(session, values=np.where(rows[:, None], other, session.raw()))


@later
def quaternion_order_changes(w: Works, rng: np.random.Generator) -> Case:
    """A driver was updated half way: quaternions are x y z w first and w x y z then."""
    session = w.clean(130)
    other = quaternions(session, (3, 0, 1, 2)).raw()
    return calibrated(_mixed(session, other, np.arange(130) >= 70), QUATERNION)


@later
def positions_cycled(w: Works, rng: np.random.Generator) -> Case:
    """Positions stand as y z x, orientations as they should."""
    session = w.clean(120)
    return calibrated(replace(session, p=session.p[:, [1, 2, 0]]), (*QUATERNION, r"\bax[ei]s\b", "frame"))


@later
def angles_in_degrees_taken_for_radians(w: Works, rng: np.random.Generator) -> Case:
    """Euler angles in degrees were turned into quaternions as if they were radians."""
    session = w.clean(120)
    R = Rotation.from_euler("xyz", session.R.as_euler("xyz", degrees=True))
    return calibrated(replace(session, R=R), (*ORIENTATION, "degree"))


@later
def centimetres(w: Works, rng: np.random.Generator) -> Case:
    """Positions are written in centimetres."""
    session = w.clean(110)
    return calibrated(replace(session, p=100.0 * session.p), (*UNIT, "centimet", "scale", "100"))


@later
def inches(w: Works, rng: np.random.Generator) -> Case:
    """Positions are written in inches."""
    session = w.clean(110, kind="point")
    return calibrated(replace(session, p=session.p / 0.0254), (*UNIT, "inch", "scale", "39"))


@later
def joint_in_revolutions(w: Works, rng: np.random.Generator) -> Case:
    """One joint counts revolutions."""
    session, i = w.clean(120), w.any_joint(0, 5)
    q = session.q.copy()
    q[:, i] /= 2.0 * np.pi
    return calibrated(replace(session, q=q), (w.names[i],))


@later
def joint_with_another_zero(w: Works, rng: np.random.Generator) -> Case:
    """The controller counts a joint from where the URDF has a right angle."""
    session, i = w.clean(120), w.any_joint(1, w.arm.n - 1)
    q = session.q.copy()
    q[:, i] += 0.5 * np.pi
    return calibrated(replace(session, q=q), (w.names[i],))


@later
def joint_homed_anew(w: Works, rng: np.random.Generator) -> Case:
    """After an emergency stop a joint is homed half a degree off."""
    i, k = w.any_joint(1, w.arm.n - 1), int(rng.integers(50, 110))
    rows = np.arange(160) >= k
    session = w.clean(160, w.joint(i, lambda s: np.radians(0.5) * rows[: len(s.t)]))
    return calibrated(session, (w.names[i - 1], w.names[i], w.names[i + 1]))


@later
def joint_never_reported(w: Works, rng: np.random.Generator) -> Case:
    """One joint moves and its encoder's topic says zero throughout."""
    session, i = w.clean(130), w.any_joint()
    q = session.q.copy()
    q[:, i] = 0.0
    return calibrated(replace(session, q=q), (w.names[i],))


@later
def coarse_encoder(w: Works, rng: np.random.Generator) -> Case:
    """A joint is reported to a tenth of a degree."""
    session, i = w.clean(140), w.any_joint(0, 3)
    q, step = session.q.copy(), np.radians(0.1)
    q[:, i] = step * np.round(q[:, i] / step)
    return calibrated(replace(session, q=q), ())


@later
def tools_in_turns(w: Works, rng: np.random.Generator) -> Case:
    """Two probes take turns, station by station."""
    rows = np.arange(150) % 2 == 1
    return calibrated(w.clean(150, w.tool(w.way(0.004), w.way(0.01), lambda s: rows[: len(s.t)])), (*TOOL, *LEFT_OUT))


@later
def reflector_swapped_for_moments(w: Works, rng: np.random.Generator) -> Case:
    """Three times another reflector is put on, for five stations each."""
    at = np.sort(rng.choice(np.arange(20, 130, 15), 3, replace=False))
    rows = np.any(np.abs(np.arange(150)[:, None] - at) <= 2, axis=1)
    return calibrated(w.clean(150, w.tool(w.way(0.0025), np.zeros(3), lambda s: rows[: len(s.t)])), (*TOOL, *LEFT_OUT))


@later
def flange_in_place_of_the_tool(w: Works, rng: np.random.Generator) -> Case:
    """Towards the end the instrument's software forgets the tool's offset."""
    offset = -w.cell.tool[1].inv().apply(w.cell.tool[0])
    return calibrated(w.clean(150, w.tool(offset, np.zeros(3), from_(115))), TOOL)


@later
def tool_creeps(w: Works, rng: np.random.Generator) -> Case:
    """A glued target creeps by half a millimetre, ever more slowly."""
    v, tau = w.way(5e-4), rng.uniform(80.0, 200.0)

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tool[:, :3] += np.outer(1.0 - np.exp(-stations.t / tau), v)

    return calibrated(w.clean(150, bend), (*TOOL, w.names[-1]))


@later
def probe_sags(w: Works, rng: np.random.Generator) -> Case:
    """A long probe bends under its own weight, across only."""
    q, again = w.postures(150)
    _, R = w.arm.frames(w.arm.coordinates(q))
    tool = R[:, -1] @ w.cell.tool[1].as_matrix()
    down = -tool[:, 2, :] * [1.0, 0.4, 0.0]

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tool[:, :3] += 4e-4 * down

    return calibrated(w.observe(q, again, bend), (*TOOL, *w.arm.hand, *w.names[-3:]))


@later
def gripper_opens(w: Works, rng: np.random.Generator) -> Case:
    """The target sits on a finger whose joint is recorded and belongs to no link of the chain."""
    q, again = w.postures(160)
    opening = rng.uniform(0.0, 0.04, 160)

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tool[:, 0] += 0.5 * opening

    session = replace(w.observe(q, again, bend), more={"finger_joint": opening})
    return calibrated(session, ("finger_joint", *TOOL))


@later
def rail_not_recorded(w: Works, rng: np.random.Generator) -> Case:
    """The arm stands on a rail that goes to three places, and nobody records it."""
    v, places = w.way(0.3), np.repeat([0.0, 1.0, 0.4], 60)

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tracker[:, :3] -= np.outer(places[: len(stations.t)], v)

    return calibrated(w.clean(180, bend), BASE)


@later
def moved_and_put_back(w: Works, rng: np.random.Generator) -> Case:
    """Somebody borrows the tripod and puts it back to a millimetre."""

    def away(stations):  # type: ignore[no-untyped-def]
        k = np.arange(len(stations.t))
        return (k >= 55) & (k < 100)

    bends = w.base(w.way(0.08), w.way(0.03), away), w.base(w.way(1e-3), w.way(5e-4), from_(100))
    return calibrated(w.clean(160, *bends), BASE)


@later
def crane_shakes_the_floor(w: Works, rng: np.random.Generator) -> Case:
    """The floor tilts to and fro with a period of some minutes."""
    v, period = w.way(4e-4), rng.uniform(180.0, 260.0)
    session = w.clean(170, tilted(w, lambda s: np.outer(np.sin(2.0 * np.pi * s.t / period), v)))
    return calibrated(session, (*BASE, "time", "order", w.names[0]))


@later
def camera_not_square(w: Works, rng: np.random.Generator) -> Case:
    """A camera's axes are not square: a shear of some tenths of a per mille."""
    session = w.clean(160)
    shear = np.eye(3)
    shear[0, 1], shear[1, 2] = 1.2e-3, -8e-4
    return calibrated(replace(session, p=session.p @ shear.T), READING)


@later
def depth_too_long(w: Works, rng: np.random.Generator) -> Case:
    """A camera's depth is too long by three per mille, the other axes are not."""
    session = w.clean(160)
    return calibrated(replace(session, p=session.p * [1.0, 1.0, 1.003]), READING)


@later
def reflections_in_a_corner(w: Works, rng: np.random.Generator) -> Case:
    """In a corner of the room the tracker reads reflections: two millimetres off, some one way, some the other."""
    session = w.clean(160)
    corner = session.p @ w.way(1.0)
    rows = corner > np.quantile(corner, 0.88)
    v = w.way(2.5e-3)
    p = session.p + np.where(rows, rng.choice([-1.0, 1.0], 160), 0.0)[:, None] * v
    return calibrated(replace(session, p=p), LEFT_OUT)


@later
def another_target_in_view(w: Works, rng: np.random.Generator) -> Case:
    """At a fifth of the stations the tracker follows the target of another machine."""
    session = w.clean(150)
    rows = rng.random(150) < 0.2
    other = session.p.mean(axis=0) + rng.uniform(-0.3, 0.3, (150, 3))
    return calibrated(replace(session, p=np.where(rows[:, None], other, session.p)), LEFT_OUT)


@later
def damaged_tooth(w: Works, rng: np.random.Generator) -> Case:
    """A tooth of a gear is worn: a milliradian over a tenth of a radian."""
    i = w.any_joint(0, 4)
    low, high = w.arm.range[:, i]
    middle = rng.uniform(low + 0.5, high - 0.5)
    session = w.clean(220, w.joint(i, lambda s: 1.5e-3 * np.exp(-(((s.q[:, i] - middle) / 0.12) ** 2))))
    return calibrated(session, (w.names[i], *LEFT_OUT))


@later
def stops_short_after_small_moves(w: Works, rng: np.random.Generator) -> Case:
    """A joint with dry friction stops short, the more the smaller the move was."""
    i = w.any_joint(0, 4)

    def off(stations) -> Array:  # type: ignore[no-untyped-def]
        move = np.diff(stations.q[:, i], prepend=w.arm.range[:, i].mean())
        return -1e-3 * np.sign(move) * np.exp(-np.abs(move) / 0.8)

    return calibrated(w.clean(180, w.joint(i, off)), (w.names[i],))


def _mounted(w: Works, turn: Rotation) -> Case:
    """An elastic arm that hangs otherwise than its URDF stands."""
    gravity = turn.inv().apply([0.0, 0.0, -9.81])
    w.arm._model.opt.gravity[:] = gravity
    return calibrated(w.clean(160, w.elastic(8e-4)), (*LOAD, *w.names, "gravity"), shown="if left")


@later
def hangs_from_the_ceiling(w: Works, rng: np.random.Generator) -> Case:
    """An elastic arm hangs from the ceiling."""
    return _mounted(w, Rotation.from_euler("x", np.pi))


@later
def stands_on_a_wall(w: Works, rng: np.random.Generator) -> Case:
    """An elastic arm is mounted on a wall."""
    return _mounted(w, Rotation.from_euler("y", 0.5 * np.pi))


@later
def masses_of_another_unit(w: Works, rng: np.random.Generator) -> Case:
    """The masses of the URDF are in grams, of an elastic arm."""
    session = w.clean(150, w.elastic(6e-4))

    def grams(found: re.Match[str]) -> str:
        return f'<mass value="{1e3 * float(found[1]):.6g}"'

    urdf = re.sub(r'<mass value="([^"]*)"', grams, session.urdf)
    return calibrated(replace(session, urdf=urdf), (r"\bmass", r"\bkg\b", "weigh"))


@later
def computed_with_a_whisper(w: Works, rng: np.random.Generator) -> Case:
    """A driver computes the pose of the tool and a filter adds a micrometre."""
    session = w.observe(*w.postures(120), noise_mm=8e-4, noise_mrad=8e-4, repeat=0.0)
    return calibrated(session, COMPUTED)


@later
def computed_of_commands(w: Works, rng: np.random.Generator) -> Case:
    """The pose is computed from joints that are rounded to a thousandth of a degree."""
    session = w.observe(*w.postures(120), noise_mm=0.0, noise_mrad=0.0, repeat=0.0)
    step = np.radians(1e-3)
    return calibrated(replace(session, q=step * np.round(session.q / step)), COMPUTED)


@later
def another_arm_of_the_series(w: Works, rng: np.random.Generator) -> Case:
    """A calibration is used on the next arm of the same type, base and tool found again."""
    first, second = w.clean(130), Works(w.robot, np.random.default_rng(rng.integers(1 << 30))).clean(80)
    return frozen(first, second, (), "--refit-base", "--refit-tool")


@later
def collision_since(w: Works, rng: np.random.Generator) -> Case:
    """A collision bent a link by a milliradian and moved the tool, which is found again."""
    i = w.any_joint(1, 4)

    def bent(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.x[:, i, 1] += 2e-3

    second = w.clean(80, bent, w.tool(w.way(0.01), w.way(0.02), from_(0)))
    return frozen(w.clean(130), second, (), "--refit-base", "--refit-tool")


@later
def gear_replaced(w: Works, rng: np.random.Generator) -> Case:
    """A gear of which the error was learnt is replaced by one that errs in another phase."""
    i, cycles = w.any_joint(0, 4), int(rng.integers(5, 40))

    def error(phase: float) -> Callable[..., Array]:
        return lambda s: 6e-4 * np.sin(cycles * s.q[:, i] + phase)

    second = w.clean(90, w.joint(i, error(2.4)), begin=86_400.0)
    return frozen(w.clean(150, w.joint(i, error(0.0))), second, (w.names[i], "gear"))


@later
def warm_up_again(w: Works, rng: np.random.Generator) -> Case:
    """An arm grows while it warms up, without a sensor, and the next day it begins cold."""
    tau = rng.uniform(120.0, 200.0)

    def grows(begin: float):  # type: ignore[no-untyped-def]
        def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
            deviation.x[:, 2, 0] += 8e-4 * (1.0 - np.exp(-(stations.t - begin) / tau))

        return bend

    second = w.clean(90, grows(86_400.0), begin=86_400.0)
    return frozen(w.clean(150, grows(0.0)), second, ("time", "drift", "thermal", "warm", "outside"), shown="if left")


@later
def wrist_only(w: Works, rng: np.random.Generator) -> Case:
    """Calibrated with the wrist alone moving, used with the whole arm."""
    q, again = w.postures(120)
    still = q.copy()
    still[:, : w.arm.n - 3] = 0.3 * w.arm.range.mean(axis=0)[: w.arm.n - 3] + 0.2
    second = w.clean(80, begin=120 * PERIOD + 900.0)
    return frozen(w.observe(still, again), second, ("outside", "range", *w.names), shown="if left")


@later
def parallel_recordings_interleaved(w: Works, rng: np.random.Generator) -> Case:
    """Rows of two days, between which tripod and probe were changed, are sorted by the name of the posture."""
    rows = rng.random(160) < 0.5
    bends = (
        w.base(w.way(0.004), w.way(0.002), lambda s: rows[: len(s.t)]),
        w.tool(w.way(0.002), w.way(0.004), lambda s: rows[: len(s.t)]),
    )
    return calibrated(w.clean(160, *bends), (*EITHER, *LEFT_OUT))


@later
def second_half_upside_down(w: Works, rng: np.random.Generator) -> Case:
    """From the middle on the target is mounted the other way round."""
    return calibrated(w.clean(150, w.tool(np.zeros(3), np.array([np.pi, 0.0, 0.0]), from_(75))), TOOL)
