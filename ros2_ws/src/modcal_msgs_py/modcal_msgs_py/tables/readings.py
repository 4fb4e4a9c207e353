"""Joints and readings of a table: what a mapping may state of them, and the tracks that they become.

Every kind of reading is a row of :data:`READINGS`, every form of an orientation one of :data:`FORMS`: what a mapping
states, and the function that reads it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import permutations, product
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import BEARING, POINT, POSE, RANGE, RAY, TOUCH, JointTrack, ReadingTrack, Schema
from modcal_msgs_py.tables.table import Table

UNITS = {"rad": 1.0, "deg": np.pi / 180.0, "gon": np.pi / 200.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
SPEEDS = {f"{unit}/s": scale for unit, scale in UNITS.items()}
EFFORTS = {"N m": 1.0, "N": 1.0, "N mm": 1e-3, "kN m": 1e3}
COMMANDS = "/joint_commands"
_ROUNDS = 3  # of the mean shape
MAX_RAD = 2.0 * np.pi * 1.05  # an angle beyond it is in degrees
_MIN_LENGTH = 1e-6  # of a quaternion
_NOT_A_ROTATION = 0.02  # by which an element of RᵀR may be off; exports have three digits and more
_ON_A_LINE = 1e-3  # m; targets that lie on a line by less make no pose


def said(schema: Schema, description: str) -> Schema:
    """A schema with a description."""
    return {**schema, "description": description}


def mapping(properties: Schema, *required: str) -> Schema:
    """The schema of a mapping with these keys and no others."""
    return {"type": "object", "properties": properties, "required": list(required), "additionalProperties": False}


def columns(count: int) -> Schema:
    """The schema of so many columns."""
    return {"type": "array", "items": COLUMN, "minItems": count, "maxItems": count}


def one_of(*names: str) -> Schema:
    """The schema of one of these texts."""
    return {"type": "string", "enum": list(names)}


COLUMN: Schema = {"type": ["string", "integer"], "description": "a column, by its label or by its number from 0"}
BY_JOINT: Schema = {
    "type": "object", "additionalProperties": COLUMN, "minProperties": 1, "description": "joint: column",
}  # fmt: skip
_NUMBERS: Schema = {"type": "object", "additionalProperties": {"type": "number", "minimum": -1e6, "maximum": 1e6}}
_FRAME = said({"type": "string", "minLength": 1}, "name of the instrument's frame; {stem} and {folder} may stand in it")
_LENGTH, _ANGLE = one_of("m", "cm", "mm", "in"), one_of("rad", "deg")
_JOINT, _SPEED = one_of("rad", "deg", "m", "cm", "mm", "in"), one_of("rad/s", "deg/s", "m/s", "mm/s")
_UP_TO_THREE: Schema = {"type": ["string", "integer", "array"], "items": COLUMN, "minItems": 3, "maxItems": 3}
_COVERAGE = said({"type": "number", "minimum": 1, "maximum": 10}, "standard deviations in what is stated, such as 2")
_STD = mapping(
    {"position": _UP_TO_THREE, "unit": _LENGTH, "orientation": _UP_TO_THREE, "orientation_unit": _ANGLE,
     "coverage": _COVERAGE}
)  # fmt: skip
_UNITS_OF = {"type": "object", "additionalProperties": _JOINT, "description": "of single joints"}
JOINTS = mapping(
    {
        "unit": _JOINT,
        "units": _UNITS_OF,
        "columns": BY_JOINT,
        "sign": said(_NUMBERS, "joint: factor, such as -1 of one that the table counts the other way"),
        "offset": said(_NUMBERS, "joint: what is added to it, in its unit"),
        "coupled": {
            "type": "object",
            "additionalProperties": _NUMBERS,
            "description": "joint: {other: factor}; so many times the other's number in the table is added to it",
        },
        "velocity": mapping({"unit": _SPEED, "columns": BY_JOINT}, "unit", "columns"),
        "effort": mapping(
            {"columns": BY_JOINT, "unit": said(one_of(*EFFORTS), "Default: N m, and N"),
             "of_load": {"type": "boolean",
                         "description": "true: the load's torque on the actuator, the opposite sign"}},
            "columns",
        ),
        "commanded": mapping({"unit": _JOINT, "units": _UNITS_OF, "columns": BY_JOINT}, "columns"),
    },
    "unit", "columns",
)  # fmt: skip


def joints_of(table: Table, joints: Mapping[str, Any], stamps: Array) -> tuple[JointTrack, JointTrack | None]:
    """Joint states of a table, and the commanded positions if it has any; rows that lack one are left out."""
    names = tuple(joints["columns"])
    M = joint_map(joints, names)[0]
    position = positions(table, joints, names)
    velocity = _beside(table, joints, "velocity", SPEEDS, names) @ M.T
    effort = _beside(table, joints, "effort", EFFORTS, names) @ np.linalg.inv(M)  # of virtual work
    if joints.get("effort", {}).get("of_load"):
        effort = -effort
    keep = np.isfinite(stamps) & table.present(list(joints["columns"].values()))
    track = JointTrack(names, stamps, position, velocity, effort, stamps).rows(keep)
    if "commanded" not in joints:
        return track, None
    known = tuple(joints["commanded"]["columns"])
    position = positions(table, joints, known, joints["commanded"])
    unknown = np.full_like(position, np.nan)
    sent = np.isfinite(stamps) & np.isfinite(position).all(axis=1)
    return track, JointTrack(known, stamps, position, unknown, unknown, stamps, COMMANDS).rows(sent)


def positions(
    table: Table, joints: Mapping[str, Any], names: Sequence[str], part: Mapping[str, Any] | None = None
) -> Array:
    """Positions (N, n) [rad, m] of these joints. part: commanded, in the columns and units of their own, else in those
    of the joints; counted as the joints are.
    """
    M, offset = joint_map(joints, names)
    return _scaled(table, joints if part is None else {"unit": joints["unit"], **part}, UNITS, names) @ M.T + offset


def joint_map(joints: Mapping[str, Any], names: Sequence[str]) -> tuple[Array, Array]:
    """(M (n, n), c (n,)) with positions of these joints ``M r + c`` [rad, m] of what a table holds, r in the same."""
    M = np.diag([float(joints.get("sign", {}).get(name, 1.0)) for name in names])
    for name, others in joints.get("coupled", {}).items():
        for other, factor in others.items():
            if name in names and other in names:
                M[names.index(name), names.index(other)] += factor
    return M, np.array([_scale(joints, UNITS, n) * joints.get("offset", {}).get(n, 0.0) for n in names])


def map_stated(M: Array, offset: Array, names: Sequence[str], unit: str) -> dict[str, Any]:
    """What a mapping states of joints that are counted so, the inverse of :func:`joint_map`. unit: of the joints."""
    rows = {name: dict(zip(names, row, strict=True)) for name, row in zip(names, M.tolist(), strict=True)}
    coupled = {name: {n: x for n, x in row.items() if n != name and x} for name, row in rows.items()}
    at = dict(zip(names, offset.tolist(), strict=True))
    every = {
        "sign": {name: row[name] for name, row in rows.items() if row[name] != 1.0},
        "offset": {n: round(x / UNITS[unit], 6) if unit == "deg" else x for n, x in at.items() if x},
        "coupled": {name: others for name, others in coupled.items() if others},
    }
    return {key: value for key, value in every.items() if value}


def merged_joints(tracks: list[JointTrack]) -> JointTrack | None:
    """One track of several with the same joints; None for none. Raises BadTable where they are not the same."""
    if not tracks:
        return None
    if any(track.names != tracks[0].names for track in tracks):
        raise BadTable("tables", "have different joints", "import them into bags of their own")
    return tracks[0].followed_by(*tracks[1:])


def _scale(part: Mapping[str, Any], units: Mapping[str, float], name: str) -> float:
    return units[(part.get("units") or {}).get(name, part["unit"])]


def _scaled(table: Table, part: Mapping[str, Any], units: Mapping[str, float], names: Sequence[str]) -> Array:
    scale = np.array([_scale(part, units, name) for name in names])
    return scale * table.numbers([part["columns"][name] for name in names])


def _beside(
    table: Table, joints: Mapping[str, Any], what: str, units: Mapping[str, float], names: tuple[str, ...]
) -> Array:
    """A quantity of the joints (N, n), NaN where it is not stated."""
    out = np.full((len(table), len(names)), np.nan)
    if what in joints:
        part = {"unit": "N m", **joints[what]}
        known = tuple(name for name in names if name in part["columns"])
        out[:, [names.index(name) for name in known]] = _scaled(table, part, units, known)
    return out


# --- Orientations: the forms that a pose may be stated in, and the rotations that they are


@dataclass(frozen=True)
class OrientationForm:
    """One form of an orientation. properties: of a mapping, all required but those in optional. rotations: of the
    columns (m, k) that hold one, with which of them (m,) do.
    """

    count: int
    properties: Schema
    optional: tuple[str, ...]
    rotations: Callable[[Array, Mapping[str, Any], str], tuple[Array, np.ndarray]]

    @property
    def schema(self) -> Schema:
        """What a mapping states."""
        keys = {"columns": columns(self.count), **self.properties}
        return mapping(keys, *(key for key in keys if key not in self.optional))


def _by_quaternion(values: Array, stated: Mapping[str, Any], where: str) -> tuple[Array, np.ndarray]:
    sign = np.array([-1.0, -1.0, -1.0, 1.0]) if stated.get("conjugate") else 1.0
    return np.asarray(Rotation.from_quat(values * sign).as_matrix()), np.ones(len(values), bool)


def _by_matrix(values: Array, stated: Mapping[str, Any], where: str) -> tuple[Array, np.ndarray]:
    R = values.reshape(-1, 3, 3)
    off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2), initial=0.0)
    proper = (off < _NOT_A_ROTATION) & (np.linalg.det(R) > 0.0)
    return so3.nearest_rotation(np.where(proper[:, None, None], R, np.eye(3))), proper


def _by_angles(values: Array, stated: Mapping[str, Any], where: str) -> tuple[Array, np.ndarray]:
    angles = UNITS[stated["unit"]] * values
    if stated["unit"] == "rad" and (largest := float(np.abs(angles).max(initial=0.0))) > MAX_RAD:
        raise BadTable(where, f"angles reach {largest:.0f} rad: they look like degrees", "state unit: deg")
    every, sequence = np.ones(len(values), bool), str(stated.get("sequence", ""))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            of = Rotation.from_euler(sequence, angles) if sequence else Rotation.from_rotvec(angles)
            return np.asarray(of.as_matrix()), every
    except ValueError as error:
        raise BadTable(where, f"sequence '{sequence}': {error}", "three axes: XYZ turning along, xyz fixed") from error


_SEQUENCE = said(
    {"type": "string", "minLength": 3, "maxLength": 3}, "upper case turning along, lower case about fixed axes"
)
FORMS = {
    "euler": OrientationForm(3, {"unit": _ANGLE, "sequence": _SEQUENCE}, (), _by_angles),
    "quaternion": OrientationForm(
        4, {"columns": said(columns(4), "those of x, y, z and w, in this order"), "conjugate": {"type": "boolean"}},
        ("conjugate",), _by_quaternion,
    ),
    "rotvec": OrientationForm(3, {"unit": _ANGLE}, (), _by_angles),
    "matrix": OrientationForm(9, {"columns": said(columns(9), "row by row")}, (), _by_matrix),
}  # fmt: skip


# What columns are tried as where nothing is stated. Sequences are about moving axes; about fixed ones they are these
# with axes and columns in the reverse order.
_SEQUENCES = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "ZYZ", "ZXZ", "XYX", "XZX", "YXY", "YZY")
# By the number of columns: their orders in a form, and forms with what else is stated
_TRIED: Mapping[int, tuple[Sequence[tuple[int, ...]], Sequence[tuple[str, dict[str, Any]]]]] = {
    3: (list(permutations(range(3))), [*(("euler", {"sequence": s}) for s in _SEQUENCES), ("rotvec", {})]),
    4: (((0, 1, 2, 3), (1, 2, 3, 0)), [("quaternion", {}), ("quaternion", {"conjugate": True})]),
    9: ((tuple(range(9)), (0, 3, 6, 1, 4, 7, 2, 5, 8)), [("matrix", {})]),
}
_OFF_UNIT = 0.02  # by which the length of a quaternion may be off: exports have three digits
_USUAL = 0.9  # share of the rows, at least, in which numbers must be those of a form
_MAX_ANGLE = 720.0 * 1.05  # degrees


@dataclass(frozen=True)
class Orientation:
    """One way to read columns as orientations: the form, the columns in its order, and what is stated besides."""

    form: str
    order: tuple[int, ...]
    besides: Mapping[str, Any]

    def rotations(self, values: Array) -> Array:
        """Rotations (N, 3, 3) of columns (N, k)."""
        return FORMS[self.form].rotations(values[:, list(self.order)], self.besides, self.form)[0]

    def stated(self, keys: Sequence[Any]) -> dict[str, Any]:
        """The same as a mapping states it of columns with these keys."""
        return {self.form: {"columns": [keys[i] for i in self.order], **self.besides}}


def orientations(values: Array) -> list[Orientation]:
    """Every way in which columns (N, 3, 4 or 9) can be read as orientations; none where they are no such thing."""
    count = values.shape[1]
    largest = float(np.abs(values).max(initial=0.0)) if count == 3 else 0.0
    if not len(values) or largest > _MAX_ANGLE:
        return []
    if count == 4 and np.mean(np.abs(np.linalg.norm(values, axis=1) - 1.0) < _OFF_UNIT) < _USUAL:
        return []
    if count == 9 and np.mean(_by_matrix(values, {}, "")[1]) < _USUAL:
        return []
    units = ({"unit": unit} for unit in (("deg",) if largest > MAX_RAD else ("rad", "deg")))
    told: list[dict[str, Any]] = list(units) if count == 3 else [{}]
    orders, forms = _TRIED[count]
    return [
        Orientation(form, order, {**besides, **unit}) for unit, order, (form, besides) in product(told, orders, forms)
    ]


def _orientation(table: Table, one: Mapping[str, Any], there: np.ndarray, where: str) -> tuple[Array, np.ndarray]:
    """Rotations (N, 3, 3) as a reading states them, and in which of the rows there is one; the others are noted."""
    form = next(name for name in FORMS if name in one)
    stated = one[form]
    values, first = table.numbers(stated["columns"]), stated["columns"][0]
    rows = np.flatnonzero(there & table.present(stated["columns"]))
    if form in ("quaternion", "matrix"):
        empty = np.linalg.norm(values[rows], axis=1) <= _MIN_LENGTH
        for i in rows[empty].tolist():  # a lost reading where those are skipped
            if table.skip:
                table.lack([i], "the orientation (all zeros)")
            else:
                table.bad(i, first, f"a {form} of zeros is not an orientation")
        rows = rows[~empty]
    R, proper = FORMS[form].rotations(values[rows], stated, where) if len(rows) else (np.empty((0, 3, 3)), rows == 0)
    for i in rows[~proper].tolist():
        table.bad(i, first, "the nine numbers are not a rotation")
    out, found = np.tile(np.eye(3), (len(table), 1, 1)), np.zeros(len(table), bool)
    out[rows[proper]], found[rows[proper]] = R[proper], True
    return out, found


# --- Readings: their keys in a mapping, the topics that they go to, and how they are read

_Read = tuple[Array, np.ndarray]  # values (N, k), and in which rows there are any (N,)


def _position(table: Table, one: Mapping[str, Any], where: str) -> _Read:
    p, there = table.numbers(one["position"]), table.present(one["position"])
    for key, sign in (("plus", 1.0), ("minus", -1.0)):
        if key in one:
            p, there = p + sign * table.numbers(one[key]), there & table.present(one[key])
    return np.where(there[:, None], UNITS[one["unit"]] * p, 0.0), there


def _pose(table: Table, one: Mapping[str, Any], where: str) -> _Read:
    p, there = _position(table, one, where)
    R, there = _orientation(table, one, there, where)
    T = se3.transform(R, p)
    return se3.to_pose(se3.inverse(T) if one.get("inverse") else T), there


def _nothing(width: int, table: Table, one: Mapping[str, Any], where: str) -> _Read:
    return np.zeros((len(table), width)), np.ones(len(table), bool)


def _length(table: Table, one: Mapping[str, Any], where: str) -> _Read:
    if "column" not in one:  # of a plane: contact
        return _nothing(1, table, one, where)
    return UNITS[one["unit"]] * table.numbers([one["column"]]), table.present(one["column"])


def direction(angles: Array, zenith: bool, clockwise: bool) -> Array:
    """Unit vectors (N, 3) of azimuths and second angles (N, 2) [rad].

    zenith: the second is from above. clockwise: azimuths grow so.
    """
    up = np.pi / 2.0 - angles[:, 1] if zenith else angles[:, 1]
    azimuth = -angles[:, 0] if clockwise else angles[:, 0]
    return np.stack([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)], axis=1)


def _bearing(table: Table, one: Mapping[str, Any], where: str) -> _Read:
    keys = one.get("vector") or [one[key] for key in ("azimuth", "elevation", "zenith") if key in one]
    u, there = table.numbers(keys), table.present(keys)
    if "vector" not in one:
        u = direction(UNITS[one["unit"]] * u, "zenith" in one, bool(one.get("clockwise")))
    length = np.linalg.norm(u, axis=1)
    for i in np.flatnonzero(there & ~(length > 0.0)).tolist():
        table.bad(i, keys[0], "a vector of zeros is not a direction", "zeros")
    there &= length > 0.0
    return u / np.where(there, length, 1.0)[:, None], there


def _targets(table: Table, one: Mapping[str, Any], where: str) -> _Read:
    """The pose of three targets or more on one tool: their mean shape, moved onto what was read (Arun 1987)."""
    names = tuple(one["points"])
    seen = UNITS[one["unit"]] * np.stack([table.numbers(one["points"][name]) for name in names], axis=1)
    there = table.present([column for name in names for column in one["points"][name]])
    values = np.tile([0.0] * 6 + [1.0], (len(table), 1))
    if there.any():
        poses, shape = rigid_poses(seen[there])
        if np.linalg.svd(shape, compute_uv=False)[1] < _ON_A_LINE:
            raise BadTable(where, f"targets {', '.join(names)} lie on a line", "give others, or one as point")
        values[there] = se3.to_pose(poses)
    return values, there


def rigid_poses(points: Array) -> tuple[Array, Array]:
    """(poses (m, 4, 4), mean shape (k, 3)) of targets (m, k, 3) on one body, whose frame sits in their centre.

    Their mean shape moved onto every row by a rotation and a shift (Arun, Huang and Blostein 1987).
    """
    centre = points.mean(axis=1)
    spread = points - centre[:, None]
    shape = spread[0]
    for _ in range(_ROUNDS):
        R = so3.nearest_rotation(np.swapaxes(spread, 1, 2) @ shape)
        shape = np.mean(spread @ R, axis=0)  # rows are points: R turns the shape onto the row, its transpose back
    return se3.transform(so3.nearest_rotation(np.swapaxes(spread, 1, 2) @ shape), centre), shape


@dataclass(frozen=True)
class ReadingKind:
    """One kind of reading in a mapping. kind: of the track. properties: that are stated beside the frame. ways: keys of
    which one set is stated.
    """

    kind: str
    topic: str
    read: Callable[[Table, Mapping[str, Any], str], _Read]
    properties: Schema
    required: tuple[str, ...] = ()
    several: bool = True

    ways: tuple[tuple[str, ...], ...] = ()

    @property
    def schema(self) -> Schema:
        """What a mapping states: one, or a list of them."""
        ways = [{"type": "object", "required": list(way)} for way in self.ways]
        choice = {"oneOf": ways} if ways else {}
        one = {**mapping({"frame": _FRAME, **self.properties}, "frame", *self.required), **choice}
        several = {"oneOf": [*ways, {"type": "array"}]} if ways else {}
        return {**one, "type": ["object", "array"], "items": one, "minItems": 1, **several} if self.several else one


_LENGTHS: Schema = {"unit": _LENGTH, "column": COLUMN}
_PLACE: Schema = {
    "unit": _LENGTH,
    "position": columns(3),
    "plus": said(columns(3), "a deviation in the same unit, added to the position: of a goal, what was reached"),
    "minus": said(columns(3), "the same, taken from the position"),
    "target": said(COLUMN, "which of several targets on the tool was measured: its name or number"),
    "std": _STD,
}
READINGS = {
    "pose": ReadingKind(
        POSE, "/tracker/pose", _pose,
        {**_PLACE, "inverse": said({"type": "boolean"}, "true: the table holds the tracker's pose in the tool"),
         **{name: form.schema for name, form in FORMS.items()}},
        ("unit", "position"), ways=tuple((name,) for name in FORMS),
    ),
    "targets": ReadingKind(
        POSE, "/tracker/pose", _targets,
        {"unit": _LENGTH, "points": {"type": "object", "additionalProperties": columns(3), "minProperties": 3}},
        ("unit", "points"),
    ),
    "point": ReadingKind(POINT, "/tracker/point", _position, _PLACE, ("unit", "position")),
    "same_point": ReadingKind(POINT, "/tracker/point", partial(_nothing, 3), {}, several=False),
    "range": ReadingKind(RANGE, "/tracker/range", _length, _LENGTHS, ("unit", "column")),
    "bearing": ReadingKind(
        BEARING, "/tracker/bearing", _bearing,
        {"vector": columns(3), "unit": one_of("rad", "deg", "gon"), "azimuth": COLUMN, "elevation": COLUMN,
         "zenith": COLUMN,
         "clockwise": said({"type": "boolean"}, "true: the azimuth grows clockwise, seen from above")},
        ways=(("vector",), ("azimuth", "elevation", "unit"), ("azimuth", "zenith", "unit")),
    ),
    "plane": ReadingKind(TOUCH, "/tracker/plane", _length, _LENGTHS),
    "ray": ReadingKind(RAY, "/gripper/range", _length, _LENGTHS, ("unit", "column")),
}  # fmt: skip


def each(stated: Any) -> list[Mapping[str, Any]]:
    """What is stated once, or in a list."""
    return [] if stated is None else [stated] if isinstance(stated, Mapping) else list(stated)


def readings_of(table: Table, entry: Mapping[str, Any], stamps: Array, source: str) -> Iterator[ReadingTrack]:
    """The readings that an entry states; rows without one are left out and noted."""
    for key, row in READINGS.items():
        for one in each(entry.get(key)):
            where = f"{source}: {key}"
            frame = str(one["frame"]).replace("{stem}", table.path.stem).replace("{folder}", table.path.parent.name)
            if "{" in frame:
                raise BadTable(where, f"frame '{frame}': only {{stem}} and {{folder}} are known", "correct it")
            values, there = row.read(table, one, where)
            track = ReadingTrack(row.kind, frame, stamps, values, stamps, row.topic, _deviations(table, one))
            yield track.rows(there & np.isfinite(stamps))


def _deviations(table: Table, one: Mapping[str, Any]) -> Array | None:
    """RMS over space of position [m] and angle [rad] that a table states for each reading, (N, 2)."""
    stated = one.get("std")
    if stated is None:
        return None
    out = np.full((len(table), 2), np.nan)
    for k, (what, unit) in enumerate((("position", "unit"), ("orientation", "orientation_unit"))):
        if what in stated:
            scale = UNITS[stated.get(unit, "rad" if k else one.get("unit", "m"))]
            each_axis = stated[what] if isinstance(stated[what], list) else [stated[what]] * 3
            out[:, k] = scale / stated.get("coverage", 1.0) * np.linalg.norm(table.numbers(each_axis), axis=1)
    return out


def merged(tracks: list[ReadingTrack]) -> tuple[ReadingTrack, ...]:
    """One track for every instrument."""
    out: dict[tuple[str, str], list[ReadingTrack]] = {}
    for track in tracks:
        out.setdefault((track.kind, track.frame), []).append(track)
    return tuple(first.followed_by(*others) for first, *others in out.values())
