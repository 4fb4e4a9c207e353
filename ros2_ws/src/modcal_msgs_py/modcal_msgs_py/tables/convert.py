"""Tables of measurements to a recording: a small mapping says which column is what, and in which unit.

Nothing is guessed: a unit or an angle convention that the mapping does not state is an error. Every row becomes one
joint state and one reading with the same stamp, that is a finished station; a table may also hold joints alone, or
readings alone, on the same clock.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.measurements import (
    SOCKETS,
    TARGETS,
    JointTrack,
    ReadingTrack,
    Recording,
    Schema,
    SignalTrack,
    require,
    shown,
)
from modcal_msgs_py.tables import readings as of_readings
from modcal_msgs_py.tables.moments import TIME, stamps_of
from modcal_msgs_py.tables.readings import COLUMN, JOINTS, READINGS, each, mapping, one_of, said
from modcal_msgs_py.tables.sheet import Form, Sheet, joined, read_sheet
from modcal_msgs_py.tables.table import Table, chosen

_REMEDY = "see docs/import.md"
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")  # of a topic, as ROS 2 allows
_TEXT: Schema = {"type": "string", "minLength": 1}
_COUNT: Schema = {"type": "integer", "minimum": 0, "maximum": 100_000}
_WITHIN: Schema = {"type": "number", "exclusiveMinimum": 0, "maximum": 1e6}
_FORM: Schema = {
    "delimiter": {"type": "string", "minLength": 1, "maxLength": 1,
                  "description": "what separates columns; a blank stands for any run of blanks. Default: ,"},
    "decimal": said(one_of(".", ","), "decimal sign. Default: ."),
    "header": {"type": "boolean", "description": "whether a row of labels stands above the numbers. Default: true"},
    "encoding": {"type": "string", "description": "of the text, such as utf-8, utf-16, latin-1. Default: utf-8"},
    "preamble_rows": said(_COUNT, "lines above the labels"),
    "units_rows": said(_COUNT, "rows between labels and numbers"),
    "sheet": said(_TEXT, "of a workbook. Default: the first one"),
}  # fmt: skip
_BY = said(
    {"type": ["object", "string"], "additionalProperties": {"type": "string"}, "minProperties": 1},
    "column here: column there; or row: the rows stand in the same order",
)
_ROWS: Schema = {
    "type": "object",
    "additionalProperties": {"type": ["string", "number", "array"], "items": {"type": ["string", "number"]}},
    "minProperties": 1,
    "description": "column: value, or several; other rows are left out",
}
_CELLS: Schema = {"type": ["object", "null"], "additionalProperties": COLUMN}
ENTRY: Schema = {
    "files": said(_TEXT, "relative to --data, or beside the mapping; * fits any text"),
    **_FORM,
    "rows": _ROWS,
    "missing": said(one_of("refuse", "skip"),
                    "rows that lack something: refused, or left out and counted. Default: refuse"),
    "missing_values": {"type": "array", "items": {"type": "string"}, "description": "further texts for no number"},
    "zeros_missing": {"type": "array", "items": COLUMN, "minItems": 1,
                      "description": "columns that are all zero where nothing was read; such rows are missing"},
    "joined": {
        "type": "array",
        "items": mapping(
            {"files": _TEXT, **_FORM, "by": _BY,
             "within": said(_WITHIN, "the nearest row within this difference, not the same value")},
            "files", "by",
        ),
        "description": "files whose columns stand beside these",
    },
    "time": TIME,
    "joints": JOINTS,
    **{key: row.schema for key, row in READINGS.items()},
    "temperature": said(_CELLS, "frame: column, °C"),
    "signals": said(_CELLS, "topic: column; anything that an error may depend on"),
}  # fmt: skip
SCHEMA = mapping(
    {
        "urdf": {"type": ["string", "null"], "description": "robot description, beside the mapping or in --data"},
        "delta": {"type": "string", "description": "description of a Delta, beside the mapping, in place of urdf"},
        "base": {"type": ["string", "null"], "description": "link where the arm begins. Default: the root"},
        "tip": {"type": ["string", "null"], "description": "link where it ends. Default: behind most joints"},
        "undecided": {
            "type": "array",
            "items": {"type": "string"},
            "maxItems": 0,
            "description": "what a proposed mapping could not tell: decide, correct what is below, and remove this",
        },
        "tables": {"type": "array", "items": mapping(ENTRY, "files", "time"), "minItems": 1},
    },
    "tables",
)


def json_schema() -> dict[str, Any]:
    """The schema as editors take it, JSON Schema draft 2020-12."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Mapping of modcal import", **SCHEMA}


def require_mapping(stated: Any, source: str) -> Mapping[str, Any]:
    """The mapping, if it is one. Raises BadTable with the key that is not as it must be."""
    if isinstance(stated, Mapping) and (questions := stated.get("undecided")) and isinstance(questions, list):
        more = f" ({len(questions) - 1} more)" if len(questions) > 1 else ""
        first = f"{str(questions[0])[:300]}{more}"
        raise BadTable(f"{source}: undecided", first, "correct what is below it, and remove the line")
    require(stated, SCHEMA, source, _REMEDY)
    for i, table in enumerate(stated["tables"]):
        for part, what, remedy in _contradictions(table):
            raise BadTable(f"{source}: tables, entry {i + 1}{part}", what, remedy)
    if not any("joints" in table or "ray" in table for table in stated["tables"]):
        raise BadTable(source, "no table has joints", "state joints: {unit, columns} of one of them")
    return stated


def _contradictions(table: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """What no schema says, as a part of the entry, what is wrong with it, and the remedy."""
    stated = [key for key in READINGS if key in table]
    if "same_point" in stated and len(stated) > 1:
        yield "", "same_point stands beside other readings", "state one of them"
    if not stated and "joints" not in table:
        what = "neither joints nor a reading are stated"
        yield "", what, f"state joints, one of {', '.join(READINGS)}, or both"
    if any("column" in one and "unit" not in one for one in each(table.get("plane"))):
        yield ": plane", "'unit' is not stated", "state m or mm"
    for name in table.get("signals") or {}:
        if not _NAME.fullmatch(name):
            remedy = "use letters, digits, _ and /, and begin with a letter"
            yield ": signals", f"{shown(name)} is not a topic name", remedy
    joints = table.get("joints", {})
    named = {part: [*joints.get(part, ())] for part in ("units", "sign", "offset", "coupled")}
    named |= {part: [*joints.get(part, {}).get("columns", ())] for part in ("velocity", "effort", "commanded")}
    named["coupled"] += [name for others in joints.get("coupled", {}).values() for name in others]
    for part, names in named.items():
        for name in names:
            if name not in joints["columns"]:
                yield f": joints: {part}", f"{name} has no position column", "name joints of columns"
    for part in (table, *table.get("joined", ())):
        if part.get("delimiter", ",") == part.get("decimal", "."):
            yield ": decimal", f"{shown(part.get('decimal', '.'))} is the delimiter too", "state the other one"


def import_tables(
    mapping: Any, folder: Path, source: str, heard: Callable[[float], None] = lambda share: None
) -> Recording:
    """The recording that a mapping makes of the tables in a folder; where joints were commanded, with those commands.

    mapping: the data of the mapping file. source: its name, for messages. heard: is told the share of the tables that
    is read. Raises BadTable naming the file, and all faulty lines and columns in it.
    """
    mapping = require_mapping(mapping, source)
    found = _Found()
    for e, entry in enumerate(mapping["tables"]):
        paths = _matching(folder, entry["files"], source)
        if not paths:
            raise BadTable(f"{folder}/{entry['files']}", "matches no file", "check the folder and the name")
        for i, path in enumerate(paths):
            heard((e + i / len(paths)) / len(mapping["tables"]))
            found.take(entry, _sheet(path, entry, folder, source), source)
    joints, readings = found.joints, found.readings
    if joints and readings and not sum(len(track.stamps) for track in readings):
        raise BadTable(source, "no row has a reading", "check the columns and missing cells")
    states = of_readings.merged_joints(joints)
    tracks, signals, notes = of_readings.merged(readings), tuple(found.signals), tuple(found.notes())
    told = of_readings.merged_joints(found.commanded)
    commands = () if told is None else (told,)
    return Recording(() if states is None else (states,), tracks, signals, None, source, notes, commands=commands)


class _Found:
    """What tables hold, one after the other."""

    def __init__(self) -> None:
        self.joints: list[JointTrack] = []
        self.commanded: list[JointTrack] = []
        self.readings: list[ReadingTrack] = []
        self.signals: list[SignalTrack] = []
        self._notes: list[str] = []
        self._sockets: list[str] = []
        self._changes: list[float] = []
        self._clock = 0.0

    def take(self, entry: Mapping[str, Any], sheet: Sheet, source: str) -> None:
        """Read one table. Raises BadTable."""
        time = entry["time"]
        places = [one for key in ("pose", "point") for one in each(entry.get(key))]
        target = next((one["target"] for one in places if "target" in one), None)
        if target is not None:
            sheet, in_order = _by_target(sheet, target)
            time = time if in_order else {"order": {"period_s": _TARGET_S}}
        table = Table(sheet, frozenset(map(str, entry.get("missing_values", ()))), entry.get("missing") == "skip")
        if "zeros_missing" in entry:
            table.blank_zeros(list(entry["zeros_missing"]))
        stamps, note = stamps_of(table, time, self._clock)
        if target is not None:
            names = table.text(target)
            changes = [i for i in range(1, len(names)) if names[i] != names[i - 1]]
            self._changes += [0.5 * float(stamps[i - 1] + stamps[i]) for i in changes]
        if "joints" in entry:
            track, wanted = of_readings.joints_of(table, entry["joints"], stamps)
            self.joints.append(track)
            self.commanded += [wanted] if wanted is not None else []
        found = list(of_readings.readings_of(table, entry, stamps, source))
        self.signals += _signals(table, entry, stamps)
        table.require_sound()
        if not np.isfinite(stamps).any() or ("joints" in entry and not len(self.joints[-1].stamps)):
            raise BadTable(sheet.path.name, "has no row with time and joints", "check columns and missing cells")
        self._clock = float(np.nanmax(stamps)) + 1.0
        self._notes += [n for n in (note, *table.notes()) if n and n not in self._notes]
        self.readings += found
        self._sockets += [track.frame for track in found] if "same_point" in entry else []

    def notes(self) -> Iterator[str]:
        """Sentences that go with the recording."""
        yield from self._notes
        if self._sockets:
            yield f"{SOCKETS}{', '.join(dict.fromkeys(self._sockets))}."
        if self._changes:
            yield f"{TARGETS}{', '.join(f'{stamp:.3f}' for stamp in self._changes)}."


_TARGET_S = 10.0  # s between rows that are put in order of their targets, whose times are then lost


def _by_target(sheet: Sheet, column: Any) -> tuple[Sheet, bool]:
    """The rows in order of the target that was measured, and whether they were in such an order already."""
    names = Table(sheet).text(column)
    first = {name: i for i, name in reversed(list(enumerate(names)))}
    order = sorted(range(len(names)), key=lambda i: first[names[i]])
    rows, lines = [sheet.rows[i] for i in order], [sheet.lines[i] for i in order]
    return replace(sheet, rows=rows, lines=lines), order == list(range(len(names)))


def _sheet(path: Path, entry: Mapping[str, Any], folder: Path, source: str) -> Sheet:
    """The cells of a file with those of others beside them, in the rows that are asked for."""
    sheet = read_sheet(path, Form.stated(entry))
    for other in entry.get("joined", ()):
        sheet = joined(sheet, other, folder, source)
    return chosen(sheet, entry["rows"], source) if "rows" in entry else sheet


def _matching(folder: Path, pattern: str, source: str) -> list[Path]:
    try:
        return sorted(path for path in folder.glob(pattern) if path.is_file())
    except (ValueError, NotImplementedError, IndexError, OSError) as error:
        what = f"{shown(pattern)} is not a file pattern"
        raise BadTable(f"{source}: files", what, "give names relative to the folder, such as run_*.csv") from error


def _signals(table: Table, entry: Mapping[str, Any], stamps: np.ndarray) -> Iterator[SignalTrack]:
    """Temperatures and other signals; a cell without a number is a value that was not sent."""
    for kind, prefix in (("temperature", "temperature:"), ("signals", "signal:/")):
        for name, column in (entry.get(kind) or {}).items():
            values = table.numbers(column)
            keep = np.isfinite(values) & np.isfinite(stamps)
            topic = "/temperature" if kind == "temperature" else f"/{name}"
            yield SignalTrack(f"{prefix}{name}", stamps[keep], values[keep][:, None], topic)
