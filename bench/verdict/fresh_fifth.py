"""The fifth group of kinds that were written after the last change to the code, with their words, and run once.

Drawn up by class as before: conventions, order of rows, instrument, surroundings, robot, description, use, and what the
data cannot show. Words are what sends a person to the right place: the joint, the place or the topic at fault. Of an
elastic arm a joint's name is no word for its payload, for its springs are named in any case.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from case import Case, calibrated, frozen, kind
from conventions import ORIENTATION, QUATERNION
from fresh_fourth import READINGS, _joints
from fresh_third import _joint_block
from physics import tilted
from regimes import BASE, TOOL
from scipy.spatial.transform import Rotation
from workcell import NOISE_MM, NOISE_MRAD, Array, Session, Works, joined

# rows that belong elsewhere; "stations 40 to 60" or "rejected stations 3, 9" lead there as well
ROWS = (r"\brows?\b", "order of", "belong", "swapped", "exchanged", "shuffl", "station before", r"stations? \d")
OUT = ("left out", "reject")
UNRELATED = ("do(?:es)? not (?:fit|follow|belong|go with)", "unrelated", "nothing to do with", "random")
MIRROR = ("mirror", "handed", r"\baxes\b", "column", r"\bsign")
fifth = kind("fresh_fifth")


def _mirrored(R: Rotation) -> Rotation:
    """Rotations written in a frame whose y points the other way."""
    turn = R.as_matrix()
    flip = np.diag([1.0, -1.0, 1.0])
    return Rotation.from_matrix(flip @ turn @ flip)


def _read(session: Session, rows: Array) -> Session:
    """Readings taken from other rows; joints and stamps stay."""
    return replace(session, p=session.p[rows], R=session.R[rows])


def _near(w: Works, i: int) -> tuple[str, ...]:
    return w.names[max(i - 1, 0) : i + 2]


def _moves(q: Array) -> Array:
    """How far each joint went to each station, (N, n)."""
    return np.diff(q, axis=0, prepend=q[:1])


def _load(w: Works, q: Array, i: int, axis: int = 3) -> Array:
    """Gravity's torque on a joint, or across it, over its RMS (N,)."""
    load = w.arm.holding(w.arm.coordinates(q))[:, i, axis]
    return load / np.sqrt(np.mean(load**2))


def _known(values: Array) -> Callable[[object], Array]:
    """An error that belongs to the stations by number."""
    return lambda stations: values


# --- conventions -----------------------------------------------------------------------------------------------------


@fifth
def yaw_folded_at_ninety(w: Works, rng: np.random.Generator) -> Case:
    """An export takes yaw by atan where atan2 is meant: beyond 90° orientations are half a turn off, positions not."""
    session = w.clean(140)
    angles = session.R.as_euler("xyz")
    angles[:, 2] = (angles[:, 2] + 0.5 * np.pi) % np.pi - 0.5 * np.pi
    return calibrated(replace(session, R=Rotation.from_euler("xyz", angles)), (*ORIENTATION, *QUATERNION))


@fifth
def orientations_of_the_other_hand(w: Works, rng: np.random.Generator) -> Case:
    """Of a left-handed frame's poses the positions were put right and the orientations forgotten."""
    session = w.clean(130)
    return calibrated(replace(session, R=_mirrored(session.R)), (*ORIENTATION, *QUATERNION, "mirror", "handed"))


@fifth
def wrist_as_sum_and_difference(w: Works, rng: np.random.Generator) -> Case:
    """A driver reports the two motors of a differential wrist where the joints are meant."""
    session = w.clean(140)
    q = session.q.copy()
    a, b = q[:, -2].copy(), q[:, -1].copy()
    q[:, -2], q[:, -1] = a + b, a - b
    return calibrated(replace(session, q=q), w.names[-2:])


@fifth
def range_azimuth_elevation(w: Works, rng: np.random.Generator) -> Case:
    """Columns x, y, z hold the tracker's raw distance and its two angles."""
    session = w.clean(140, kind="point")
    x, y, z = session.p.T
    r = np.linalg.norm(session.p, axis=1)
    raw = np.stack([r, np.arctan2(y, x), np.arcsin(z / r)], axis=1)
    words = ("column", r"\baxes\b", r"\bunits?\b", "spherical", "polar", "angles", "coordinates", *READINGS)
    return calibrated(replace(session, p=raw), words)


@fifth
def small_numbers_in_millimetres(w: Works, rng: np.random.Generator) -> Case:
    """Software prints lengths below a metre in millimetres and longer ones in metres, without the unit."""
    session = w.clean(140)
    p = np.where(np.abs(session.p) < 1.0, 1e3 * session.p, session.p)
    return calibrated(replace(session, p=p), (r"\bunits?\b", r"\bin mm\b", "millimet", "factor", "column"))


@fifth
def motors_of_two_sizes_exchanged(w: Works, rng: np.random.Generator) -> Case:
    """Two joints' drives were exchanged: one counts a quarter too much, the other a fifth too little."""
    session, i, j = w.clean(140), w.arm.n - 3, w.arm.n - 1
    q = session.q.copy()
    q[:, i] *= 1.25
    q[:, j] *= 0.8
    return calibrated(replace(session, q=q), (w.names[i], w.names[j]))


@fifth
def potentiometer_loaded(w: Works, rng: np.random.Generator) -> Case:
    """A joint is measured by a potentiometer whose wiper is loaded: its reading sags towards the middle."""
    session, i = w.clean(150), w.any_joint(0, 4)
    low, high = w.arm.range[:, i]
    u = (session.q[:, i] - low) / (high - low)
    return calibrated(_joints(session, i, low + (high - low) * u / (1.0 + 0.01 * u * (1.0 - u))), (w.names[i],))


# --- rows ------------------------------------------------------------------------------------------------------------


@fifth
def one_joint_refreshed_every_third(w: Works, rng: np.random.Generator) -> Case:
    """A joint on a slow bus is refreshed at every third station and keeps its value in between."""
    session, i = w.clean(140), w.any_joint(0, w.arm.n - 1)
    return calibrated(_joints(session, i, session.q[np.arange(140) // 3 * 3, i]), (w.names[i],))


@fifth
def reading_before_the_trigger(w: Works, rng: np.random.Generator) -> Case:
    """At a fifth of the stations the trigger is lost, and the row holds the reading of the station before once more."""
    session = w.clean(150)
    rows = np.arange(150)
    for k in 1 + np.flatnonzero(rng.random(149) < 0.2):
        rows[k] = rows[k - 1]
    words = ("repeat", "same reading", "identical", "stale", "duplicate", "froze", "stood still", "did not change")
    return calibrated(_read(session, rows), (*words, *ROWS))


@fifth
def packets_in_swapped_pairs(w: Works, rng: np.random.Generator) -> Case:
    """Over a bad line readings arrive in pairs the wrong way round, for forty stations."""
    rows = np.arange(150)
    rows[60:100] = rows[60:100].reshape(-1, 2)[:, ::-1].ravel()
    return calibrated(_read(w.clean(150), rows), (*ROWS, *OUT))


@fifth
def files_sorted_as_text(w: Works, rng: np.random.Generator) -> Case:
    """Readings lie in numbered files that were read in the order 1, 10, 100, 101; joints in that of the numbers."""
    rows = np.array(sorted(range(130), key=lambda k: str(k + 1)))
    return calibrated(_read(w.clean(130), rows), (*ROWS, *UNRELATED))


@fifth
def gaps_filled_by_interpolation(w: Works, rng: np.random.Generator) -> Case:
    """Readings that failed were filled in by a spreadsheet, on the straight line between their neighbours."""
    session = w.clean(150)
    p, rotvec = session.p.copy(), session.R.as_rotvec()
    for k in 1 + rng.choice(49, 12, replace=False) * 3:
        p[k] = 0.5 * (session.p[k - 1] + session.p[k + 1])
        half = (session.R[k - 1].inv() * session.R[k + 1]).as_rotvec() / 2.0
        rotvec[k] = (session.R[k - 1] * Rotation.from_rotvec(half)).as_rotvec()
    words = ("interpolat", "filled", *OUT, *ROWS)
    return calibrated(replace(session, p=p, R=Rotation.from_rotvec(rotvec)), words)


@fifth
def one_coordinate_stands_still(w: Works, rng: np.random.Generator) -> Case:
    """From some station on y keeps its last value; x and z go on."""
    session, k = w.clean(140, kind="point"), 90
    p = session.p.copy()
    p[k:, 1] = p[k, 1]
    words = ("column", r"\by\b", "froze", "stood still", "same value", "constant", r"stations? \d", "cut off")
    return calibrated(replace(session, p=p), words)


@fifth
def joints_typed_by_hand(w: Works, rng: np.random.Generator) -> Case:
    """One joint was typed from the pendant; at some stations two digits changed places."""
    session, i = w.clean(150), w.any_joint(0, w.arm.n - 1)
    q = session.q[:, i].copy()
    rows = rng.choice(150, 22, replace=False)
    for k in rows:
        sign, digits = np.sign(q[k]), list(f"{abs(q[k]):.5f}")
        digits[2], digits[3] = digits[3], digits[2]
        q[k] = sign * float("".join(digits))
    return calibrated(_joints(session, i, q), (w.names[i], *OUT))


# --- instruments and topics ------------------------------------------------------------------------------------------


@fifth
def cyclic_error_of_the_distance_meter(w: Works, rng: np.random.Generator) -> Case:
    """A distance meter errs with the phase of its wave: a third of a millimetre, once in thirty centimetres."""
    session = w.clean(160)
    r = np.linalg.norm(session.p, axis=1, keepdims=True)
    p = session.p * (1.0 + 3.5e-4 * np.sin(2.0 * np.pi * r / 0.3 + 0.4) / r)
    return calibrated(replace(session, p=p), (*READINGS, r"\brange\b", "distance"))


@fifth
def glass_door_closed_half_way(w: Works, rng: np.random.Generator) -> Case:
    """Half way somebody closes the cell's door, and the camera looks through two centimetres of glass, aslant."""
    session, n = w.clean(150), 1.5
    middle = session.p.mean(axis=0) / np.linalg.norm(session.p.mean(axis=0))
    normal = Rotation.from_rotvec(0.8 * np.cross(middle, w.way(1.0))).apply(middle)
    c = session.p @ normal / np.linalg.norm(session.p, axis=1)
    image = 0.02 * (1.0 - c / np.sqrt(n**2 - 1.0 + c**2))
    closed = np.arange(150) >= 75
    p = session.p - np.outer(closed * image, normal)
    return calibrated(replace(session, p=p), (*READINGS, *BASE, r"stations? \d"))


@fifth
def cube_of_markers(w: Works, rng: np.random.Generator) -> Case:
    """The target is a cube with a marker on each side, glued by hand; the camera takes the one that faces it."""
    session = w.clean(170)
    sight = session.R.inv().apply(-session.p)
    axis = np.argmax(np.abs(sight), axis=1)
    face = 2 * axis + (sight[np.arange(170), axis] > 0.0)
    shift, turn = rng.normal(0, 4e-4, (6, 3)), rng.normal(0, 8e-4, (6, 3))
    p = session.p + session.R.apply(shift[face])
    R = session.R * Rotation.from_rotvec(turn[face])
    return calibrated(replace(session, p=p, R=R), (*TOOL, "target", "marker", *READINGS))


@fifth
def autofocus_switches(w: Works, rng: np.random.Generator) -> Case:
    """A camera focuses anew when the target is near: its scale is 0.6 per mille larger on this side."""
    session = w.clean(160)
    r = np.linalg.norm(session.p, axis=1, keepdims=True)
    p = session.p * (1.0 + 6e-4 * (r < np.median(r)))
    return calibrated(replace(session, p=p), (*READINGS, "scale", "distance"))


@fifth
def topic_of_the_target_on_the_elbow(w: Works, rng: np.random.Generator) -> Case:
    """The topic that was recorded is that of a second target, which is glued to the third link."""
    q, again = w.postures(140)
    session = w.observe(q, again)
    p, R = w.arm.frames(w.arm.coordinates(q))
    link, (stand, eye) = Rotation.from_matrix(R[:, 2]), w.cell.tracker
    at = eye.inv().apply(p[:, 2] + link.apply(w.cell.tool[0]) - stand) + rng.normal(0, 1e-3 * NOISE_MM, (140, 3))
    turn = eye.inv() * link * w.cell.tool[1] * Rotation.from_rotvec(rng.normal(0, 1e-3 * NOISE_MRAD, (140, 3)))
    words = (*w.names[3:], w.arm.links[2], r"--?tip\b", r"\btip\b", *TOOL, "another target", "topic")
    return calibrated(replace(session, p=at, R=turn), words)


@fifth
def topic_of_the_table(w: Works, rng: np.random.Generator) -> Case:
    """The topic that was recorded is that of the reference target on the table: noise about one pose."""
    session = w.clean(120)
    p = session.p[0] + rng.normal(0, 1e-3 * NOISE_MM, (120, 3))
    R = session.R[0] * Rotation.from_rotvec(rng.normal(0, 1e-3 * NOISE_MRAD, (120, 3)))
    words = ("stands? still", "stood still", "not move", "does not follow", "constant", "same (?:place|pose|reading)")
    return calibrated(replace(session, p=p, R=R), words)


@fifth
def survey_coordinates_single_precision(w: Works, rng: np.random.Generator) -> Case:
    """Positions in the site's coordinates, kilometres from their origin, went through single precision."""
    session = w.clean(140)
    p = (session.p + [4321.0, 8765.0, 12.0]).astype(np.float32).astype(float)
    words = ("digit", "resolution", "round", "precision", "quanti", r"\bgrid\b", "float", "multiples", "coarse")
    return calibrated(replace(session, p=p), words)


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
