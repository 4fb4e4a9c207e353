"""The fifth group of kinds that were written after the last change to the code, with their words, and run once.

Drawn up by class as before: conventions, order of rows, instrument, surroundings, robot, description, use, and what the
data cannot show. Words are what sends a person to the right place: the joint, the place or the topic at fault. Of an
elastic arm a joint's name is no word for its payload, for its springs are named in any case.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from case import Case, calibrated, kind
from conventions import ORIENTATION, QUATERNION
from fresh_fourth import READINGS, _joints
from regimes import BASE, TOOL
from scipy.spatial.transform import Rotation
from workcell import NOISE_MM, NOISE_MRAD, Array, Session, Works

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
