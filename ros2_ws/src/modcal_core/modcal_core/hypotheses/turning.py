"""What three, four or nine columns may say of an orientation: every usual way, and the rotations that it gives."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from modcal_core.geometry import Array, so3

QUATERNION, EULER, ROTVEC, MATRIX = "quaternion", "euler", "rotvec", "matrix"
# About moving axes; the same about fixed axes are these with axes and columns in the reverse order
SEQUENCES = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "ZYZ", "ZXZ", "XYX", "XZX", "YXY", "YZY")
_MAX_RAD = 2.0 * np.pi * 1.05  # an angle beyond it is in degrees
_UNIT = 0.02  # by which the length of a quaternion, or an element of RᵀR, may be off: exports have three digits
_SHARE = 0.9  # of the rows, at least, in which it is so


@dataclass(frozen=True)
class Turning:
    """One way to read columns. order: of the columns, as the form has them (x y z w; row by row; as the axes stand in
    the sequence). sequence: of Euler angles, upper case about moving axes. degrees: of angles. conjugate: the inverse
    of what the columns say is meant.
    """

    form: str
    order: tuple[int, ...]
    sequence: str = ""
    degrees: bool = False
    conjugate: bool = False

    def rotations(self, columns: Array) -> Array:
        """Rotations (N, 3, 3) of columns (N, k)."""
        values = columns[:, list(self.order)]
        if self.form == QUATERNION:
            R = so3.from_quaternion(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12))
        elif self.form == MATRIX:
            R = so3.nearest_rotation(values.reshape(-1, 3, 3))
        else:
            from scipy.spatial.transform import Rotation  # takes time to load

            angles = np.radians(values) if self.degrees else values
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                of = Rotation.from_rotvec(angles) if self.form == ROTVEC else Rotation.from_euler(self.sequence, angles)
            R = np.asarray(of.as_matrix())
        return np.swapaxes(R, 1, 2) if self.conjugate else R


def turnings(columns: Array) -> Iterator[Turning]:
    """Every way in which columns (N, 3, 4 or 9) can be read as orientations; none where they are no such thing."""
    count = columns.shape[1]
    if count == 4 and _usually(np.abs(np.linalg.norm(columns, axis=1) - 1.0) < _UNIT):
        for order in ((0, 1, 2, 3), (1, 2, 3, 0)):
            for conjugate in (False, True):
                yield Turning(QUATERNION, order, conjugate=conjugate)
    elif count == 9:
        R = columns.reshape(-1, 3, 3)
        off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
        if _usually((off < _UNIT) & (np.linalg.det(R) > 0.0)):
            yield Turning(MATRIX, tuple(range(9)))
            yield Turning(MATRIX, (0, 3, 6, 1, 4, 7, 2, 5, 8))
    elif count == 3:
        yield from _angles(float(np.abs(columns).max()))


def _angles(largest: float) -> Iterator[Turning]:
    if largest > 720.0 * 1.05:
        return
    for degrees in (True,) if largest > _MAX_RAD else (False, True):
        for order in permutations(range(3)):
            for sequence in SEQUENCES:
                yield Turning(EULER, order, sequence, degrees)
            yield Turning(ROTVEC, order, degrees=degrees)


def _usually(holds: np.ndarray) -> bool:
    return bool(len(holds)) and bool(holds.mean() >= _SHARE)
