"""Orientations of a table as rotation matrices: from quaternions, Euler angles, rotation vectors, or as they are."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadTable
from modcal_core.geometry import Array, so3
from modcal_msgs_py.tables.table import Table

FORMS = ("euler", "quaternion", "rotvec", "matrix")
_ANGLES = {"rad": 1.0, "deg": np.pi / 180.0}
_MAX_RAD = 2.0 * np.pi * 1.05  # of an angle of an orientation
_MIN_LENGTH = 1e-6  # of a quaternion
_NOT_A_ROTATION = 0.02  # by which an element of RᵀR may be off; exports have three digits and more


def orientation(table: Table, reading: Mapping[str, Any], there: np.ndarray, where: str) -> tuple[Array, np.ndarray]:
    """Rotations (N, 3, 3) of a table as a reading states them, and in which rows there is one (N,).

    there: rows in which the reading has a position. Rows without a rotation are noted; of them it is the identity.
    """
    form = next(name for name in FORMS if name in reading)
    stated = reading[form]
    values = table.numbers(stated["columns"])
    there = there & table.present(stated["columns"])
    rows = np.flatnonzero(there)
    if form == "quaternion":
        length = np.linalg.norm(values[rows], axis=1)
        said = "a quaternion of zeros is not an orientation"
        rows = _without(table, rows, length > _MIN_LENGTH, stated["columns"][0], said)
        return _of(len(table), rows, Rotation.from_quat(_signed(values[rows], stated)).as_matrix())
    if form == "matrix":
        R = values[rows].reshape(-1, 3, 3)
        size = np.abs(R).max(axis=(1, 2), initial=0.0)
        rows, R = (
            _without(table, rows, size > 0.0, stated["columns"][0], "a matrix of zeros is not an orientation"),
            R[size > 0.0],
        )
        off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2), initial=0.0)
        proper = (off < _NOT_A_ROTATION) & (np.linalg.det(R) > 0.0)
        for i in rows[~proper]:
            said = "the nine numbers are not a rotation"
            table.bad(int(i), stated["columns"][0], said, said)
        return _of(len(table), rows[proper], so3.nearest_rotation(R[proper]) if proper.any() else R[proper])
    scale = _ANGLES[stated["unit"]]
    angles = scale * values[rows]
    if stated["unit"] == "rad" and (largest := float(np.abs(angles).max(initial=0.0))) > _MAX_RAD:
        raise BadTable(where, f"angles reach {largest:.0f} rad: they look like degrees", "state unit: deg")
    if form == "rotvec":
        return _of(len(table), rows, Rotation.from_rotvec(angles).as_matrix())
    sequence = str(stated["sequence"])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _of(len(table), rows, Rotation.from_euler(sequence, angles).as_matrix())
    except ValueError as error:
        raise BadTable(where, f"sequence '{sequence}': {error}", "three axes: XYZ turning along, xyz fixed") from error


def _signed(values: Array, stated: Mapping[str, Any]) -> Array:
    return values * np.array([-1.0, -1.0, -1.0, 1.0]) if stated.get("conjugate") else values


def _without(table: Table, rows: np.ndarray, good: np.ndarray, column: object, said: str) -> np.ndarray:
    """The good ones of these rows; the others are lost readings where those are skipped, else faulty."""
    for i in rows[~good]:
        if table.faults.skip:
            table.lack([int(i)], "the orientation (all zeros)")
        else:
            table.bad(int(i), column, said, said)
    return rows[good]


def _of(count: int, rows: np.ndarray, R: Array) -> tuple[Array, np.ndarray]:
    out, there = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, bool)
    out[rows], there[rows] = R, True
    return out, there
