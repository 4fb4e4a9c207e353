"""Kinds near those that the fifth fresh group had missed, written together with the rules that name them.

Joint columns that are mixtures of the true ones, folded, clipped, copied; units that change from cell to cell;
orientations that lost a sign; instruments whose volume is sheared, too large, or wrong in one corner.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from case import Case, calibrated, frozen, kind
from conventions import ORIENTATION, QUATERNION
from fresh_fourth import READINGS, _joints
from regimes import BASE, TOOL
from scipy.spatial.transform import Rotation
from workcell import Array, Session, Works

ROWS = (r"\brows?\b", "order of", "belong", "swapped", "exchanged", r"stations? \d")
UNITS = (r"\bunits?\b", "millimet", "centimet", "inch", "factor", "scale", "times as long")
nearby = kind("nearby")


def _mapped(session: Session, B: Array) -> Session:
    """Joint states that hold a linear map of the true positions."""
    return replace(session, q=session.q @ B.T)


# --- joints ----------------------------------------------------------------------------------------------------------


@nearby
def angles_to_the_horizon(w: Works, rng: np.random.Generator) -> Case:
    """Three joints in a row are reported as angles to the horizon: each holds the sum of those before."""
    B = np.eye(w.arm.n)
    B[2, 1] = B[3, 1] = B[3, 2] = 1.0
    return calibrated(_mapped(w.clean(140), B), w.names[2:4])


@nearby
def motor_of_the_elbow_in_the_shoulder(w: Works, rng: np.random.Generator) -> Case:
    """A belt runs over the shoulder: the elbow's motor counts half of the shoulder's angle as well."""
    B = np.eye(w.arm.n)
    B[2, 1] = 0.5
    return calibrated(_mapped(w.clean(140), B), (w.names[2],))


@nearby
def wrist_means_by_points(w: Works, rng: np.random.Generator) -> Case:
    """Mean and half the difference of two wrist joints, seen by a reflector."""
    B, i = np.eye(w.arm.n), w.arm.n - 3
    B[np.ix_((i, i + 1), (i, i + 1))] = [[0.5, 0.5], [0.5, -0.5]]
    return calibrated(_mapped(w.clean(150, kind="point"), B), w.names[i : i + 2])


@nearby
def zeros_of_another_table(w: Works, rng: np.random.Generator) -> Case:
    """Zeros of three joints follow another convention: a quarter turn, a half turn, a quarter turn back."""
    q = w.clean(140)
    c = np.zeros(w.arm.n)
    c[1:4] = np.array([0.5, 1.0, -0.5]) * np.pi
    return calibrated(replace(q, q=q.q + c), w.names[1:4])


@nearby
def joint_folded(w: Works, rng: np.random.Generator) -> Case:
    """A joint is reported modulo a half turn."""
    session, i = w.clean(140), int(np.argmax(w.arm.range[1] - w.arm.range[0]))
    return calibrated(_joints(session, i, (session.q[:, i] + 0.5 * np.pi) % np.pi - 0.5 * np.pi), (w.names[i],))


@nearby
def joint_clipped_at_both_ends(w: Works, rng: np.random.Generator) -> Case:
    """A joint's reported position is clipped where its soft limit is set."""
    session, i = w.clean(140), w.any_joint(0, w.arm.n - 1)
    low, high = np.quantile(session.q[:, i], [0.15, 0.85])
    return calibrated(_joints(session, i, np.clip(session.q[:, i], low, high)), (w.names[i], "reject"))


@nearby
def joint_without_its_sign(w: Works, rng: np.random.Generator) -> Case:
    """A joint is written without its sign."""
    session, i = w.clean(140), int(np.argmax(w.arm.range[1] - w.arm.range[0]))
    return calibrated(_joints(session, i, np.abs(session.q[:, i])), (w.names[i],))


@nearby
def joint_copied_from_its_neighbour(w: Works, rng: np.random.Generator) -> Case:
    """A column was pasted twice: a joint holds its neighbour's positions."""
    session, i = w.clean(140), w.any_joint(1, w.arm.n - 1)
    return calibrated(_joints(session, i, session.q[:, i - 1]), (w.names[i],))


@nearby
def joint_as_steps(w: Works, rng: np.random.Generator) -> Case:
    """A joint's column holds how far it went, not where it is."""
    session, i = w.clean(140), w.any_joint(1, w.arm.n - 1)
    return calibrated(_joints(session, i, np.diff(session.q[:, i], prepend=0.0)), (w.names[i],))


@nearby
def two_joints_stale_from_some_station(w: Works, rng: np.random.Generator) -> Case:
    """The driver of two joints died half way: both keep their last values."""
    session, i = w.clean(150), w.any_joint(1, w.arm.n - 2)
    q = session.q.copy()
    q[75:, i : i + 2] = q[75, i : i + 2]
    return calibrated(replace(session, q=q), (*w.names[i : i + 2], r"stations? \d"))


@nearby
def one_joint_swapped_in_pairs(w: Works, rng: np.random.Generator) -> Case:
    """Packets of one joint arrive in pairs the wrong way round, everywhere."""
    session, i = w.clean(140), w.any_joint(0, w.arm.n - 1)
    return calibrated(_joints(session, i, session.q[:, i].reshape(-1, 2)[:, ::-1].ravel()), (w.names[i],))


@nearby
def joint_of_a_second_encoder_that_slips(w: Works, rng: np.random.Generator) -> Case:
    """At a sixth of the stations a joint is reported by the motor's encoder, which lags by three milliradians."""
    session, i = w.clean(150), w.any_joint(0, 4)
    off = 3e-3 * (rng.random(150) < 1.0 / 6.0)
    return calibrated(_joints(session, i, session.q[:, i] + off), (w.names[i],))


# --- readings --------------------------------------------------------------------------------------------------------


@nearby
def positions_in_centimetres(w: Works, rng: np.random.Generator) -> Case:
    """The whole table is in centimetres."""
    session = w.clean(130)
    return calibrated(replace(session, p=100.0 * session.p), UNITS)


@nearby
def a_third_in_inches(w: Works, rng: np.random.Generator) -> Case:
    """The last third was exported in inches."""
    session = w.clean(150)
    p = session.p.copy()
    p[100:] /= 0.0254
    return calibrated(replace(session, p=p), UNITS)


@nearby
def a_fifth_in_millimetres(w: Works, rng: np.random.Generator) -> Case:
    """A fifth of the rows, here and there, is in millimetres."""
    session = w.clean(150)
    some = rng.random(150) < 0.2
    return calibrated(replace(session, p=np.where(some[:, None], 1e3 * session.p, session.p)), UNITS)


@nearby
def column_sorted_by_itself(w: Works, rng: np.random.Generator) -> Case:
    """One column of a table was sorted, and the others were not."""
    session = w.clean(140)
    p = session.p.copy()
    p[:, 2] = np.sort(p[:, 2])
    return calibrated(replace(session, p=p), (r"\bz\b", "column", "coordinate", "sorted", *ROWS))


@nearby
def quaternions_without_signs(w: Works, rng: np.random.Generator) -> Case:
    """A form that takes no minus: quaternions are all positive."""
    session = w.clean(140)
    return calibrated(replace(session, R=Rotation.from_quat(np.abs(session.R.as_quat()))), (*ORIENTATION, *QUATERNION))


@nearby
def pitch_without_its_sign(w: Works, rng: np.random.Generator) -> Case:
    """Pitch is written without its sign."""
    session = w.clean(140)
    angles = session.R.as_euler("xyz")
    angles[:, 1] = np.abs(angles[:, 1])
    return calibrated(replace(session, R=Rotation.from_euler("xyz", angles)), (*ORIENTATION, *QUATERNION))


@nearby
def roll_folded(w: Works, rng: np.random.Generator) -> Case:
    """Roll by atan where atan2 is meant."""
    session = w.clean(140)
    angles = session.R.as_euler("xyz")
    angles[:, 0] = (angles[:, 0] + 0.5 * np.pi) % np.pi - 0.5 * np.pi
    return calibrated(replace(session, R=Rotation.from_euler("xyz", angles)), (*ORIENTATION, *QUATERNION))


@nearby
def angles_in_whole_degrees(w: Works, rng: np.random.Generator) -> Case:
    """Orientations are typed in whole degrees."""
    session = w.clean(140)
    angles = np.round(session.R.as_euler("xyz", degrees=True))
    R = Rotation.from_euler("xyz", angles, degrees=True)
    return calibrated(replace(session, R=R), (*ORIENTATION, "digit", "round", "resolution"))


@nearby
def scale_of_two_per_mille(w: Works, rng: np.random.Generator) -> Case:
    """A camera's scale is off by two per mille."""
    session = w.clean(150)
    return calibrated(replace(session, p=1.002 * session.p), (*READINGS, "scale"), shown="if left")


@nearby
def axes_of_the_tracker_not_square(w: Works, rng: np.random.Generator) -> Case:
    """A measuring machine's x leans by a milliradian towards its y."""
    session = w.clean(150)
    p = session.p.copy()
    p[:, 1] += 1e-3 * p[:, 0]
    return calibrated(replace(session, p=p), READINGS, shown="if left")


@nearby
def one_axis_of_the_tracker_too_long(w: Works, rng: np.random.Generator) -> Case:
    """One coordinate of a camera, its depth, is half a per mille too long."""
    session = w.clean(150)
    return calibrated(replace(session, p=session.p * [1.0, 1.0, 1.0005]), (*READINGS, "scale"), shown="if left")


@nearby
def reflection_in_a_corner(w: Works, rng: np.random.Generator) -> Case:
    """In one corner of the cell a reflection shifts what the camera sees by two millimetres."""
    session = w.clean(160)
    corner = (session.p - np.quantile(session.p, 0.6, axis=0) > 0.0).sum(axis=1) >= 2
    p = session.p + np.outer(corner, w.way(2e-3))
    return calibrated(replace(session, p=p), (*READINGS, *BASE, "reject", r"stations? \d"))


@nearby
def two_cameras_take_turns(w: Works, rng: np.random.Generator) -> Case:
    """Whichever camera sees the target better speaks: the second stands 0.6 mm off."""
    session = w.clean(150)
    second = rng.random(150) < 0.35
    p = session.p + np.outer(second, w.way(6e-4))
    return calibrated(replace(session, p=p), (*READINGS, *BASE, "two groups", "two places", r"stations? \d"))


@nearby
def target_seen_in_the_frame_of_the_second_link(w: Works, rng: np.random.Generator) -> Case:
    """The camera is bolted to the second link instead of the wall."""
    q, again = w.postures(140)
    session = w.observe(q, again)
    p, R = w.arm.frames(w.arm.coordinates(q))
    link, (_, eye) = Rotation.from_matrix(R[:, 1]), w.cell.tracker
    world_p, world_R = w.cell.tracker[0] + eye.apply(session.p), eye * session.R
    at, turn = (link * eye).inv().apply(world_p - p[:, 1]), (link * eye).inv() * world_R
    words = (w.names[1], w.names[0], w.arm.links[1], "moves? along", "mounted")
    return calibrated(replace(session, p=at, R=turn), words)


@nearby
def joints_mixed_today(w: Works, rng: np.random.Generator) -> Case:
    """Since an update the driver reports the wrist's motors instead of its joints."""
    second, i = w.clean(90, begin=86_400.0), w.arm.n - 2
    q = second.q.copy()
    q[:, i], q[:, i + 1] = q[:, i] + q[:, i + 1], q[:, i] - q[:, i + 1]
    return frozen(w.clean(120), replace(second, q=q), w.names[i : i + 2])


@nearby
def target_on_the_elbow_today(w: Works, rng: np.random.Generator) -> Case:
    """Today the other target's topic was recorded, that on the third link."""
    first, (q, again) = w.clean(120), w.postures(90)
    session = w.observe(q, again, begin=86_400.0)
    p, R = w.arm.frames(w.arm.coordinates(q))
    link, (stand, eye) = Rotation.from_matrix(R[:, 2]), w.cell.tracker
    at = eye.inv().apply(p[:, 2] + link.apply(w.cell.tool[0]) - stand)
    session = replace(session, p=at + rng.normal(0, 2e-5, (90, 3)), R=eye.inv() * link * w.cell.tool[1])
    words = (*w.names[3:], w.arm.links[2], r"--?tip\b", *TOOL, "topic")
    return frozen(first, session, words)


@nearby
def a_tenth_left_out_as_impossible(w: Works, rng: np.random.Generator) -> Case:
    """At a tenth of the stations a tracker that lost its target writes a place behind the moon."""
    session = w.clean(150)
    lost = rng.random(150) < 0.12
    p = np.where(lost[:, None], 1e9, session.p)
    return calibrated(replace(session, p=p), ("left out", "too far away"))
