"""Readings and joints in a convention that is not the one expected, in whole or in part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from case import Case, calibrated, kind
from scipy.spatial.transform import Rotation
from workcell import Session, Works

QUATERNION = ("quaternion", r"\borientation", "rotation")
ORIENTATION = ("euler", "sequence", "convention", r"\borientation", "rotation")
UNIT = (r"\bmm\b", "millimet", r"\bunits?\b", "1000")


def quaternions(session: Session, columns: tuple[int, ...], sign: tuple[float, ...] = (1, 1, 1, 1)) -> Session:
    """The same readings with the quaternion's columns permuted and signed."""
    values = session.raw().copy()
    values[:, 3:] = values[:, 3:][:, columns] * sign
    return replace(session, values=values)


@kind()
def quaternion_w_first(w: Works, rng: np.random.Generator) -> Case:
    """Quaternions are written w x y z."""
    return calibrated(quaternions(w.clean(120), (3, 0, 1, 2)), QUATERNION)


@kind()
def quaternion_conjugate(w: Works, rng: np.random.Generator) -> Case:
    """Orientations are those of the tracker in the tool, positions those of the tool in the tracker."""
    return calibrated(quaternions(w.clean(120), (0, 1, 2, 3), (-1, -1, -1, 1)), (*QUATERNION, "conjugate", "inver"))


@kind()
def quaternion_reversed(w: Works, rng: np.random.Generator) -> Case:
    """Quaternions are written w z y x."""
    return calibrated(quaternions(w.clean(120), (3, 2, 1, 0)), QUATERNION)


def _euler(w: Works, written: str, read: str, degrees: float = 1.0) -> Session:
    session = w.clean(120)
    return replace(session, R=Rotation.from_euler(read, degrees * session.R.as_euler(written)))


@kind()
def euler_intrinsic_for_extrinsic(w: Works, rng: np.random.Generator) -> Case:
    """Angles of an intrinsic XYZ sequence were read as extrinsic xyz."""
    return calibrated(_euler(w, "XYZ", "xyz"), ORIENTATION)


@kind()
def euler_other_sequence(w: Works, rng: np.random.Generator) -> Case:
    """Angles of ZYX were read as ZYZ's neighbours are: another sequence, drawn."""
    written, read = rng.permutation(["ZYX", "XYZ", "YXZ", "ZXY", "XZY"])[:2]
    return calibrated(_euler(w, str(written), str(read)), ORIENTATION)


@kind()
def rotation_vector_as_euler(w: Works, rng: np.random.Generator) -> Case:
    """A controller's rotation vector was read as angles about x, y, z."""
    session = w.clean(120)
    return calibrated(replace(session, R=Rotation.from_euler("xyz", session.R.as_rotvec())), ORIENTATION)


@kind()
def pose_inverted(w: Works, rng: np.random.Generator) -> Case:
    """The instrument sits on the tool and looks at a fixed target, which is applied and said."""
    session = w.clean(120)
    inverse = session.R.inv()
    return calibrated(replace(session, p=-inverse.apply(session.p), R=inverse), ("invert", "inverse"))


@kind()
def millimetres_in_a_part(w: Works, rng: np.random.Generator) -> Case:
    """From some station on positions are written in millimetres."""
    session = w.clean(120)
    k = int(rng.integers(30, 90))
    factor = np.where(np.arange(len(session)) >= k, 1e3, 1.0)[:, None]
    return calibrated(replace(session, p=session.p * factor), UNIT)


@kind()
def millimetres_throughout(w: Works, rng: np.random.Generator) -> Case:
    """All positions are written in millimetres."""
    session = w.clean(100)
    return calibrated(replace(session, p=1e3 * session.p), UNIT)


@kind()
def degrees_of_one_joint(w: Works, rng: np.random.Generator) -> Case:
    """One joint is written in degrees."""
    session, i = w.clean(120), w.any_joint(0, 4)
    q = session.q.copy()
    q[:, i] = np.degrees(q[:, i])
    return calibrated(replace(session, q=q), (w.names[i], "degree"))


@kind()
def degrees_throughout(w: Works, rng: np.random.Generator) -> Case:
    """All joints are written in degrees."""
    session = w.clean(100)
    return calibrated(replace(session, q=np.degrees(session.q)), ("degree", r"\bdeg\b", "limit"))


@kind()
def degrees_in_a_part(w: Works, rng: np.random.Generator) -> Case:
    """From some station on the joints are written in degrees."""
    session = w.clean(120)
    k = int(rng.integers(40, 90))
    factor = np.where(np.arange(len(session)) >= k, 180.0 / np.pi, 1.0)[:, None]
    return calibrated(replace(session, q=session.q * factor), ("degree", r"\bdeg\b", "limit", "joint"))


@kind()
def joint_of_other_sign(w: Works, rng: np.random.Generator) -> Case:
    """A joint counts the other way round."""
    session, i = w.clean(120), w.any_joint()
    q = session.q.copy()
    q[:, i] *= -1.0
    return calibrated(replace(session, q=q), (w.names[i],))


@kind()
def joints_swapped(w: Works, rng: np.random.Generator) -> Case:
    """Two joints stand under each other's name."""
    session, i = w.clean(120), w.any_joint(0, w.arm.n - 1)
    q = session.q.copy()
    q[:, [i, i + 1]] = q[:, [i + 1, i]]
    return calibrated(replace(session, q=q), (w.names[i], w.names[i + 1]))


@kind()
def readings_mirrored(w: Works, rng: np.random.Generator) -> Case:
    """The instrument's frame is left-handed: y is written with the other sign."""
    session = w.clean(120, kind="point")
    return calibrated(replace(session, p=session.p * [1.0, -1.0, 1.0]), ("mirror", "handed", "sign"))


@kind()
def coordinates_swapped(w: Works, rng: np.random.Generator) -> Case:
    """x and y stand in each other's column."""
    session = w.clean(120, kind="point")
    return calibrated(replace(session, p=session.p[:, [1, 0, 2]]), ("mirror", "handed", "axes|axis|swap|column"))
