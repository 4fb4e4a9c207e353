"""What a user gives as a file: a calibration, a cell, a Delta."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.calibration import (
    WHATS,
    AnyDistance,
    Calibration,
    Cell,
    Distance,
    Known,
    Move,
    Stated,
    StatedPayload,
    StatedTool,
    StationDistance,
    from_data,
)
from modcal_core.errors import BadTable
from modcal_core.files import read_yaml
from modcal_core.geometry import Array, se3
from modcal_core.measurements.kinds import frame_on_plane
from modcal_core.report import Particulars
from modcal_core.robots import Delta, delta_from_data
from modcal_core.schema import NUMBER, POSITIVE, TEXT, Schema, list_of, record, require
from modcal_msgs_py import Topics, calibration_data

if TYPE_CHECKING:
    from modcal_core.modules import Assembly, Library

_MIN_STD = 1e-7  # m, deg; what is stated better is stated as fixed
_MAX_KG, _FARTHEST_M = 5000.0, 10.0  # the heaviest arms carry less than they weigh, which is three tonnes
_UNIT = 0.01  # by which the length of a normal or a quaternion may be off
_REMEDY = "see docs/calibration.md and docs/instruments.md"
_OF_CELL = re.compile("cell file|known distance|frame '.*', known in")  # what a cell file alone can state
# Names of the options of the command line, and what they state
STATEMENTS = {
    "repeatability_mm": "repeatability_mm",
    "repeatability_deg": "repeatability_deg",
    "repeatability_iso": "repeatability_iso_mm",
    "instrument_mm": "instrument_mm",
    "instrument_deg": "instrument_deg",
}
_TEXT: Schema = {"type": "string", "minLength": 1}
_WHAT: Schema = {"type": "string", "enum": list(WHATS)}
_THREE = list_of(NUMBER, 3, 3)
_POSE = {"position_m": _THREE, "quaternion": list_of(NUMBER, 4, 4)}
_STD_M: Schema = {"type": "number", "minimum": _MIN_STD, "maximum": 1.0}
_STD = {"std_m": _STD_M, "std_deg": {"type": "number", "minimum": _MIN_STD}}
_DISTANCE = {"distance_m": {**POSITIVE, "maximum": 50.0}, "std_m": {**POSITIVE, "maximum": 1.0}}
_FAR: Schema = {"type": "number", "minimum": -_FARTHEST_M, "maximum": _FARTHEST_M}
_PLANE = record(("normal", "offset_m"), normal=_THREE, offset_m=NUMBER)


def _or_null(schema: Schema) -> Schema:
    return {**schema, "type": [schema["type"], "null"]}


_TEXTS = _or_null(list_of(TEXT))
_TOPICS: Schema = {"type": "object", "additionalProperties": {"type": ["string", "array"], "items": _TEXT}}
SCHEMA = record(
    distances=_or_null(
        list_of(
            {
                "type": "object",
                "oneOf": [
                    record(("between", "distance_m"), between=list_of(TEXT, 2, 2), **_DISTANCE),
                    record(("stamps", "distance_m"), stamps=list_of(NUMBER, 2, 2), **_DISTANCE),
                ],
            }
        )
    ),
    fixed=_TEXTS,
    own_target=_TEXTS,
    sockets=_TEXTS,
    known=_or_null(list_of(record(("frame", "in"), frame=_TEXT, plane=_PLANE, **{"in": _TEXT}, **_POSE, **_STD))),
    tool=_or_null(record(("position_m", "std_m"), **_POSE, **_STD)),
    payloads=_or_null(
        list_of(
            record(
                ("mass_kg",),
                mass_kg={"type": "number", "minimum": 0.0, "maximum": _MAX_KG},
                centre_m=list_of(_FAR, 3, 3),
            )
        )
    ),
    gravity=_or_null(_THREE),
    moved=_or_null(list_of(record(("stamp", "what"), stamp=NUMBER, what=_WHAT))),
    own_in_recordings=_WHAT,
    **dict.fromkeys(STATEMENTS, NUMBER),
    topics=_or_null(_TOPICS),
    ignore=_TEXTS,
    tf=_or_null(TEXT),
    certificate=_or_null(record(**{field.name: _TEXT for field in fields(Particulars)})),
)


def calibration_of(message: Any, source: str) -> Calibration:
    """The calibration in a message of modcal_interfaces; raises BadTable or BadCommand, naming the source."""
    return from_data(calibration_data(message), source)


def read_delta(path: Path) -> Delta:
    """The Delta that a YAML file describes; raises BadTable or BadRobot."""
    return delta_from_data(read_yaml(path), str(path))


def read_cell(path: Path | None, fixed: tuple[str, ...] = (), stated: Stated | None = None) -> Cell:
    """What a cell file says, with these parameters held fixed besides. No path: an empty cell.

    stated: of arm and instrument, in place of what the file states of the same.
    """
    stated = stated or Stated()
    if path is None:
        return Cell(fixed=fixed, stated=stated)
    data = _read_cell(path)
    own, gravity = data.get("own_in_recordings"), data.get("gravity")
    moved = sorted((Move(float(m["stamp"]), m["what"]) for m in data.get("moved") or ()), key=lambda m: m.at)
    if gravity is not None and not any(gravity):
        raise BadTable(f"{path}: gravity", "has no length", "give a direction in the base link, e.g. [0, 0, -9.81]")
    return Cell(
        tuple(_distance(d) for d in data.get("distances") or ()),
        (*(data.get("fixed") or ()), *fixed),
        tuple(_known(k, f"{path}: known: {k['frame']}") for k in data.get("known") or ()),
        tuple(data.get("own_target") or ()),
        stated.over(stated_from(data)),
        tuple(data.get("sockets") or ()),
        tuple(moved),
        own,
        None if data.get("tool") is None else _tool(data["tool"], f"{path}: tool"),
        None if gravity is None else _three(gravity),
        payloads=tuple(
            StatedPayload(float(p["mass_kg"]), _three(p.get("centre_m", (0.0, 0.0, 0.0))))
            for p in data.get("payloads") or ()
        ),
    )


def read_particulars(path: Path | None) -> Particulars:
    """What a cell file states for a certificate; nothing without a file. Raises BadTable."""
    data = {} if path is None else _read_cell(path)
    return Particulars(**{name: str(text) for name, text in (data.get("certificate") or {}).items()})


def read_topics(path: Path | None, said: Topics) -> Topics:
    """Topics by role: those given, and those of the cell file for all other roles. Raises BadTable."""
    if path is None:
        return said
    data = _read_cell(path)
    pairs = [
        f"{role}={name}"
        for role, names in (data.get("topics") or {}).items()
        for name in (names if isinstance(names, list) else [names])
    ]
    return said.over(Topics.of(pairs, data.get("ignore") or (), data.get("tf")))


@contextmanager
def of_cell(path: Path | None) -> Iterator[None]:
    """Refusals from within of what a cell file states name the file."""
    try:
        yield
    except BadTable as error:
        if path is None or not _OF_CELL.match(error.offender):
            raise
        offender = f"{path}: {error.offender}".replace(": cell file", "")
        raise BadTable(offender, error.limit, error.remedy) from error


def _read_cell(path: Path) -> Mapping[str, Any]:
    """What a cell file says, checked; nothing of an empty one."""
    data = read_yaml(path)
    data = {} if data is None else data
    require(data, SCHEMA, str(path), _REMEDY)
    return data


def stated_from(data: Mapping[str, Any]) -> Stated:
    """What these options, or keys of a cell file, state of arm and instrument. Raises BadTable for what cannot be."""
    values = {field: data.get(name) for name, field in STATEMENTS.items()}
    return Stated(**{field: None if value is None else float(value) for field, value in values.items()})


def _three(data: Sequence[Any]) -> tuple[float, float, float]:
    x, y, z = map(float, data)
    return x, y, z


def _distance(data: Mapping[str, Any]) -> AnyDistance:
    distance, std = float(data["distance_m"]), float(data.get("std_m", 5e-5))
    if "stamps" in data:
        first, second = map(float, data["stamps"])
        return StationDistance((first, second), distance, std)
    first, second = data["between"]
    return Distance((first, second), distance, std)


def _tool(data: Mapping[str, Any], where: str) -> StatedTool:
    if ("quaternion" in data) != ("std_deg" in data):
        raise BadTable(where, "states half of an orientation", "state quaternion and std_deg, or none of them")
    return StatedTool(_pose(data, where), *_deviations({"std_deg": np.inf, **data}))


def _deviations(data: Mapping[str, Any]) -> tuple[float, float]:
    """Deviations [m, rad] that are stated as std_m and std_deg."""
    return float(data["std_m"]), float(np.radians(data["std_deg"]))


def _unit(data: Sequence[Any], what: str, where: str) -> Array:
    values = np.array(data, dtype=float)
    if not abs(np.linalg.norm(values) - 1.0) < _UNIT:
        raise BadTable(where, f"its {what} has length {np.linalg.norm(values):.4g}", "give one of length one")
    return values


def _pose(data: Mapping[str, Any], where: str) -> Array:
    """The transform (4, 4) of position_m and quaternion."""
    turn = _unit(data.get("quaternion", (0.0, 0.0, 0.0, 1.0)), "quaternion", where)
    return se3.from_pose(np.r_[_three(data.get("position_m", (0.0, 0.0, 0.0))), turn])


def _known(data: Mapping[str, Any], where: str) -> Known:
    """A frame in another: its plane, its pose, or, for the same plane, nothing."""
    frame, to = data["frame"], data["in"]
    if "plane" in data:
        normal = _unit(data["plane"]["normal"], "normal", where)
        return Known(frame, to, frame_on_plane(normal, float(data["plane"]["offset_m"])))
    deviations = {"std_m", "std_deg"} & set(data)
    if deviations and (to != "base" or len(deviations) < 2):
        raise BadTable(where, f"states {' and '.join(sorted(deviations))}", "state both, of a frame in the base")
    return Known(frame, to, se3.inverse(_pose(data, where)), _deviations(data) if deviations else None)


def read_library(path: Path | None) -> Library:
    """The library in a file; the published one where none is given."""
    from modcal_core.modules import library_from_data, published

    return published() if path is None else library_from_data(read_yaml(path), str(path))


def read_assembly(spec: Path, library_file: Path | None = None) -> tuple[Assembly, Library]:
    """The assembly in a file and its library: the one given, or else the one the file names, or the published one."""
    from modcal_core.modules import assembly_from_data

    data = read_yaml(spec)
    if library_file is None and isinstance(data, Mapping) and data.get("library") is not None:
        library_file = spec.parent / str(data["library"])
        if not library_file.is_file():
            raise BadTable(f"{spec}: library {data['library']}", "is not beside it", "correct the path")
    library = read_library(library_file)
    return assembly_from_data(data, library, str(spec)), library
