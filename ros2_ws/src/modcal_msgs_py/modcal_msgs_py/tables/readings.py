"""What the instruments of a table read: poses, points, distances, directions, planes; several targets are one pose."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import BEARING, POINT, POSE, RANGE, RAY, TOUCH, ReadingTrack
from modcal_msgs_py.tables.candidates import Body, Numbers
from modcal_msgs_py.tables.joints import UNITS
from modcal_msgs_py.tables.orientation import orientation
from modcal_msgs_py.tables.table import Table

# --- The pose of several targets on one tool

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


# --- Several targets on one tool: points of a table that keep their distances while they move

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
