"""Tables of measurements to a recording: a small mapping says which column is what, and in which unit.

Nothing is guessed: a unit or an angle convention that the mapping does not state is an error. Every row becomes one
joint state and one reading with the same stamp, that is a finished station.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import (
    ORDER_ONLY,
    POINT,
    POSE,
    SOCKETS,
    JointTrack,
    ReadingTrack,
    Recording,
    SignalTrack,
)
from modcal_core.measurements.schema import shown
from modcal_msgs_py.tables_schema import require_mapping

_UNITS = {"rad": 1.0, "deg": np.pi / 180.0, "m": 1.0, "mm": 1e-3}
_MOST_RAD = 2.0 * np.pi * 1.05  # of an angle of an orientation
_LARGEST = 1e18  # of any number in a table
_LAST = 2.0**31  # s; stamps of messages end in 2038
_LEAST_LENGTH = 1e-6  # of a quaternion
_ORDER_STEP = 1e-3  # s between rows that a table stamps alike


@dataclass(frozen=True)
class _Table:
    """Cells of one file, with what is needed to speak of them."""

    path: Path
    header: tuple[str, ...]
    rows: list[list[str]]
    first_line: int
    decimal: str

    def column(self, key: Any) -> Array:
        """A column as numbers (N,); by name, or by number from 0."""
        index = self._index(key)
        out = np.empty(len(self.rows))
        for i, row in enumerate(self.rows):
            try:
                out[i] = float(row[index].strip().replace(self.decimal, "."))
            except (ValueError, IndexError):
                cell = row[index] if index < len(row) else "nothing"
                raise self.bad_cell(i, key, f"'{shown(cell)[1:-1]}' is not a number") from None
            if not abs(out[i]) < _LARGEST:
                raise self.bad_cell(i, key, f"{out[i]} is not finite")
        return out

    def text(self, key: Any) -> list[str]:
        """A column as text."""
        index = self._index(key)
        return [row[index].strip() if index < len(row) else "" for row in self.rows]

    def bad_cell(self, row: int, key: Any, said: str) -> BadTable:
        """The refusal of a cell."""
        where = f"{self.path.name}, line {self.first_line + row}, column {key}"
        return BadTable(where, said, "correct the cell, or leave the row out")

    def _index(self, key: Any) -> int:
        if isinstance(key, int) and not isinstance(key, bool) and (not self.rows or 0 <= key < len(self.rows[0])):
            return key
        if key in self.header:
            return self.header.index(key)
        known = ", ".join(self.header) or f"0 to {len(self.rows[0]) - 1 if self.rows else 0}"
        raise BadTable(f"{self.path.name}", f"has no column {key}", f"columns are {known}")


def import_tables(
    mapping: Any, folder: Path, source: str, heard: Callable[[float], None] = lambda share: None
) -> Recording:
    """The recording that a mapping makes of the tables in a folder.

    mapping: the data of the mapping file. source: its name, for messages. heard: is told the share of the tables that
    is read. Raises BadTable naming file, line and column.
    """
    mapping = require_mapping(mapping, source)
    joints: list[JointTrack] = []
    readings: list[ReadingTrack] = []
    signals: list[SignalTrack] = []
    notes: list[str] = []
    sockets: list[str] = []
    clock = 0.0
    for e, entry in enumerate(mapping["tables"]):
        paths = _matching(folder, entry["files"], source)
        if not paths:
            raise BadTable(f"{folder}/{entry['files']}", "matches no file", "check the folder and the name")
        for i, path in enumerate(paths):
            heard((e + i / len(paths)) / len(mapping["tables"]))
            table = _read(path, entry)
            stamps, note = _stamps(table, entry, clock, source)
            clock = float(stamps.max()) + 1.0
            notes += [note] if note and note not in notes else []
            joints.append(_joints(table, entry, stamps, source))
            readings.append(_reading(table, entry, stamps, source))
            sockets += [readings[-1].frame] if "same_point" in entry else []
            for frame, column in (entry.get("temperature") or {}).items():
                signals.append(
                    SignalTrack(f"temperature:{frame}", stamps, table.column(column)[:, None], "/temperature")
                )
    notes += [f"{SOCKETS}{', '.join(dict.fromkeys(sockets))}."] if sockets else []
    return Recording(_merged_joints(joints), _merged(readings), tuple(signals), None, source, tuple(notes))


def _matching(folder: Path, pattern: str, source: str) -> list[Path]:
    try:
        return sorted(path for path in folder.glob(pattern) if path.is_file())
    except (ValueError, NotImplementedError, IndexError, OSError) as error:
        said = f"{shown(pattern)} is not a file pattern"
        raise BadTable(f"{source}: files", said, "give names relative to the folder, such as run_*.csv") from error


def _need(entry: Mapping[str, Any], key: str, source: str) -> Any:
    if key not in entry:
        raise BadTable(source, f"'{key}' is not stated", "state it; nothing is guessed")
    return entry[key]


def _unit(entry: Mapping[str, Any], source: str, kinds: Sequence[str]) -> float:
    unit = _need(entry, "unit", source)
    if unit not in kinds:
        raise BadTable(source, f"unit '{unit}'", f"state {' or '.join(kinds)}")
    return _UNITS[unit]


def _read(path: Path, entry: Mapping[str, Any]) -> _Table:
    try:
        with path.open(encoding=entry.get("encoding", "utf-8-sig"), newline="") as stream:
            lines = list(csv.reader(stream, delimiter=entry.get("delimiter", ",")))
    except UnicodeError as error:
        raise BadTable(str(path), "is not text in the stated encoding", "state its encoding") from error
    except (csv.Error, TypeError) as error:
        raise BadTable(str(path), f"is not a table ({error})", "state its delimiter, or give a CSV file") from error
    has_header = bool(entry.get("header", True))
    header = tuple(cell.strip() for cell in lines[0]) if has_header and lines else ()
    rows = [line for line in lines[int(has_header) :] if any(cell.strip() for cell in line)]
    if not rows:
        raise BadTable(str(path), "has no row", "leave the file out")
    return _Table(path, header, rows, 1 + int(has_header), entry.get("decimal", "."))


def _stamps(table: _Table, entry: Mapping[str, Any], clock: float, source: str) -> tuple[Array, str | None]:
    """Stamps (N,) [s], no two alike, and what has to be said of them."""
    time = _need(entry, "time", source)
    if "order" in time:
        period = float(_need(time["order"], "period_s", source))
        return clock + period * np.arange(1.0, len(table.rows) + 1), ORDER_ONLY
    if "format" in time:
        out = np.empty(len(table.rows))
        for i, cell in enumerate(table.text(_need(time, "column", source))):
            try:
                moment = datetime.strptime(cell, time["format"])
                out[i] = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
            except (ValueError, IndexError, KeyError, OverflowError, re.error):
                where = f"{table.path.name}, line {table.first_line + i}, column {time['column']}"
                raise BadTable(where, f"'{cell}' is not {time['format']}", "correct the cell or the format") from None
    else:
        out = table.column(_need(time, "seconds", source))
    if not ((out >= 0.0) & (out < _LAST)).all():
        i = int(np.argmin((out >= 0.0) & (out < _LAST)))
        raise table.bad_cell(i, time.get("column", time.get("seconds")), f"{out[i]:g} s is not a plausible time")
    falls = int((np.diff(out) < 0.0).sum())
    warning = f"{table.path.name}: {falls} rows are stamped before the row above them." if falls else None
    # rows within the clock's resolution are still rows of their own
    order = np.argsort(out, kind="stable")
    rising = out[order]
    out[order] = rising + _ORDER_STEP * (np.arange(len(rising)) - np.searchsorted(rising, rising))
    return out, warning


def _joints(table: _Table, entry: Mapping[str, Any], stamps: Array, source: str) -> JointTrack:
    joints = _need(entry, "joints", source)
    scale = _unit(joints, f"{source}: joints", ("rad", "deg"))
    columns: Mapping[str, Any] = _need(joints, "columns", f"{source}: joints")
    position = scale * np.stack([table.column(column) for column in columns.values()], axis=1)
    unknown = np.full_like(position, np.nan)
    return JointTrack(tuple(columns), stamps, position, unknown, unknown, stamps)


def _reading(table: _Table, entry: Mapping[str, Any], stamps: Array, source: str) -> ReadingTrack:
    kinds = [k for k in ("pose", "point", "same_point") if k in entry]
    if len(kinds) != 1:
        raise BadTable(source, f"{len(kinds)} of pose, point and same_point are stated", "state one of them")
    reading = entry[kinds[0]]
    where = f"{source}: {kinds[0]}"
    frame = str(_need(reading, "frame", where))
    frame = frame.replace("{stem}", table.path.stem).replace("{folder}", table.path.parent.name)
    if "{" in frame:
        raise BadTable(where, f"frame '{frame}': only {{stem}} and {{folder}} are known", "correct it")
    if kinds[0] == "same_point":
        return ReadingTrack(POINT, frame, stamps, np.zeros((len(stamps), 3)), stamps, "/tracker/point")
    scale = _unit(reading, where, ("m", "mm"))
    columns = _need(reading, "position", where)
    p = scale * np.stack([table.column(c) for c in columns], axis=1)
    if kinds[0] == "point":
        return ReadingTrack(POINT, frame, stamps, p, stamps, "/tracker/point")
    T = se3.transform(_orientation(table, reading, where), p)
    return ReadingTrack(POSE, frame, stamps, se3.to_pose(se3.inverse(T) if reading.get("inverse") else T), stamps)


def _orientation(table: _Table, reading: Mapping[str, Any], where: str) -> Array:
    stated = [k for k in ("euler", "quaternion", "rotvec") if k in reading]
    if len(stated) != 1:
        raise BadTable(where, "its angle convention is not stated", "state euler, quaternion or rotvec")
    if stated[0] == "quaternion":
        columns = _need(reading["quaternion"], "columns", where)
        if len(columns) != 4:
            raise BadTable(where, f"{len(columns)} quaternion columns", "name those of x, y, z, w")
        values = np.stack([table.column(c) for c in columns], axis=1)
        length = np.linalg.norm(values, axis=1)
        if not (length > _LEAST_LENGTH).all():
            raise table.bad_cell(int(np.argmin(length)), columns[0], "a quaternion of zeros is not an orientation")
        return Rotation.from_quat(values).as_matrix()
    angles = reading[stated[0]]
    scale = _unit(angles, where, ("rad", "deg"))
    values = scale * np.stack([table.column(c) for c in _need(angles, "columns", where)], axis=1)
    if angles["unit"] == "rad" and (largest := float(np.abs(values).max())) > _MOST_RAD:
        raise BadTable(where, f"angles reach {largest:.0f} rad: they look like degrees", "state unit: deg")
    if stated[0] == "rotvec":
        return Rotation.from_rotvec(values).as_matrix()
    sequence = str(_need(angles, "sequence", where))
    try:
        return Rotation.from_euler(sequence, values).as_matrix()
    except ValueError as error:
        raise BadTable(where, f"sequence '{sequence}': {error}", "three axes: XYZ turning along, xyz fixed") from error


def _merged(tracks: list[ReadingTrack]) -> tuple[ReadingTrack, ...]:
    out: dict[tuple[str, str], ReadingTrack] = {}
    for track in tracks:
        key = (track.kind, track.frame)
        if key in out:
            old = out[key]
            stamps = np.r_[old.stamps, track.stamps]
            track = replace(track, stamps=stamps, values=np.r_[old.values, track.values], received=stamps)
        out[key] = track
    return tuple(out.values())


def _merged_joints(tracks: list[JointTrack]) -> tuple[JointTrack, ...]:
    names = tracks[0].names
    if any(track.names != names for track in tracks):
        raise BadTable("tables", "have different joints", "import them into bags of their own")
    stamps = np.concatenate([t.stamps for t in tracks])
    position = np.concatenate([t.position for t in tracks])
    unknown = np.full_like(position, np.nan)
    return (JointTrack(names, stamps, position, unknown, unknown, stamps),)
