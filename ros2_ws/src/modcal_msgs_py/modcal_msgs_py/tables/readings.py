"""Joints and readings of a table: positions, velocities, efforts and commands; poses, points, distances, directions."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import BEARING, POINT, POSE, RANGE, RAY, TOUCH, JointTrack, ReadingTrack
from modcal_msgs_py.tables.candidates import Body, Numbers
from modcal_msgs_py.tables.table import Table

_ROUNDS = 3  # of the mean shape


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


# Keys of a mapping, each with the topic that its readings go to
TOPICS = {
    "pose": "/tracker/pose",
    "targets": "/tracker/pose",
    "point": "/tracker/point",
    "same_point": "/tracker/point",
    "range": "/tracker/range",
    "bearing": "/tracker/bearing",
    "plane": "/tracker/plane",
    "ray": "/gripper/range",
}


def readings_of(table: Table, entry: Mapping[str, Any], stamps: Array, source: str) -> Iterator[ReadingTrack]:
    """The readings that an entry states; rows without one are left out and noted."""
    for key, topic in TOPICS.items():
        stated = entry.get(key, [])
        for one in [stated] if isinstance(stated, Mapping) else stated:
            where = f"{source}: {key}"
            frame = _frame(table, str(one["frame"]), where)
            kind, values, there = _READ[key](table, one, where)
            deviations = _deviations(table, one)
            track = ReadingTrack(kind, frame, stamps, values, stamps, topic, deviations)
            yield track.rows(there & np.isfinite(stamps))


def merged(tracks: list[ReadingTrack]) -> tuple[ReadingTrack, ...]:
    """One track for every instrument."""
    out: dict[tuple[str, str], ReadingTrack] = {}
    for track in tracks:
        key = (track.kind, track.frame)
        if key in out:
            old = out[key]
            stamps = np.r_[old.stamps, track.stamps]
            stated = None
            if old.stated is not None or track.stated is not None:
                none = [np.full((len(t.stamps), 2), np.nan) if t.stated is None else t.stated for t in (old, track)]
                stated = np.concatenate(none)
            values = np.r_[old.values, track.values]
            track = replace(track, stamps=stamps, values=values, received=stamps, stated=stated)
        out[key] = track
    return tuple(out.values())


def _frame(table: Table, stated: str, where: str) -> str:
    frame = stated.replace("{stem}", table.path.stem).replace("{folder}", table.path.parent.name)
    if "{" in frame:
        raise BadTable(where, f"frame '{frame}': only {{stem}} and {{folder}} are known", "correct it")
    return frame


_Read = tuple[str, Array, np.ndarray]


def _position(table: Table, one: Mapping[str, Any]) -> tuple[Array, np.ndarray]:
    p, there = table.numbers(one["position"]), table.present(one["position"])
    for key, sign in (("plus", 1.0), ("minus", -1.0)):
        if key in one:
            p, there = p + sign * table.numbers(one[key]), there & table.present(one[key])
    p = UNITS[one["unit"]] * p
    return np.where(there[:, None], p, 0.0), there


def _pose(table: Table, one: Mapping[str, Any], where: str) -> _Read:
    p, there = _position(table, one)
    R, there = orientation(table, one, there, where)
    T = se3.transform(R, p)
    return POSE, se3.to_pose(se3.inverse(T) if one.get("inverse") else T), there


def _point(table: Table, one: Mapping[str, Any], where: str) -> _Read:
    return POINT, *_position(table, one)


def _same_point(table: Table, one: Mapping[str, Any], where: str) -> _Read:
    return POINT, np.zeros((len(table), 3)), np.ones(len(table), bool)


def _length(kind: str) -> Callable[[Table, Mapping[str, Any], str], _Read]:
    def read(table: Table, one: Mapping[str, Any], where: str) -> _Read:
        if "column" not in one:  # of a plane: contact
            return kind, np.zeros((len(table), 1)), np.ones(len(table), bool)
        values = UNITS[one["unit"]] * table.numbers([one["column"]])
        return kind, values, table.present(one["column"])

    return read


def _bearing(table: Table, one: Mapping[str, Any], where: str) -> _Read:
    if "vector" in one:
        u = table.numbers(one["vector"])
    else:
        azimuth, second = (
            UNITS[one["unit"]] * table.numbers([one["azimuth"], one.get("elevation", one.get("zenith"))]).T
        )
        up = second if "elevation" in one else np.pi / 2.0 - second
        azimuth = -azimuth if one.get("clockwise") else azimuth
        u = np.stack([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)], axis=1)
    keys = ("azimuth", "elevation", "zenith")
    there = table.present(one.get("vector") or [one[key] for key in keys if key in one])
    length = np.linalg.norm(u, axis=1)
    for i in np.flatnonzero(there & ~(length > 0.0)):
        table.bad(int(i), one.get("vector", [None])[0], "a vector of zeros is not a direction", "zeros")
    there &= length > 0.0
    return BEARING, u / np.where(there, length, 1.0)[:, None], there


def _targets(table: Table, one: Mapping[str, Any], where: str) -> _Read:
    """The pose of three targets or more on one tool: their mean shape, moved onto what was read (Arun 1987)."""
    names = tuple(one["points"])
    seen = UNITS[one["unit"]] * np.stack([table.numbers(one["points"][name]) for name in names], axis=1)
    there = table.present([column for name in names for column in one["points"][name]])
    if not there.any():
        return POSE, np.tile([0.0] * 6 + [1.0], (len(table), 1)), there
    poses, shape = rigid_poses(seen[there])
    if np.linalg.svd(shape, compute_uv=False)[1] < 1e-3:
        raise BadTable(where, f"targets {', '.join(names)} lie on a line", "give three that do not, or one as point")
    values = np.tile([0.0] * 6 + [1.0], (len(table), 1))
    values[there] = se3.to_pose(poses)
    return POSE, values, there


def _deviations(table: Table, one: Mapping[str, Any]) -> Array | None:
    """RMS over space of position [m] and angle [rad] that a table states for each reading, (N, 2)."""
    stated = one.get("std")
    if stated is None:
        return None
    out = np.full((len(table), 2), np.nan)
    for k, (what, unit) in enumerate((("position", "unit"), ("orientation", "orientation_unit"))):
        if what in stated:
            scale = UNITS[stated.get(unit, "rad" if k else one.get("unit", "m"))]
            columns = stated[what] if isinstance(stated[what], list) else [stated[what]] * 3
            out[:, k] = scale / stated.get("coverage", 1.0) * np.linalg.norm(table.numbers(columns), axis=1)
    return out


_READ: dict[str, Callable[[Table, Mapping[str, Any], str], _Read]] = {
    "pose": _pose,
    "targets": _targets,
    "point": _point,
    "same_point": _same_point,
    "range": _length(RANGE),
    "bearing": _bearing,
    "plane": _length(TOUCH),
    "ray": _length(RAY),
}


_MOVES = 0.05  # of what the liveliest point moves; less is a target that stands
_RIGID = 2e-3  # of what the points move, by which their distance may scatter
_APART = 20.0  # times that scatter, that points and the line through them must be apart
_MIN = 3  # targets that make a pose
_MAD = 1.4826  # standard deviation of a Gaussian whose median absolute deviation is one


def rigid_bodies(numbers: Numbers, places: Sequence[Body]) -> list[Body]:
    """Bodies of three targets or more among labelled points, the largest first; none where no three are rigid."""
    triples = list(dict.fromkeys(body.position for body in places if body.named))
    if len(triples) < _MIN:
        return []
    points = {triple: numbers.values[:, list(triple)] for triple in triples}
    moves = {triple: _motion(p) for triple, p in points.items()}
    most = max(moves.values())
    alive = [triple for triple in triples if moves[triple] > _MOVES * most > 0.0]
    scatter = {pair: _scatter(points[pair[0]], points[pair[1]]) for pair in combinations(alive, 2)}
    near = _RIGID * most

    def rigid(a: tuple[int, int, int], b: tuple[int, int, int]) -> bool:
        distance, off = scatter[(a, b) if (a, b) in scatter else (b, a)]
        return off < near and distance > _APART * off

    found: list[Body] = []
    for i, first in enumerate(alive):
        group = [first]
        for other in alive[i + 1 :]:
            if all(rigid(known, other) for known in group):
                group.append(other)
        if len(group) < _MIN or any(set(group) <= {t for _, t in body.points} for body in found):
            continue
        rows = np.isfinite(np.concatenate([points[t] for t in group], axis=1)).all(axis=1)
        if rows.sum() < _MIN:
            continue
        shape = rigid_poses(np.stack([points[t][rows] for t in group], axis=1))[1]
        if np.linalg.svd(shape, compute_uv=False)[1] < _APART * max(
            scatter[pair][1] for pair in combinations(group, 2)
        ):
            continue  # on a line: turns about it do not show
        names = _names(numbers, group)
        found.append(replace(Body(first, None, True), points=tuple(zip(names, group, strict=True))))
    return sorted(found, key=lambda body: -len(body.points))


def _motion(p: Array) -> float:
    p = p[np.isfinite(p).all(axis=1)]
    return float(np.median(np.linalg.norm(p - np.median(p, axis=0), axis=1))) if len(p) else 0.0


def _scatter(a: Array, b: Array) -> tuple[float, float]:
    """(distance, its scatter) of two points, medians."""
    d = np.linalg.norm(a - b, axis=1)
    d = d[np.isfinite(d)]
    if len(d) < _MIN:
        return 0.0, np.inf
    middle = float(np.median(d))
    return middle, _MAD * float(np.median(np.abs(d - middle)))


def _names(numbers: Numbers, group: Sequence[tuple[int, int, int]]) -> list[str]:
    out: list[str] = []
    for i, triple in enumerate(group):
        axis = numbers.labels[triple[0]].axis
        stem = "_".join(axis[1].split()) if axis is not None else ""
        name = stem or f"target_{i + 1}"
        out.append(name if name not in out else f"{name}_{i + 1}")
    return out


UNITS = {"rad": 1.0, "deg": np.pi / 180.0, "gon": np.pi / 200.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
SPEEDS = {f"{unit}/s": scale for unit, scale in UNITS.items()}
EFFORTS = {"N m": 1.0, "N": 1.0, "N mm": 1e-3, "kN m": 1e3}
COMMANDS = "/joint_commands"


def joints_of(table: Table, joints: Mapping[str, Any], stamps: Array) -> tuple[JointTrack, JointTrack | None]:
    """Joint states of a table, and the commanded positions if it has any; rows that lack one are left out."""
    names = tuple(joints["columns"])
    position = _scaled(table, joints, UNITS, names)
    velocity = _beside(table, joints, "velocity", SPEEDS, names)
    effort = _beside(table, joints, "effort", EFFORTS, names)
    if joints.get("effort", {}).get("of_load"):
        effort = -effort
    keep = np.isfinite(stamps) & table.present(list(joints["columns"].values()))
    track = JointTrack(names, stamps, position, velocity, effort, stamps)
    if "commanded" not in joints:
        return _rows(track, keep), None
    wanted = joints["commanded"]
    known = tuple(wanted["columns"])
    position = _scaled(table, {"unit": joints["unit"], **wanted}, UNITS, known)
    unknown = np.full_like(position, np.nan)
    sent = np.isfinite(stamps) & np.isfinite(position).all(axis=1)
    return _rows(track, keep), _rows(JointTrack(known, stamps, position, unknown, unknown, stamps, COMMANDS), sent)


def merged_joints(tracks: list[JointTrack]) -> JointTrack | None:
    """One track of several with the same joints; None for none. Raises BadTable where they are not the same."""
    if not tracks:
        return None
    names = tracks[0].names
    if any(track.names != names for track in tracks):
        raise BadTable("tables", "have different joints", "import them into bags of their own")
    columns: dict[str, Any] = {
        what: np.concatenate([getattr(t, what) for t in tracks])
        for what in ("stamps", "position", "velocity", "effort", "received")
    }
    return replace(tracks[0], **columns)


def _scaled(table: Table, part: Mapping[str, Any], units: Mapping[str, float], names: tuple[str, ...]) -> Array:
    own = part.get("units") or {}
    scale = np.array([units[own.get(name, part["unit"])] for name in names])
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


def _rows(track: JointTrack, keep: np.ndarray) -> JointTrack:
    columns = {what: getattr(track, what)[keep] for what in ("stamps", "position", "velocity", "effort", "received")}
    return replace(track, **columns)


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
