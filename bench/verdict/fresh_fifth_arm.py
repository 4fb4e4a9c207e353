"""The fifth group, the arm and where it stands: surroundings, robot, description, use, and what no data show."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from case import Case, calibrated, frozen
from conventions import QUATERNION

# rows that belong elsewhere; "stations 40 to 60" or "rejected stations 3, 9" lead there as well
from fresh_fifth import MIRROR, UNRELATED, _known, _load, _mirrored, _moves, _near, fifth
from fresh_fourth import READINGS, _joints
from fresh_third import _joint_block
from physics import tilted
from regimes import BASE, TOOL
from workcell import Array, Session, Works, joined

# --- surroundings ----------------------------------------------------------------------------------------------------


@fifth
def neighbour_leans_on_the_table(w: Works, rng: np.random.Generator) -> Case:
    """Another robot on the same table reaches out during three of its seven steps; nobody records it."""
    v = w.way(6e-4)
    turn = np.outer(np.arange(160) % 7 < 3, v)
    return calibrated(w.clean(160, tilted(w, lambda s: turn)), (*BASE, w.names[0], w.arm.parents[0]))


def _carrying(w: Works, q: Array, again: Array, mass: Array, sag: float) -> Session:
    """An elastic arm that carries a mass (N,) [kg] of its own at each station."""
    elastic, state = w.elastic(sag), w.rng.bit_generator.state
    parts = []
    for kilograms in np.unique(mass):
        w.rng.bit_generator.state = state

        def payload(arm, stations, deviation, kilograms=kilograms) -> None:  # type: ignore[no-untyped-def]
            deviation.payload += kilograms

        parts.append(w.observe(q, again, elastic, payload).only(np.flatnonzero(mass == kilograms)))
    whole = parts[0]
    for part in parts[1:]:
        whole = joined(whole, part)
    return whole


CARRIED = ("payload", "carrie[sd]", "weight", r"\bload of", "mass at")


@fifth
def tank_empties(w: Works, rng: np.random.Generator) -> Case:
    """A dispenser on the flange of an elastic arm holds eight kilograms at the beginning and none at the end."""
    q, again = w.postures(150)
    mass = np.round(8.0 * (1.0 - np.arange(150) / 149.0), 0)
    return calibrated(_carrying(w, q, again, mass, 6e-4), (*CARRIED, *TOOL, "drift", r"\btime\b", "changed on the way"))


@fifth
def gripper_holds_the_part(w: Works, rng: np.random.Generator) -> Case:
    """A finger, which is recorded and belongs to no link of the chain, is closed where a part of 7 kg is held."""
    q, again = w.postures(160)
    kinds = np.unique(q, axis=0, return_inverse=True)[1].ravel()
    closed = (rng.random(160) < 0.5)[kinds]
    session = _carrying(w, q, again, np.where(closed, 7.0, 0.0), 6e-4)
    finger = np.where(closed, 0.012, 0.04) + rng.normal(0, 1e-5, 160)
    return calibrated(replace(session, more={"finger_joint": finger}), ("finger", *CARRIED))


@fifth
def balancer_leaks(w: Works, rng: np.random.Generator) -> Case:
    """The gas spring that balances the second joint loses pressure: the joint sags under its load, ever more."""
    q, again = w.postures(150)
    off = 9e-4 * np.arange(150) / 149.0 * _load(w, q, 1)
    return calibrated(w.observe(q, again, w.joint(1, _known(off))), (w.names[1],))


# --- the robot -------------------------------------------------------------------------------------------------------


@fifth
def tool_screws_work_loose(w: Works, rng: np.random.Generator) -> Case:
    """The tool's screws come undone: it drops to its lower side by more and more, half a millimetre at the end."""
    q, again = w.postures(160)
    _, R = w.arm.frames(w.arm.coordinates(q))
    tool = R[:, -1] @ w.cell.tool[1].as_matrix()
    shift = 5e-4 * (np.arange(160) / 159.0) ** 2 * np.sign(tool[:, 2, 1])

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tool[:, 1] -= shift

    return calibrated(w.observe(q, again, bend), (*TOOL, *w.arm.hand, w.names[-1]))


@fifth
def coupling_slips_when_overloaded(w: Works, rng: np.random.Generator) -> Case:
    """A joint's coupling slips by 0.35 mrad wherever its load is large, and keeps what it lost."""
    i = w.any_joint(1, 4)
    q, again = w.postures(160)
    load = _load(w, q, i)
    slip = 3.5e-4 * np.cumsum(np.sign(load) * (np.abs(load) > np.quantile(np.abs(load), 0.85)))
    return calibrated(w.observe(q, again, w.joint(i, _known(slip))), _near(w, i))


@fifth
def bearing_rocks_in_its_seat(w: Works, rng: np.random.Generator) -> Case:
    """A joint's bearing is loose: its axis tips to the side to which it is pulled, by 0.7 mrad."""
    i = w.any_joint(1, 4)
    q, again = w.postures(160)
    side = 7e-4 * np.sign(_load(w, q, i, 1))

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.x[:, i, 1] += side

    return calibrated(w.observe(q, again, bend), (*_near(w, i), w.arm.links[i], w.arm.parents[i]))


@fifth
def encoder_lines_badly_interpolated(w: Works, rng: np.random.Generator) -> Case:
    """Between the 1024 lines of a joint's encoder its reading errs by half a milliradian, the same at every return."""
    session, i = w.clean(170), w.any_joint(0, 4)
    q = session.q[:, i]
    return calibrated(_joints(session, i, q + 5e-4 * np.sin(1024.0 * q + 0.3)), (w.names[i],))


@fifth
def cold_grease(w: Works, rng: np.random.Generator) -> Case:
    """A joint that was cold stops short by a share of its move, less and less while it warms up."""
    i = w.any_joint(0, 4)
    q, again = w.postures(160)
    short = -2.5e-3 * _moves(q)[:, i] * np.exp(-np.arange(160) / 40.0)
    return calibrated(w.observe(q, again, w.joint(i, _known(short))), (w.names[i],))


@fifth
def counts_lost_at_fast_moves(w: Works, rng: np.random.Generator) -> Case:
    """A counter of a joint cannot follow long moves and loses 0.3 mrad each time, to the side of the move."""
    session, i = w.clean(160), w.any_joint(1, 5)
    move = _moves(session.q)[:, i]
    lost = 3e-4 * np.cumsum(np.sign(move) * (np.abs(move) > np.quantile(np.abs(move), 0.7)))
    return calibrated(_joints(session, i, session.q[:, i] - lost), _near(w, i))


@fifth
def plastic_gear_remembers_its_load(w: Works, rng: np.random.Generator) -> Case:
    """A joint of plastic follows its load slowly: a third at each station of what is still to come."""
    i = w.any_joint(1, 4)
    q, again = w.postures(170)
    state, off = 0.0, []
    for load in _load(w, q, i):
        state += 0.33 * (load - state)
        off.append(1.2e-3 * state)
    return calibrated(w.observe(q, again, w.joint(i, _known(np.array(off)))), (w.names[i],))


# --- descriptions ----------------------------------------------------------------------------------------------------


@fifth
def two_origins_exchanged(w: Works, rng: np.random.Generator) -> Case:
    """In the URDF the places of two joints that follow each other stand under each other's name."""
    session = w.clean(140)
    pattern = re.compile(r'xyz="([^"]*)"')
    places = [pattern.search(_joint_block(session, name)) for name in w.names]
    far = [np.zeros(3) if m is None else np.array([float(v) for v in m[1].split()]) for m in places]
    i = max(range(1, w.arm.n - 1), key=lambda k: float(np.linalg.norm(far[k] - far[k + 1])))
    urdf = session.urdf
    for name, place in ((w.names[i], far[i + 1]), (w.names[i + 1], far[i])):
        block = _joint_block(session, name)
        text = f'xyz="{" ".join(f"{v:.12g}" for v in place)}"'
        urdf = urdf.replace(block, pattern.sub(text, block, count=1))
    words = w.names[i - 1 : i + 3]
    return calibrated(replace(session, urdf=urdf), words, shown="if left")


@fifth
def names_of_the_other_arm(w: Works, rng: np.random.Generator) -> Case:
    """Of a robot with two arms the names are exchanged: the arm that was measured stands under the other's."""
    session = w.clean(140)
    other = rng.uniform(*w.arm.range, session.q.shape)
    more = {f"left_{name}": session.q[:, i] for i, name in enumerate(w.names)}
    words = ("left_", "another arm", "other arm", "other joints", *UNRELATED)
    return calibrated(replace(session, q=other, more=more), words, floor=False)


# --- use -------------------------------------------------------------------------------------------------------------


@fifth
def two_joints_swapped_today(w: Works, rng: np.random.Generator) -> Case:
    """The driver was exchanged since the calibration and names two joints the other way round."""
    second, i = w.clean(80, begin=86_400.0), w.any_joint(1, w.arm.n - 1)
    q = second.q.copy()
    q[:, [i, i + 1]] = q[:, [i + 1, i]]
    return frozen(w.clean(120), replace(second, q=q), w.names[i : i + 2])


@fifth
def left_handed_today(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's software writes left-handed poses since the calibration; the base is found again."""
    second = w.clean(80, begin=86_400.0)
    today = replace(second, p=second.p * [1.0, -1.0, 1.0], R=_mirrored(second.R))
    return frozen(w.clean(120), today, (*MIRROR, *QUATERNION), "--refit-base")


@fifth
def scale_today(w: Works, rng: np.random.Generator) -> Case:
    """The camera was calibrated anew since: its scale is 0.8 per mille larger. The base is found again."""
    second = w.clean(90, begin=86_400.0)
    return frozen(w.clean(130), replace(second, p=second.p * 1.0008), (*READINGS, "scale"), "--refit-base")


@fifth
def also_with_a_joint_negated(w: Works, rng: np.random.Generator) -> Case:
    """--also a recording made after an update by which one joint counts the other way round."""
    first, second, i = w.clean(90), w.clean(70, begin=3600.0), w.any_joint(0, w.arm.n - 1)
    second = _joints(second, i, -second.q[:, i])
    steps = (("calibrate", "{first}", "--also", "{second}"),)
    return Case({"first": first, "second": second}, steps, True, (w.names[i],))


@fifth
def also_a_copy_of_it(w: Works, rng: np.random.Generator) -> Case:
    """--also a copy of the same recording, of an arm whose gears err: nothing of it is held out in truth."""
    i, j = rng.permutation(w.arm.n - 1)[:2]
    gears = (w.joint(int(i), lambda s: 4e-4 * np.sin(53.0 * s.q[:, i])),)
    gears += (w.joint(int(j), lambda s: 4e-4 * np.sin(71.0 * s.q[:, j] + 1.0)),)
    session = w.clean(60, *gears)
    words = ("copy", "same recording", "duplicate", "identical", "twice", w.names[i], w.names[j])
    steps = (("calibrate", "{first}", "--also", "{second}"),)
    return Case({"first": session, "second": session}, steps, True, words, shown="if left")


# --- what the data cannot show: anything but calm will do ------------------------------------------------------------


@fifth
def corners_of_a_marker_lock_to_pixels(w: Works, rng: np.random.Generator) -> Case:
    """A camera's directions are drawn to the pixels' middles, so finely that nobody can follow it over the room."""
    session = w.clean(150)
    r = np.linalg.norm(session.p, axis=1)
    azimuth, elevation = np.arctan2(session.p[:, 1], session.p[:, 0]), np.arcsin(session.p[:, 2] / r)
    azimuth = azimuth + 1.2e-4 * np.sin(2.0 * np.pi * azimuth / 6e-4)
    elevation = elevation + 1.2e-4 * np.sin(2.0 * np.pi * elevation / 6e-4)
    flat = r * np.cos(elevation)
    p = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), r * np.sin(elevation)], axis=1)
    return calibrated(replace(session, p=p), shown=False)


@fifth
def head_of_the_tripod_loose(w: Works, rng: np.random.Generator) -> Case:
    """The camera shakes on its tripod by 0.2 mm; nothing is visited twice, so that it may be taken for its noise."""
    session = w.clean(150, returns=0)
    return calibrated(replace(session, p=session.p + rng.normal(0, 2e-4, (150, 3))), shown=False)


@fifth
def scale_of_fifty_millionths(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's scale is off by 50 ppm: the arm's own lengths take it up."""
    session = w.clean(140)
    return calibrated(replace(session, p=session.p * (1.0 + 5e-5)), (*READINGS, "scale"), shown="if left")
