"""The eighth group: arms, stands and instruments, later use, and values that are stated. Cells of eighth_cell.py."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from case import Case, calibrated, frozen
from eighth_cell import Take, World, Wrong
from fresh_eighth import BASE, TOOL, UNIT, Array, eighth, joints_with, moved
from scipy.spatial.transform import Rotation

STATED = ("stated", "repeatab", "instrument")
LOAD = ("load", "compliance", "gravity", "payload", "elastic", "spring")


def elastic(w: World, per_nm: float, payload: Array | float = 0.0):  # type: ignore[no-untyped-def]
    """Joints that deflect under weight [rad/N m]."""

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        return Wrong(per_nm * w.torques(q, payload))

    return fault


# --- joints ----------------------------------------------------------------------------------------------------------


@eighth
def lost_motion_grows_with_load(w: World, rng: np.random.Generator) -> Case:
    """A gear's hysteresis is as wide as its load is large."""
    i = 1

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        load, off = np.abs(w.torques(q)[:, i]), np.zeros_like(q)
        off[:, i] = 9e-4 * load / load.max() * came[:, i]
        return Wrong(off)

    return calibrated(w.plain(170, fault), (w.names[i],))


@eighth
def dress_pack_pulls_at_the_wrist(w: World, rng: np.random.Generator) -> Case:
    """A hose wound round the last joint: it twists the one before by 0.9 mrad as the last turns, with friction."""
    i, j = w.n - 2, w.n - 1

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        off = np.zeros_like(q)
        off[:, i] = 9e-4 * np.sin(q[:, j] - 0.7) + 2e-4 * came[:, j]
        return Wrong(off)

    return calibrated(w.plain(170, fault), (w.names[i], w.names[j]))


@eighth
def end_of_a_cantilever_table(w: World, rng: np.random.Generator) -> Case:
    """The arm stands on the end of a table: it sinks and tilts by its moment about the table's edge, 20 urad/Nm."""

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        T = w.frames(q, Wrong())
        moment = sum(9.81 * j.mass * T[:, k, 0, 3] for k, j in enumerate(w.joints))
        twist = np.zeros((len(q), 6))
        twist[:, 4], twist[:, 2] = 2e-5 * moment, -8e-6 * moment
        return Wrong(base=twist)

    return calibrated(w.plain(160, fault), (*BASE, w.names[0], *LOAD, "link_0"))


@eighth
def encoder_ring_off_centre_and_payload(w: World, rng: np.random.Generator) -> Case:
    """An encoder's ring off centre, 1.5 mrad once a turn, and 3 kg that were picked up half way by an elastic arm."""
    i, payload = w.some(1, 4), 3.0 * (np.arange(170) >= 90)
    soft = elastic(w, 1e-5, payload)

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        off = np.asarray(soft(q, t, came).joints).copy()
        off[:, i] += 1.5e-3 * np.sin(q[:, i] + 0.6)
        return Wrong(off)

    return calibrated(w.plain(170, fault), (w.names[i], *LOAD, w.names[1]))


@eighth
def link_bends_by_the_part_it_holds(w: World, rng: np.random.Generator) -> Case:
    """A link, no joint, bends by the weight behind it: 0.8 mrad when it lies flat."""
    k = 2

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        T = w.frames(q, Wrong())
        down = np.einsum("nba,b->na", T[:, k, :3, :3], -np.array([0.0, 0.0, 1.0]))
        lever = np.einsum("nba,nb->na", T[:, k, :3, :3], T[:, -1, :3, 3] - T[:, k, :3, 3])
        bend = np.cross(lever, down) * 3e-3
        return Wrong(behind={k: np.column_stack([np.zeros_like(bend), bend])})

    return calibrated(w.plain(160, fault), (*LOAD, *w.names[1:5], "link_2", "link_3"))


@eighth
def joint_of_two_values(w: World, rng: np.random.Generator) -> Case:
    """A cracked coupling sits in one of two places, 0.7 mrad apart, by the last move of a neighbour."""
    i, j = 2, 3

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        off = np.zeros_like(q)
        off[:, i] = 3.5e-4 * came[:, j]
        return Wrong(off)

    return calibrated(w.plain(160, fault), (w.names[i], w.names[j]))


# --- instruments -----------------------------------------------------------------------------------------------------


@eighth
def prism_constant_and_a_kick(w: World, rng: np.random.Generator) -> Case:
    """Every distance 1.2 mm too long, and the tripod was kicked by half a millimetre."""
    take = w.plain(160, moved(w, 0.5, "base", 5e-4, 2e-4), kind="point")
    far = np.linalg.norm(take.p, axis=1, keepdims=True)
    return calibrated(replace(take, p=take.p * (1 + 1.2e-3 / far)), (*BASE, "range", "distance", "scale", "reading"))


@eighth
def levels_itself_wrongly_after_a_nudge(w: World, rng: np.random.Generator) -> Case:
    """The tracker's level compensator hangs: from some station on it turns all readings about its own origin, slowly
    back and forth by 0.15 mrad."""
    take = w.plain(160)
    on = np.clip(take.t - 400.0, 0.0, None)
    turn = Rotation.from_rotvec(np.outer(1.5e-4 * np.sin(on / 55.0), [1.0, 0.3, 0.0]))
    return calibrated(replace(take, p=turn.apply(take.p), R=turn * take.R), (*BASE, r"\btime\b", w.names[0]))


@eighth
def camera_reads_depth_by_its_tilt(w: World, rng: np.random.Generator) -> Case:
    """A camera's depth of a board is wrong by 0.8 mm times the squared sine of its tilt to the line of sight."""
    take = w.plain(170)
    sight = take.p / np.linalg.norm(take.p, axis=1, keepdims=True)
    tilt = 1 - np.sum(take.R.apply([0.0, 0.0, 1.0]) * sight, axis=1) ** 2
    return calibrated(replace(take, p=take.p + 8e-4 * tilt[:, None] * sight), (*BASE, "reading", "sight", *TOOL))


@eighth
def tenth_of_a_millimetre_typed(w: World, rng: np.random.Generator) -> Case:
    """Positions typed to a tenth of a millimetre, orientations in full: 0.05 mm RMS that nobody can make up for."""
    take = w.plain(140, noise_mm=0.005)
    p = np.round(take.p, 4)
    return calibrated(replace(take, p=p), ("digit", "decimal", "step", "round", "grid", "whole"), shown="if left")


@eighth
def distances_grow_with_air_pressure(w: World, rng: np.random.Generator) -> Case:
    """Weather: the scale drifts by 60 ppm within the recording, in a way that nobody records."""
    take = w.plain(170, kind="point", noise_mm=0.01)
    scale = 1 + 6e-5 * np.sin(take.t / 330.0 + 1.0)
    return calibrated(replace(take, p=take.p * scale[:, None]), (*BASE, "scale", r"\btime\b"), shown="if left")


@eighth
def press_next_door(w: World, rng: np.random.Generator) -> Case:
    """A press that nobody records shakes the stand by 0.1 mm now and then, which may be taken for scatter."""
    hits = 1e-4 * (rng.random(150) < 0.4)[:, None] * np.array([0, 0, 1.0, 0, 0, 0])
    take = w.plain(150, lambda q, t, came: Wrong(base=hits))
    return calibrated(
        replace(take, floor_mm=float(np.hypot(take.floor_mm, 1e3 * np.std(hits[:, 2])))), BASE, shown="if left"
    )


# --- later -----------------------------------------------------------------------------------------------------------


@eighth
def other_arm_base_and_tool_refitted(w: World, rng: np.random.Generator) -> Case:
    """The calibration is another arm's, of the same type; base and tool are found again, 0.5 mm allowed."""
    first = w.plain(130)
    w.rebuild()
    second = w.plain(60, begin=86400.0)
    words = (*w.names, "robot", "calibration", "pattern", "geometry", "fail")
    return frozen(first, second, words, "--refit-base", "--refit-tool", "--tolerance-mm", "0.5")


@eighth
def one_joint_in_degrees_today(w: World, rng: np.random.Generator) -> Case:
    """Today one joint is written in degrees; the calibration is from before."""
    i, second = w.some(), w.plain(60, begin=86400.0)
    return frozen(w.plain(130), joints_with(second, i, np.degrees(second.q[:, i])), (w.names[i],), "--refit-base")


@eighth
def tool_a_little_shorter_today(w: World, rng: np.random.Generator) -> Case:
    """Somebody ground the probe by 0.3 mm since, and asks for the base to be found again."""
    ground = moved(w, 0.0, "tool", 3e-4, 0.0)
    return frozen(w.plain(130), w.plain(70, ground, begin=86400.0), TOOL, "--refit-base")


@eighth
def softer_since(w: World, rng: np.random.Generator) -> Case:
    """A joint's bearing wears: today it deflects twice as far under the same weight."""
    i = 1
    second = elastic(w, 1e-5)

    def worn(q: Array, t: Array, came: Array) -> Wrong:
        off = np.asarray(second(q, t, came).joints).copy()
        off[:, i] *= 2.0
        return Wrong(off)

    return frozen(w.plain(140, elastic(w, 1e-5)), w.plain(70, worn, begin=86400.0), (w.names[i], *LOAD), "--refit-base")


@eighth
def handful_of_stations_today(w: World, rng: np.random.Generator) -> Case:
    """Nine stations, an arm whose third joint was mastered 1 mrad off since, 0.2 mm allowed."""
    second = w.plain(9, returns=0, begin=86400.0)
    second = joints_with(second, 2, second.q[:, 2] + 1e-3)
    return frozen(w.plain(130), second, (w.names[2], "fail"), "--tolerance-mm", "0.2")


# --- stated, and contradicted by the data ----------------------------------------------------------------------------


def _backlash(w: World, size: float, count: int = 160) -> tuple[Take, int]:
    i = w.some(1, 4)

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        off = np.zeros_like(q)
        off[:, i] = 0.5 * size * came[:, i]
        return Wrong(off)

    return w.plain(count, fault), i


@eighth
def repeatability_stated_far_too_large(w: World, rng: np.random.Generator) -> Case:
    """2 mm are stated of an arm that repeats to 0.02 and has a gear with 70 cycles that errs by 0.4 mrad."""
    i = w.some(1, 4)

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        off = np.zeros_like(q)
        off[:, i] = 4e-4 * np.sin(70 * q[:, i] + 1.0)
        return Wrong(off)

    options = ("--repeatability-mm", "2.0", "--instrument-mm", "0.04", "--geometry-only")
    return calibrated(w.plain(170, fault), (*STATED, w.names[i]), *options)


@eighth
def repeatability_stated_far_too_small(w: World, rng: np.random.Generator) -> Case:
    """5 um and 1 um are stated of an arm that scatters by 0.05 mm."""
    options = ("--repeatability-mm", "0.005", "--instrument-mm", "0.001")
    return calibrated(w.plain(140), STATED, *options)


@eighth
def points_returns_and_a_large_stated_instrument(w: World, rng: np.random.Generator) -> Case:
    """An instrument of 1 mm is stated, returns repeat to 0.05 mm, and a joint has backlash; 2 mm are allowed."""
    take, i = _backlash(w, 1.2e-3)
    options = ("--instrument-mm", "1.0", "--tolerance-mm", "2")
    return calibrated(replace(take, kind="point"), (*STATED, w.names[i]), *options)


@eighth
def masses_a_tenth(w: World, rng: np.random.Generator) -> Case:
    """The URDF's masses are a tenth of the true ones, of an elastic arm: stiffness takes it up."""
    take = w.plain(150, elastic(w, 2e-5))
    urdf = take.urdf
    for j in w.joints:
        urdf = urdf.replace(f'mass value="{j.mass}"', f'mass value="{0.1 * j.mass:.4f}"')
    return calibrated(replace(take, urdf=urdf), (*LOAD, "mass"), shown="if left")


@eighth
def known_distance_is_another_ones(w: World, rng: np.random.Generator) -> Case:
    """A scale that is 3 per mille off, of points, and the tool's place is stated to a tenth of a millimetre.

    Corrected after the first run, which called it calm and wrong: a tool of 10 cm tells a scale to no more than that,
    and a scale is the same as an arm that is so much longer.
    """
    take = w.plain(160, kind="point")
    x, y, z = (float(v) for v in w.target[0])
    cell = f"tool: {{position_m: [{x:.5f}, {y:.5f}, {z:.5f}], std_m: 0.0001}}\n"
    words = (*UNIT, *BASE, *TOOL, "stated")
    case = calibrated(replace(take, p=1.003 * take.p), words, "--cell", "{cell.yaml}", shown="if left")
    return replace(case, files={"cell.yaml": cell})


# --- read again and again: written later, beside the rule that keeps a posture in one set ----------------------------


def _read_again(w: World, postures: int, times: int, size: float, **options: Any) -> Take:
    """Each posture read several times without being left; three gears err many times a turn."""
    order = np.repeat(np.arange(postures), times)
    q = w.postures(postures, 0)[0][order]

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        off = np.zeros_like(q)
        off[:, :3] = size * np.sin(q[:, :3] * [43.0, 57.0, 71.0] + 1.0)
        return Wrong(off)

    return w.record(q, None, fault, repeat=0.0, **options)


STATED_WELL = ("--repeatability-mm", "0.02", "--instrument-mm", "0.044", "--tolerance-mm", "0.3")


@eighth
def sixteen_points_read_five_times(w: World, rng: np.random.Generator) -> Case:
    """Sixteen points are too few for an arm, however often they are read."""
    take = _read_again(w, 16, 5, 8e-4, kind="point")
    return calibrated(take, (r"\bpostures\b", *w.names[:3]), *STATED_WELL)


@eighth
def thirty_points_read_four_times(w: World, rng: np.random.Generator) -> Case:
    """Thirty are enough for its geometry, and not for its gears."""
    return calibrated(_read_again(w, 30, 4, 8e-4, kind="point"), (), *STATED_WELL, shown="if left")


@eighth
def five_rounds_of_twenty_poses(w: World, rng: np.random.Generator) -> Case:
    """Twenty poses are gone to five times, one after the other."""
    take = _read_again(w, 100, 1, 8e-4)
    q = np.tile(take.q[:20], (5, 1))

    def fault(q: Array, t: Array, came: Array) -> Wrong:
        off = np.zeros_like(q)
        off[:, :3] = 8e-4 * np.sin(q[:, :3] * [43.0, 57.0, 71.0] + 1.0)
        return Wrong(off)

    return calibrated(w.record(q, None, fault), (), "--tolerance-mm", "0.3", shown="if left")
