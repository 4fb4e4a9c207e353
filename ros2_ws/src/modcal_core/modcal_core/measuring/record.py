"""A session as plain data and as tables: what a file keeps of it, and what a technician with a spreadsheet fills in.

Angles are in degrees and lengths in millimetres in the tables, for people type them; in the file everything is SI.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, refusing
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POINT, POSE
from modcal_core.measurements.schema import require
from modcal_core.measuring.goal import Goal
from modcal_core.measuring.session import (
    DECIDE,
    FIT,
    MEASURED,
    PLANNED,
    PROOF,
    RETURN,
    SKIPPED,
    UNSEEN,
    Look,
    Session,
    Station,
)

FORMAT = 1  # of the file
_NUMBERS = {"type": ["array", "null"], "items": {"type": "number"}}
_SCHEMA = {
    "type": "object",
    "required": ["modcal_measure", "robot", "joints", "reading", "goal", "seed", "stations", "looks"],
    "properties": {
        "modcal_measure": {"enum": [FORMAT]},
        "robot": {"type": "string"},
        "joints": {"type": "array", "items": {"type": "string"}, "minItems": 1},
        "reading": {"enum": [POINT, POSE]},
        "on_tool": {"type": "boolean"},
        "seed": {"type": "integer", "minimum": 0},
        "began": {"type": ["number", "null"]},
        "goal": {"type": "object"},
        "looks": {
            "type": "array",
            "items": {
                "type": "object",
                "required": ["fitted", "expected", "axes"],
                "properties": {
                    "fitted": {"type": "integer", "minimum": 1},
                    "expected": {"type": "number", "exclusiveMinimum": 0},
                    "axes": {"type": "number", "minimum": 1, "maximum": 2},
                },
            },
        },
        "stations": {
            "type": "array",
            "items": {
                "type": "object",
                "required": ["role", "state", "asked"],
                "properties": {
                    "role": {"enum": [FIT, RETURN, DECIDE, PROOF]},
                    "state": {"enum": [PLANNED, MEASURED, UNSEEN, SKIPPED]},
                    "asked": {"type": "array", "items": {"type": "number"}},
                    "q": _NUMBERS,
                    "reading": _NUMBERS,
                    "approach": _NUMBERS,
                    "effort": _NUMBERS,
                    "stamp": {"type": ["number", "null"]},
                    "sigma": {"type": ["number", "null"], "minimum": 0},
                    "row": {"type": "integer"},
                },
            },
        },
    },
}
_REMEDY = "give the session.yaml that modcal measure wrote, or another folder"
_POINT_COLUMNS, _POSE_COLUMNS = ("x_mm", "y_mm", "z_mm"), ("rx_deg", "ry_deg", "rz_deg")
NOTE = "note"  # the column in which a technician says that a station was not seen or not reached
_UNSEEN_WORDS, _SKIPPED_WORDS = ("unseen", "not seen"), ("skipped", "not reached")
_OFF = 0.02  # rad or m by which the arm may stand beside the posture that was asked for; more is a mistake of typing


def to_data(session: Session, goal: Goal, seed: int, robot: str, began: float | None) -> dict[str, Any]:
    """Everything of a session, in nested dictionaries and lists. robot: fingerprint. began: [s]."""
    return {
        "modcal_measure": FORMAT,
        "robot": robot,
        "joints": list(session.names),
        "reading": session.kind,
        **({"on_tool": True} if session.carried else {}),
        "seed": seed,
        "began": began,
        "goal": asdict(goal),
        "looks": [asdict(look) for look in session.looks],
        "stations": [_station_data(s) for s in session.stations],
    }


def _station_data(s: Station) -> dict[str, Any]:
    out: dict[str, Any] = {"role": s.role, "state": s.state, "asked": _list(s.asked)}
    for name in ("q", "reading", "approach", "effort"):
        value = getattr(s, name)
        if value is not None and np.isfinite(value).all():
            out[name] = _list(value)
    for name in ("stamp", "sigma"):
        if np.isfinite(value := getattr(s, name)):
            out[name] = float(value)
    if s.row >= 0:
        out["row"] = s.row
    return out


def _list(values: Array) -> list[float]:
    return [float(v) for v in values]


@refusing
def from_data(data: Any, source: str) -> tuple[Session, Goal, int, str, float | None]:
    """Session, goal, seed, fingerprint and beginning of what :func:`to_data` made. Raises BadTable."""
    require(data, _SCHEMA, source, _REMEDY)
    names = tuple(str(name) for name in data["joints"])
    stations = []
    for i, row in enumerate(data["stations"]):
        wide = {key: row.get(key) for key in ("asked", "q", "approach", "effort")}
        vectors = {k: None if v is None else np.array(v, dtype=float) for k, v in wide.items()}
        if any(v is not None and v.shape != (len(names),) for v in vectors.values()):
            raise BadTable(f"{source}, station {i + 1}", f"does not have {len(names)} joints", _REMEDY)
        reading = None if row.get("reading") is None else np.array(row["reading"], dtype=float)
        size = 7 if data["reading"] == POSE else 3
        if (row["state"] == MEASURED) != (reading is not None) or (reading is not None and reading.shape != (size,)):
            raise BadTable(f"{source}, station {i + 1}", f"is {row['state']} and has {reading} as reading", _REMEDY)
        asked = vectors.pop("asked")
        assert asked is not None
        stations.append(
            Station(
                asked,
                row["role"],
                row["state"],
                reading=reading,
                stamp=_or_nan(row.get("stamp")),
                sigma=_or_nan(row.get("sigma")),
                row=row.get("row", -1),
                **vectors,
            )
        )
    looks = tuple(Look(**look) for look in data["looks"])
    session = Session(names, data["reading"], tuple(stations), looks, data.get("on_tool", False))
    return session, Goal(**data["goal"]), data["seed"], data["robot"], data.get("began")


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def to_table(session: Session, numbers: Sequence[int], revolute: np.ndarray) -> str:
    """A CSV table of these stations: number, what it is for, joints, reading and a note, each empty where not known."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["station", "for", *_joint_columns(session.names, revolute), *_reading_columns(session.kind), NOTE])
    for i in numbers:
        s = session.stations[i]
        q = s.asked if s.q is None else s.q
        shown = [f"{v:.5f}" for v in np.where(revolute, np.degrees(q), 1e3 * q)]
        note = s.state if s.state in (UNSEEN, SKIPPED) else ""
        writer.writerow([i + 1, s.role, *shown, *_written(s.reading, session.kind), note])
    return out.getvalue()


def _joint_columns(names: Sequence[str], revolute: np.ndarray) -> list[str]:
    return [f"{name}_{'deg' if turns else 'mm'}" for name, turns in zip(names, revolute, strict=True)]


def _reading_columns(kind: str) -> tuple[str, ...]:
    return (*_POINT_COLUMNS, *_POSE_COLUMNS) if kind == POSE else _POINT_COLUMNS


def _written(reading: Array | None, kind: str) -> list[str]:
    if reading is None:
        return [""] * len(_reading_columns(kind))
    turned: list[float] = np.degrees(so3.to_rpy(so3.from_quaternion(reading[3:]))).tolist() if kind == POSE else []
    return [f"{v:.5f}" for v in (*(1e3 * reading[:3]), *turned)]


@refusing
def with_table(session: Session, text: str, revolute: np.ndarray, source: str) -> Session:
    """The session with what a technician wrote into a table of its pending stations.

    A row whose reading is empty and that says nothing in its note is left for later. Raises BadTable with the row for
    what cannot be: a station that is not pending, half a reading, joints far from where they were asked to be.
    """
    lines = list(csv.reader(io.StringIO(text), delimiter=_separator(text)))
    head = [cell.strip().lstrip("\ufeff") for cell in lines[0]] if lines else []
    joints, read = _joint_columns(session.names, revolute), _reading_columns(session.kind)
    for name in ("station", *joints, *read):
        if head.count(name) != 1:
            raise BadTable(source, f"has {head.count(name)} columns '{name}'", "keep the head of the table as it was")
    for row, line in enumerate(lines[1:], 2):
        cells = {name: (line[k].strip() if k < len(line) else "") for k, name in enumerate(head)}
        if any(cells.values()):
            session = _filled(session, cells, joints, read, revolute, f"{source}, row {row}")
    return session


def _separator(text: str) -> str:
    """Spreadsheets write semicolons where the comma is a decimal point."""
    first = text.partition("\n")[0]
    return ";" if first.count(";") > first.count(",") else "\t" if first.count("\t") > first.count(",") else ","


def _filled(
    session: Session, cells: Mapping[str, str], joints: Sequence[str], read: Sequence[str], turns: np.ndarray, at: str
) -> Session:
    number = int(_number(cells["station"], f"{at}, station")) - 1
    if not 0 <= number < len(session.stations) or session.stations[number].state != PLANNED:
        raise BadTable(at, f"station {number + 1} is not asked for", "keep the numbers of the table as they were")
    station, note = session.stations[number], cells.get(NOTE, "").lower()
    given = [cells[name] for name in read]
    if note in _UNSEEN_WORDS or note in _SKIPPED_WORDS:
        state = UNSEEN if note in _UNSEEN_WORDS else SKIPPED
        return session.with_station(number, replace(station, state=state))
    if not any(given):
        return session
    values = np.array([_number(cell, f"{at}, {name}") for cell, name in zip(given, read, strict=True)])
    stood = np.array([_number(cells[name], f"{at}, {name}") for name in joints])
    q = np.where(turns, np.radians(stood), 1e-3 * stood)
    off = np.abs(q - station.asked)
    if off.max() > _OFF:
        k = int(np.argmax(off))
        size = f"{np.degrees(off[k]):.2f}°" if turns[k] else f"{1e3 * off[k]:.1f} mm"
        raise BadTable(f"{at}, {joints[k]}", f"is {size} from where it was asked to be", "correct it, or note: skipped")
    reading = 1e-3 * values[:3]
    if session.kind == POSE:
        reading = np.r_[reading, so3.to_quaternion(so3.from_rpy(np.radians(values[3:])))]
    return session.with_station(number, station.measured(reading, q))


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell.replace(",", "."))
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise BadTable(where, f"'{cell}' is not a number", "write one, or leave the whole reading empty")
    return value
