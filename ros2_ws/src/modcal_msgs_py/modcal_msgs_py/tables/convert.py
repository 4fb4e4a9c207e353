"""Tables of measurements to a recording: a small mapping says which column is what, and in which unit.

Nothing is guessed: a unit or an angle convention that the mapping does not state is an error. Every row becomes one
joint state and one reading with the same stamp, that is a finished station; a table may also hold joints alone, or
readings alone, on the same clock.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.measurements import SOCKETS, JointTrack, ReadingTrack, Recording, Schema, SignalTrack, require, shown
from modcal_msgs_py.tables import readings as of_readings
from modcal_msgs_py.tables.moments import stamps_of
from modcal_msgs_py.tables.readings import EFFORTS, FORMS, TOPICS
from modcal_msgs_py.tables.table import Faults, Form, Table, join, read_sheet

_REMEDY = "see docs/import.md"
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")  # of a topic, as ROS 2 allows


def _said(schema: Schema, description: str) -> Schema:
    return {**schema, "description": description}


def _mapping(properties: Schema, *required: str) -> Schema:
    return {"type": "object", "properties": properties, "required": list(required), "additionalProperties": False}


_COLUMN = {"type": ["string", "integer"], "description": "a column, by its label or by its number from 0"}


def _columns(count: int) -> Schema:
    return {"type": "array", "items": _COLUMN, "minItems": count, "maxItems": count}


_BY_JOINT = {"type": "object", "additionalProperties": _COLUMN, "minProperties": 1, "description": "joint: column"}
_FRAME = {
    "type": "string",
    "minLength": 1,
    "description": "name of the instrument's frame; {stem} and {folder} of the file may stand in it",
}
_LENGTH = {"type": "string", "enum": ["m", "cm", "mm", "in"]}
_ANGLE = {"type": "string", "enum": ["rad", "deg"]}
_JOINT = {"type": "string", "enum": ["rad", "deg", "m", "cm", "mm", "in"]}
_SPEED = {"type": "string", "enum": ["rad/s", "deg/s", "m/s", "mm/s"]}
_PERIOD = {"type": "number", "exclusiveMinimum": 0, "maximum": 1e6}
_COUNT = {"type": "integer", "minimum": 0, "maximum": 100_000}
_FORM: Schema = {
    "delimiter": {"type": "string", "minLength": 1, "maxLength": 1,
                  "description": "what separates columns; a blank stands for any run of blanks. Default: ,"},
    "decimal": {"type": "string", "enum": [".", ","], "description": "decimal sign. Default: ."},
    "header": {"type": "boolean", "description": "whether a row of labels stands above the numbers. Default: true"},
    "encoding": {"type": "string", "description": "of the text, such as utf-8, utf-16, latin-1. Default: utf-8"},
    "preamble_rows": _said(_COUNT, "lines above the labels"),
    "units_rows": _said(_COUNT, "rows between labels and numbers"),
}  # fmt: skip
_TIME = {
    "type": "object",
    "oneOf": [
        _mapping(
            {"column": {"type": ["string", "integer", "array"], "items": _COLUMN, "minItems": 1, "maxItems": 2},
             "format": {"type": "string", "minLength": 1, "description": "as strptime has it: %Y-%m-%d %H:%M:%S"}},
            "column", "format",
        ),
        _mapping({"seconds": _COLUMN, "unit": {"type": "string", "enum": ["s", "ms", "us", "ns"]}}, "seconds"),
        _mapping({"order": _mapping({"period_s": _PERIOD}, "period_s")}, "order"),
    ],
    "description": "when a row was taken: a date, a number of seconds, or its order only",
}  # fmt: skip
_EULER = _mapping(
    {"columns": _columns(3), "unit": _ANGLE,
     "sequence": {"type": "string", "minLength": 3, "maxLength": 3,
                  "description": "upper case turning along with the body, lower case about fixed axes"}},
    "columns", "unit", "sequence",
)  # fmt: skip
_QUATERNION = _mapping(
    {"columns": _said(_columns(4), "those of x, y, z and w, in this order"), "conjugate": {"type": "boolean"}},
    "columns",
)
_STD = _mapping(
    {
        "position": {"type": ["string", "integer", "array"], "items": _COLUMN, "minItems": 3, "maxItems": 3},
        "unit": _LENGTH,
        "orientation": {"type": ["string", "integer", "array"], "items": _COLUMN, "minItems": 3, "maxItems": 3},
        "orientation_unit": _ANGLE,
        "coverage": {
            "type": "number",
            "minimum": 1,
            "maximum": 10,
            "description": "standard deviations in what is stated, such as 2 of expanded uncertainties",
        },
    }
)
_ORIENTATIONS: Schema = {
    "euler": _EULER,
    "quaternion": _QUATERNION,
    "rotvec": _mapping({"columns": _columns(3), "unit": _ANGLE}, "columns", "unit"),
    "matrix": _mapping({"columns": _said(_columns(9), "row by row")}, "columns"),
}
_DEVIATION: Schema = {
    "plus": _said(_columns(3), "a deviation in the same unit, added to the position: of a goal, what was reached"),
    "minus": _said(_columns(3), "the same, taken from the position"),
}
_INVERSE = {"type": "boolean", "description": "true: the table holds the tracker's pose in the tool"}


def _one_or_many(one: Schema) -> Schema:
    return {**one, "type": ["object", "array"], "items": one, "minItems": 1}


_READINGS: Schema = {
    "pose": _one_or_many(
        _mapping(
            {"frame": _FRAME, "unit": _LENGTH, "position": _columns(3), **_DEVIATION, "inverse": _INVERSE,
             "std": _STD, **_ORIENTATIONS},
            "frame", "unit", "position",
        )
    ),
    "point": _one_or_many(
        _mapping(
            {"frame": _FRAME, "unit": _LENGTH, "position": _columns(3), **_DEVIATION, "std": _STD},
            "frame", "unit", "position",
        )
    ),
    "targets": _one_or_many(
        _mapping(
            {"frame": _FRAME, "unit": _LENGTH,
             "points": {"type": "object", "additionalProperties": _columns(3), "minProperties": 3}},
            "frame", "unit", "points",
        )
    ),
    "same_point": _mapping({"frame": _FRAME}, "frame"),
    "range": _one_or_many(_mapping({"frame": _FRAME, "unit": _LENGTH, "column": _COLUMN}, "frame", "unit", "column")),
    "bearing": _one_or_many(
        _mapping(
            {"frame": _FRAME, "vector": _columns(3), "unit": {"type": "string", "enum": ["rad", "deg", "gon"]},
             "azimuth": _COLUMN, "elevation": _COLUMN, "zenith": _COLUMN,
             "clockwise": {"type": "boolean", "description": "true: the azimuth grows clockwise, seen from above"}},
            "frame",
        )
    ),
    "plane": _one_or_many(_mapping({"frame": _FRAME, "unit": _LENGTH, "column": _COLUMN}, "frame")),
    "ray": _one_or_many(_mapping({"frame": _FRAME, "unit": _LENGTH, "column": _COLUMN}, "frame", "unit", "column")),
}  # fmt: skip
_TABLE = _mapping(
    {
        "files": {"type": "string", "minLength": 1,
                  "description": "relative to --data, or beside the mapping; * fits any text"},
        **_FORM,
        "missing": {"type": "string", "enum": ["refuse", "skip"],
                    "description": "rows that lack something: refused, or left out and counted. Default: refuse"},
        "missing_values": {"type": "array", "items": {"type": "string"}, "description": "further texts for no number"},
        "zeros_missing": {"type": "array", "items": _COLUMN, "minItems": 1,
                          "description": "columns that are all zero where nothing was read; such rows are missing"},
        "joined": {
            "type": "array",
            "items": _mapping(
                {"files": {"type": "string", "minLength": 1}, **_FORM,
                 "by": {"type": "object", "additionalProperties": {"type": "string"}, "minProperties": 1,
                        "description": "column here: column there"},
                 "within": _said(_PERIOD, "the nearest row within this difference, not the same value")},
                "files", "by",
            ),
            "description": "files whose columns stand beside these",
        },
        "time": _TIME,
        "joints": _mapping(
            {
                "unit": _JOINT,
                "units": {"type": "object", "additionalProperties": _JOINT, "description": "of single joints"},
                "columns": _BY_JOINT,
                "velocity": _mapping({"unit": _SPEED, "columns": _BY_JOINT}, "unit", "columns"),
                "effort": _mapping(
                    {"columns": _BY_JOINT,
                     "unit": {"type": "string", "enum": list(EFFORTS), "description": "Default: N m, and N"},
                     "of_load": {"type": "boolean",
                                 "description": "true: the load's torque on the actuator, the opposite sign"}},
                    "columns",
                ),
                "commanded": _mapping(
                    {"unit": _JOINT, "units": {"type": "object", "additionalProperties": _JOINT}, "columns": _BY_JOINT},
                    "columns",
                ),
            },
            "unit", "columns",
        ),
        **_READINGS,
        "temperature": {"type": ["object", "null"], "additionalProperties": _COLUMN,
                        "description": "frame: column, °C"},
        "signals": {"type": ["object", "null"], "additionalProperties": _COLUMN,
                    "description": "topic: column; anything that an error may depend on"},
    },
    "files", "time",
)  # fmt: skip
SCHEMA = _mapping(
    {
        "urdf": {"type": ["string", "null"], "description": "robot description, beside the mapping or in --data"},
        "undecided": {
            "type": "array",
            "items": {"type": "string"},
            "maxItems": 0,
            "description": "what a proposed mapping could not tell: decide, correct what is below, and remove this",
        },
        "tables": {"type": "array", "items": _TABLE, "minItems": 1},
    },
    "tables",
)


def json_schema() -> dict[str, Any]:
    """The schema as editors take it, JSON Schema draft 2020-12."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Mapping of modcal import", **SCHEMA}


def require_mapping(mapping: Any, source: str) -> Mapping[str, Any]:
    """The mapping, if it is one. Raises BadTable with the key that is not as it must be."""
    if isinstance(mapping, Mapping) and (questions := mapping.get("undecided")) and isinstance(questions, list):
        more = f" ({len(questions) - 1} more)" if len(questions) > 1 else ""
        said = f"{str(questions[0])[:300]}{more}"
        raise BadTable(f"{source}: undecided", said, "correct what is below it, and remove the line")
    require(mapping, SCHEMA, source, _REMEDY)
    for i, table in enumerate(mapping["tables"]):
        _require_table(table, f"{source}: tables, entry {i + 1}")
    if not any(key in table for table in mapping["tables"] for key in TOPICS):
        said = "0 of pose, point and same_point, or of other readings, are stated"
        raise BadTable(source, said, f"state one of {', '.join(TOPICS)}")
    if not any("joints" in table for table in mapping["tables"]):
        raise BadTable(source, "no table has joints", "state joints: {unit, columns} of one of them")
    return mapping


def _require_table(table: Mapping[str, Any], where: str) -> None:
    for part, said in ((table, where), *((other, f"{where}: joined") for other in table.get("joined", ()))):
        _require_form(part, said)
    readings = [key for key in TOPICS if key in table]
    if "same_point" in readings and len(readings) > 1:
        raise BadTable(where, "same_point stands beside other readings", "state one of them")
    if not readings and "joints" not in table:
        said = "neither joints nor a reading are stated"
        raise BadTable(where, said, f"state joints, one of {', '.join(TOPICS)}, or both")
    for pose in _each(table.get("pose")):
        stated = [form for form in FORMS if form in pose]
        if len(stated) != 1:
            said = f"{' and '.join(stated)} are both stated" if stated else "its angle convention is not stated"
            raise BadTable(f"{where}: pose", said, f"state one of {', '.join(FORMS)}")
    for key in ("pose", "point"):
        if any("plus" in one and "minus" in one for one in _each(table.get(key))):
            raise BadTable(f"{where}: {key}", "plus and minus are both stated", "state one of them")
    for bearing in _each(table.get("bearing")):
        angles = [key for key in ("elevation", "zenith") if key in bearing]
        if ("vector" in bearing) == ("azimuth" in bearing) or ("azimuth" in bearing) != (len(angles) == 1):
            said = "neither a vector nor two angles are stated"
            raise BadTable(f"{where}: bearing", said, "state vector, or azimuth and one of elevation and zenith")
        if "azimuth" in bearing and "unit" not in bearing:
            raise BadTable(f"{where}: bearing", "'unit' is not stated", "state rad or deg")
    for plane in _each(table.get("plane")):
        if "column" in plane and "unit" not in plane:
            raise BadTable(f"{where}: plane", "'unit' is not stated", "state m or mm")
    for name in table.get("signals") or {}:
        if not _NAME.fullmatch(name):
            said = f"{shown(name)} is not a topic name"
            raise BadTable(f"{where}: signals", said, "use letters, digits, _ and /, and begin with a letter")
    joints = table.get("joints", {})
    for part in ("units", "velocity", "effort", "commanded"):
        named = joints.get(part, {})
        odd = [
            name for name in (named.get("columns", {}) if part != "units" else named) if name not in joints["columns"]
        ]
        if odd:
            raise BadTable(f"{where}: joints: {part}", f"{odd[0]} has no position column", "name joints of columns")


def _each(stated: Any) -> list[Mapping[str, Any]]:
    return [] if stated is None else [stated] if isinstance(stated, Mapping) else list(stated)


def _require_form(part: Mapping[str, Any], where: str) -> None:
    delimiter, decimal = part.get("delimiter", ","), part.get("decimal", ".")
    if delimiter in '\r\n"\0':
        raise BadTable(f"{where}: delimiter", f"{shown(delimiter)} cannot separate columns", _REMEDY)
    if delimiter == decimal:
        raise BadTable(f"{where}: decimal", f"{shown(decimal)} is the delimiter too", "state the other one")
    if not _is_text_encoding(part.get("encoding", "utf-8-sig")):
        raise BadTable(f"{where}: encoding", f"{shown(part['encoding'])} is not a text encoding", "e.g. utf-8")


def _is_text_encoding(name: str) -> bool:
    try:
        "".encode(name)
        return codecs.lookup(name) is not None
    except (LookupError, ValueError, UnicodeError):
        return False


@dataclass(frozen=True)
class Tables:
    """What a mapping makes of tables: a recording, and joint positions that were commanded, where it states some."""

    recording: Recording
    commanded: JointTrack | None = None


def import_tables(
    mapping: Any, folder: Path, source: str, heard: Callable[[float], None] = lambda share: None
) -> Recording:
    """The recording that a mapping makes of the tables in a folder; as :func:`read_tables`."""
    return read_tables(mapping, folder, source, heard).recording


def read_tables(mapping: Any, folder: Path, source: str, heard: Callable[[float], None] = lambda share: None) -> Tables:
    """What a mapping makes of the tables in a folder.

    mapping: the data of the mapping file. source: its name, for messages. heard: is told the share of the tables that
    is read. Raises BadTable naming the file, and all faulty lines and columns in it.
    """
    mapping = require_mapping(mapping, source)
    joints: list[JointTrack] = []
    commanded: list[JointTrack] = []
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
            table = _table(path, entry, folder, source)
            stamps, note = stamps_of(table, entry["time"], clock)
            if "joints" in entry:
                track, wanted = of_readings.joints_of(table, entry["joints"], stamps)
                joints.append(track)
                commanded += [wanted] if wanted is not None else []
            found = list(of_readings.readings_of(table, entry, stamps, source))
            own_signals = list(_signals(table, entry, stamps))
            table.faults.require_none()
            if not np.isfinite(stamps).any() or ("joints" in entry and not len(joints[-1].stamps)):
                raise BadTable(
                    path.name, "has no row with a time and all joints", "check the columns and missing cells"
                )
            clock = float(np.nanmax(stamps)) + 1.0
            notes += [n for n in (note, *table.faults.notes()) if n and n not in notes]
            readings += found
            signals += own_signals
            sockets += [track.frame for track in found] if "same_point" in entry else []
    if joints and readings and not sum(len(track.stamps) for track in readings):
        raise BadTable(source, "no row has a reading", "check the columns and missing cells")
    notes += [f"{SOCKETS}{', '.join(dict.fromkeys(sockets))}."] if sockets else []
    states = of_readings.merged_joints(joints)
    recording = Recording(
        () if states is None else (states,), of_readings.merged(readings), tuple(signals), None, source, tuple(notes)
    )
    return Tables(recording, of_readings.merged_joints(commanded))


def _matching(folder: Path, pattern: str, source: str) -> list[Path]:
    try:
        return sorted(path for path in folder.glob(pattern) if path.is_file())
    except (ValueError, NotImplementedError, IndexError, OSError) as error:
        said = f"{shown(pattern)} is not a file pattern"
        raise BadTable(f"{source}: files", said, "give names relative to the folder, such as run_*.csv") from error


def _table(path: Path, entry: Mapping[str, Any], folder: Path, source: str) -> Table:
    faults = Faults(path.name, entry.get("missing", "refuse") == "skip")
    table = Table(read_sheet(path, Form.stated(entry)), faults, frozenset(map(str, entry.get("missing_values", ()))))
    for other in entry.get("joined", ()):
        join(table, other, folder, source)
    if "zeros_missing" in entry:
        table.blank_zeros(list(entry["zeros_missing"]))
    return table


def _signals(table: Table, entry: Mapping[str, Any], stamps: np.ndarray) -> list[SignalTrack]:
    """Temperatures and other signals; a cell without a number is a value that was not sent."""
    out = []
    for kind, prefix in (("temperature", "temperature:"), ("signals", "signal:/")):
        for name, column in (entry.get(kind) or {}).items():
            values = table.numbers(column)
            keep = np.isfinite(values) & np.isfinite(stamps)
            topic = "/temperature" if kind == "temperature" else f"/{name}"
            out.append(SignalTrack(f"{prefix}{name}", stamps[keep], values[keep][:, None], topic))
    return out
