"""What a user gives as a file: a calibration, a cell, a Delta."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
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
from modcal_core.errors import BadTable, refusing
from modcal_core.files import read_yaml
from modcal_core.geometry import Array, se3
from modcal_core.measurements.kinds import frame_on_plane
from modcal_core.report import Particulars
from modcal_core.robots import Delta, delta_from_data
from modcal_core.schema import NUMBER, TEXT, list_of, record, require
from modcal_msgs_py import Topics, calibration_data

if TYPE_CHECKING:
    from modcal_core.modules import Assembly, Library

_TEXT = {"type": "string", "minLength": 1}
_WHAT = {"type": "string", "enum": list(WHATS)}
_VECTOR = list_of(NUMBER, 3, 3)
_POSE = {"position_m": _VECTOR, "quaternion": list_of(NUMBER, 4, 4)}
_SPREAD = {"std_m": NUMBER, "std_deg": NUMBER}
_DISTANCE = {"distance_m": NUMBER, "std_m": NUMBER}
# Names of the options of the command line, and what they state
STATEMENTS = {
    "repeatability_mm": "repeatability_mm",
    "repeatability_deg": "repeatability_deg",
    "repeatability_iso": "repeatability_iso_mm",
    "instrument_mm": "instrument_mm",
    "instrument_deg": "instrument_deg",
}
_OPTIONAL = {  # or nothing
    "distances": list_of(
        {
            "type": "object",
            "oneOf": [
                record(("between", "distance_m"), between=list_of(TEXT, 2, 2), **_DISTANCE),
                record(("stamps", "distance_m"), stamps=list_of(NUMBER, 2, 2), **_DISTANCE),
            ],
        }
    ),
    **dict.fromkeys(("fixed", "own_target", "sockets", "ignore"), list_of(TEXT)),
    "known": list_of(
        record(
            ("frame", "in"),
            plane=record(("normal", "offset_m"), normal=_VECTOR, offset_m=NUMBER),
            **{"frame": _TEXT, "in": _TEXT, **_POSE, **_SPREAD},
        )
    ),
    "tool": record(("position_m", "std_m"), **_POSE, **_SPREAD),
    "payloads": list_of(record(("mass_kg",), mass_kg=NUMBER, centre_m=_VECTOR)),
    "gravity": _VECTOR,
    "moved": list_of(record(("stamp", "what"), stamp=NUMBER, what=_WHAT)),
    "topics": {"type": "object", "additionalProperties": {"type": ["string", "array"], "items": _TEXT}},
    "tf": TEXT,
    "certificate": record(**{field.name: _TEXT for field in fields(Particulars)}),
}
SCHEMA = record(
    own_in_recordings=_WHAT,
    **dict.fromkeys(STATEMENTS, NUMBER),
    **{name: {**schema, "type": [schema["type"], "null"]} for name, schema in _OPTIONAL.items()},
)
_MIN_STD = 1e-7  # m, deg; what is stated better is stated as fixed
_MAX_KG, _FARTHEST_M = 5000.0, 10.0  # the heaviest arms carry less than they weigh, which is three tonnes
_REMEDY = "see docs/calibration.md and docs/instruments.md"
_OF_CELL = re.compile("cell file|known distance|frame '.*', known in")  # what a cell file alone can state


def read_calibration(path: Path) -> Calibration:
    """The calibration in a file, or in the folder that ``modcal calibrate`` wrote."""
    return Calibration.load(path)


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
    return _cell(_read_cell(path), fixed, stated, str(path))


@refusing
def _cell(data: Mapping[str, Any], fixed: tuple[str, ...], stated: Stated, source: str) -> Cell:
    """What the data of a cell file says; as :func:`read_cell`."""
    distances = tuple(map(_distance, data.get("distances") or ()))
    for distance in distances:
        if not (0.0 < distance.distance < 50.0 and 0.0 < distance.std < 1.0):
            ends = distance.between if isinstance(distance, Distance) else map(str, distance.stamps)
            said = f"{distance.distance:g} ± {distance.std:g} m, 0 to 50 m is allowed"
            raise BadTable(f"{source}: distance {' to '.join(ends)}", said, "give metres")
    moved = (Move(float(m["stamp"]), m["what"]) for m in data.get("moved") or ())
    return Cell(
        distances,
        (*(data.get("fixed") or ()), *fixed),
        tuple(map(_known, data.get("known") or ())),
        tuple(data.get("own_target") or ()),
        stated.over(stated_from(data)),
        tuple(data.get("sockets") or ()),
        tuple(sorted(moved, key=lambda move: move.at)),
        data.get("own_in_recordings"),
        None if data.get("tool") is None else _tool(data["tool"]),
        None if data.get("gravity") is None else _gravity(data["gravity"]),
        payloads=tuple(map(_payload, data.get("payloads") or ())),
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


def _distance(data: Mapping[str, Any]) -> AnyDistance:
    distance, std = float(data["distance_m"]), float(data.get("std_m", 5e-5))
    if "stamps" in data:
        first, second = data["stamps"]
        return StationDistance((float(first), float(second)), distance, std)
    return Distance(tuple(data["between"]), distance, std)


def _gravity(data: Any) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in data)
    if not 0.0 < np.linalg.norm([x, y, z]) < np.inf:
        raise ValueError("a direction has a length")
    return x, y, z


def _payload(data: Mapping[str, Any]) -> StatedPayload:
    x, y, z = (float(v) for v in data.get("centre_m", (0.0, 0.0, 0.0)))
    mass = float(data["mass_kg"])
    if not (0.0 <= mass <= _MAX_KG and np.abs([x, y, z]).max() <= _FARTHEST_M):
        raise ValueError(f"0 to {_MAX_KG:g} kg within {_FARTHEST_M:g} m of the tip are allowed")
    return StatedPayload(mass, (x, y, z))


def _tool(data: Mapping[str, Any]) -> StatedTool:
    if ("quaternion" in data) != ("std_deg" in data):
        raise ValueError("an orientation needs quaternion and std_deg, both")
    std_m, std_rad = _deviations({"std_deg": np.inf, **data})
    return StatedTool(_pose(data), std_m, std_rad)


def _deviations(data: Mapping[str, Any]) -> tuple[float, float]:
    """Deviations [m, rad] that are stated as std_m and std_deg."""
    std_m, std_deg = float(data["std_m"]), float(data["std_deg"])
    if not (_MIN_STD <= std_m < 1.0 and std_deg >= _MIN_STD):
        raise ValueError(f"std_m from {_MIN_STD:g} to 1 m and std_deg from {_MIN_STD:g} are allowed")
    return std_m, float(np.radians(std_deg))


def _pose(data: Mapping[str, Any]) -> Array:
    """The transform (4, 4) of position_m and quaternion."""
    pose = np.array([*data.get("position_m", (0.0, 0.0, 0.0)), *data.get("quaternion", (0.0, 0.0, 0.0, 1.0))], float)
    if not 0.99 < float(np.linalg.norm(pose[3:])) < 1.01:
        raise ValueError("a quaternion has length one")
    return se3.from_pose(pose)


def _known(data: Mapping[str, Any]) -> Known:
    """A frame in another: its plane, its pose, or, for the same plane, nothing."""
    frame, to = data["frame"], data["in"]
    if "plane" in data:
        normal = np.array(data["plane"]["normal"], float)
        if not 0.99 < float(np.linalg.norm(normal)) < 1.01:
            raise ValueError("a normal has length one")
        return Known(frame, to, frame_on_plane(normal, float(data["plane"]["offset_m"])))
    std: tuple[float, float] | None = None
    if "std_m" in data or "std_deg" in data:
        if to != "base" or not {"std_m", "std_deg"} <= set(data):
            raise ValueError("std_m and std_deg go together, of a frame in the base")
        std = _deviations(data)
    return Known(frame, to, se3.inverse(_pose(data)), std)


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
