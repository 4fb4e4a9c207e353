"""Kinds that stand near those which groups written blind had missed: frames, rows, joints, scatter.

They were written together with the rules that name them and say that these hold for a class, not for one kind.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from case import Case, calibrated, kind
from conventions import ORIENTATION, UNIT
from scipy.spatial.transform import Rotation
from workcell import Array, Session, Works

FRAME = ("frame", r"\baxes\b", "invers", "turned")
ROWS = (r"\brows?\b", r"\border\b", "late", "early", r"another station|other stations")
POLAR = ("polar", "azimuth", "angles?", "spherical")
READ = (r"\btracker", r"readings? (?:look|depend|stand)")
SCATTER = ("scatter", "wobbl", "spread")
near = kind("nearby")


def _q(session: Session, q: Array) -> Session:
    return replace(session, q=q)


def _rows(session: Session, rows: Array) -> Session:
    """Readings of these rows at each station."""
    return replace(session, p=session.p[rows], R=session.R[rows])


def _block(low: int, high: int, count: int, order: Array) -> Array:
    rows = np.arange(count)
    rows[low:high] = order
    return rows


# --- frames ----------------------------------------------------------------------------------------------------------


@near
def positions_turned_by_the_pose(w: Works, rng: np.random.Generator) -> Case:
    """Positions were turned by the orientation once too often."""
    session = w.clean(130)
    return calibrated(replace(session, p=session.R.apply(session.p)), FRAME)


@near
def positions_alone_inverted(w: Works, rng: np.random.Generator) -> Case:
    """Positions are those of the tracker in the tool, orientations those of the tool in the tracker."""
    session = w.clean(130)
    return calibrated(replace(session, p=-session.R.inv().apply(session.p)), FRAME)


@near
def positions_are_increments(w: Works, rng: np.random.Generator) -> Case:
    """A log holds how far the target went since the last station."""
    session = w.clean(130)
    p = np.diff(session.p, axis=0, prepend=session.p[:1])
    return calibrated(replace(session, p=p), ("last", "increment", "difference", *ROWS))


@near
def polar_coordinates(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's azimuth, elevation and range stand in the columns of x, y and z."""
    session = w.clean(130, kind="point")
    r = np.linalg.norm(session.p, axis=1)
    p = np.column_stack([np.arctan2(session.p[:, 1], session.p[:, 0]), np.arcsin(session.p[:, 2] / r), r])
    return calibrated(replace(session, p=p), POLAR)


@near
def polar_coordinates_in_degrees(w: Works, rng: np.random.Generator) -> Case:
    """The same with poses, range first, the angle from the zenith, and degrees."""
    session = w.clean(130)
    r = np.linalg.norm(session.p, axis=1)
    angles = np.degrees([np.arctan2(session.p[:, 1], session.p[:, 0]), np.arccos(session.p[:, 2] / r)])
    return calibrated(replace(session, p=np.column_stack([r, *angles])), POLAR)


@near
def orientations_of_a_left_handed_frame(w: Works, rng: np.random.Generator) -> Case:
    """Orientations were converted from a left-handed frame, positions were not."""
    session = w.clean(130)
    M = np.diag([1.0, -1.0, 1.0])
    return calibrated(replace(session, R=Rotation.from_matrix(M @ session.R.as_matrix() @ M)), ORIENTATION)


@near
def two_mistakes_at_once(w: Works, rng: np.random.Generator) -> Case:
    """Orientations are inverse, and positions in centimetres."""
    session = w.clean(130)
    return calibrated(replace(session, p=100.0 * session.p, R=session.R.inv()), (*ORIENTATION, *UNIT, "scale"))


@near
def two_axes_in_millimetres(w: Works, rng: np.random.Generator) -> Case:
    """Two of three columns are in millimetres."""
    session = w.clean(130)
    return calibrated(replace(session, p=session.p * [1e3, 1.0, 1e3]), (*UNIT, r"\bx\b", r"\by\b", "coordinate"))


@near
def tool_frame_in_a_part(w: Works, rng: np.random.Generator) -> Case:
    """From some station on positions are given along the tool's axes."""
    session = w.clean(130)
    here = (np.arange(130) >= 80)[:, None]
    return calibrated(replace(session, p=np.where(here, session.R.inv().apply(session.p), session.p)), FRAME)


# --- rows ------------------------------------------------------------------------------------------------------------


@near
def joint_states_of_the_station_before(w: Works, rng: np.random.Generator) -> Case:
    """From two thirds on joint states are one station late."""
    session = w.clean(140)
    q = session.q.copy()
    q[95:] = q[94:-1].copy()
    return calibrated(_q(session, q), ROWS)


@near
def neighbours_swapped(w: Works, rng: np.random.Generator) -> Case:
    """A quarter of the rows stand in each other's place, two and two."""
    session = w.clean(140)
    rows = np.arange(140)
    for k in range(0, 138, 2):
        if rng.random() < 0.25:
            rows[[k, k + 1]] = rows[[k + 1, k]]
    return calibrated(_rows(session, rows), (*ROWS, "swap"))


@near
def readings_in_reverse_order(w: Works, rng: np.random.Generator) -> Case:
    """The table of readings is sorted from the last to the first."""
    return calibrated(_rows(w.clean(130), np.arange(130)[::-1]), (*ROWS, "revers"))


@near
def points_in_reverse_order_in_a_part(w: Works, rng: np.random.Generator) -> Case:
    """The second part of a table of points was pasted upside down."""
    rows = _block(85, 140, 140, np.arange(85, 140)[::-1])
    return calibrated(_rows(w.clean(140, kind="point"), rows), (*ROWS, "revers"))


@near
def files_sorted_by_name(w: Works, rng: np.random.Generator) -> Case:
    """A reading a file, and files sorted by name: 1, 10, 100, 101, …"""
    rows = np.array(sorted(range(130), key=lambda k: str(k + 1)))
    return calibrated(_rows(w.clean(130), rows), (*ROWS, "sort", "name"))


@near
def halves_exchanged(w: Works, rng: np.random.Generator) -> Case:
    """Two halves of the readings were joined the wrong way round; points."""
    rows = np.r_[np.arange(61, 130), np.arange(61)]
    return calibrated(_rows(w.clean(130, kind="point"), rows), ROWS)


@near
def a_row_missing(w: Works, rng: np.random.Generator) -> Case:
    """A reading was left out at one third: all below stand one row too high; points."""
    rows = np.minimum(np.r_[np.arange(50), np.arange(51, 141)], 139)
    return calibrated(_rows(w.clean(140, kind="point"), rows), ROWS)


@near
def late_by_seven(w: Works, rng: np.random.Generator) -> Case:
    """A table slipped by seven rows."""
    return calibrated(_rows(w.clean(130), np.maximum(np.arange(130) - 7, 0)), ROWS)


@near
def one_joint_of_another_row_in_a_part(w: Works, rng: np.random.Generator) -> Case:
    """One joint's column slipped by two rows from the middle on."""
    session, i = w.clean(140), w.any_joint(0, w.arm.n - 1)
    q = session.q.copy()
    q[72:, i] = q[70:-2, i].copy()
    return calibrated(_q(session, q), (w.names[i],))


@near
def repetitions_of_two_operators(w: Works, rng: np.random.Generator) -> Case:
    """Some readings belong to any other station: labels were mixed up at a quarter of them."""
    session = w.clean(140)
    rows, mixed = np.arange(140), np.flatnonzero(rng.random(140) < 0.25)
    rows[mixed] = rng.permutation(mixed)
    return calibrated(_rows(session, rows), (*ROWS, "mixed", "label"))


# --- joints ----------------------------------------------------------------------------------------------------------


@near
def stale_joint_seen_by_points(w: Works, rng: np.random.Generator) -> Case:
    """One joint's position stands still for a third of a recording of points."""
    session, i = w.clean(150, kind="point"), w.any_joint(0, 4)
    q = session.q.copy()
    q[60:110, i] = q[60, i]
    return calibrated(_q(session, q), (w.names[i],))


@near
def swapped_and_negated_seen_by_points(w: Works, rng: np.random.Generator) -> Case:
    """Two joints stand under each other's names, one with the other sign; points."""
    session, i = w.clean(150, kind="point"), w.any_joint(0, 3)
    q = session.q.copy()
    q[:, [i, i + 1]] = q[:, [i + 1, i]] * [1.0, -1.0]
    return calibrated(_q(session, q), w.names[i : i + 2])


@near
def coupled_joint_seen_by_points(w: Works, rng: np.random.Generator) -> Case:
    """A joint is counted from the horizontal, as drives with a parallelogram do; points."""
    session = w.clean(150, kind="point")
    q = session.q.copy()
    q[:, 2] += q[:, 1]
    return calibrated(_q(session, q), (w.names[2], w.names[1]))


@near
def three_joints_reversed_in_a_part(w: Works, rng: np.random.Generator) -> Case:
    """After an update of the driver three joints count the other way."""
    session = w.clean(150)
    q = session.q.copy()
    some = np.sort(rng.choice(w.arm.n - 1, 3, replace=False))
    q[90:, some] *= -1.0
    return calibrated(_q(session, q), tuple(w.names[i] for i in some))


@near
def joint_of_another_arm(w: Works, rng: np.random.Generator) -> Case:
    """One joint's column is that of the arm beside; points."""
    session, i = w.clean(150, kind="point"), w.any_joint(0, 4)
    q = session.q.copy()
    q[:, i] = w.postures(150)[0][:, i]
    return calibrated(_q(session, q), (w.names[i],))


@near
def pi_of_three_digits(w: Works, rng: np.random.Generator) -> Case:
    """Degrees were converted with a pi of 3.14."""
    session = w.clean(140)
    return calibrated(_q(session, session.q * 3.14 / np.pi), (*w.names, "scale", "pi"))


@near
def joint_clipped_near_its_end(w: Works, rng: np.random.Generator) -> Case:
    """A filter cuts one joint's position off near its end."""
    session, i = w.clean(150), w.any_joint(0, 4)
    q = session.q.copy()
    q[:, i] = np.minimum(q[:, i], np.quantile(q[:, i], 0.85))
    return calibrated(_q(session, q), (w.names[i],))


@near
def joint_on_another_turn_and_elastic(w: Works, rng: np.random.Generator) -> Case:
    """One joint's twelve bits: 4096 steps a turn."""
    session, i = w.clean(150), w.any_joint(0, 4)
    q, step = session.q.copy(), 2.0 * np.pi / 4096.0
    q[:, i] = np.round(q[:, i] / step) * step
    return calibrated(_q(session, q), (w.names[i],))
