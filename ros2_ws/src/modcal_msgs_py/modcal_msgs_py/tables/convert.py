"""Tables of measurements to a recording: a small mapping says which column is what, and in which unit.

Nothing is guessed: a unit or an angle convention that the mapping does not state is an error. Every row becomes one
joint state and one reading with the same stamp, that is a finished station; a table may also hold joints alone, or
readings alone, on the same clock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.measurements import SOCKETS, JointTrack, ReadingTrack, Recording, SignalTrack, shown
from modcal_msgs_py.tables import joints as of_joints
from modcal_msgs_py.tables import readings as of_readings
from modcal_msgs_py.tables.moments import stamps_of
from modcal_msgs_py.tables.schema import require_mapping
from modcal_msgs_py.tables.sheet import Form, read_sheet
from modcal_msgs_py.tables.table import Faults, Table, join


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
                track, wanted = of_joints.joints_of(table, entry["joints"], stamps)
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
    states = of_joints.merged(joints)
    recording = Recording(
        () if states is None else (states,), of_readings.merged(readings), tuple(signals), None, source, tuple(notes)
    )
    return Tables(recording, of_joints.merged(commanded))


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
