"""What a user gives as a file: a calibration, a cell, a Delta."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

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
    What,
    from_data,
    together_stated,
)
from modcal_core.errors import BadRecording, BadTable, about
from modcal_core.files import read_yaml
from modcal_core.geometry import Array, se3
from modcal_core.measurements import Samples, Schema, after, between, require, require_new, shown, together, told
from modcal_core.measurements.kinds import frame_on_plane
from modcal_core.public import calibrate, tolerance_asked
from modcal_core.report import Particulars
from modcal_core.result import Result
from modcal_core.robot import Robot
from modcal_core.robots import Delta, delta_from_data
from modcal_msgs_py import Bag, Topics, calibration_data, read_bag
from modcal_nodes.cli import described
from modcal_nodes.io.options import Options, Watch, silent

if TYPE_CHECKING:
    from modcal_core.modules import Assembly, Library


_NUMBER = {"type": "number"}
_TEXT = {"type": "string", "minLength": 1}
_TEXTS = {"type": ["array", "null"], "items": {"type": "string"}}
_WHAT = {"type": "string", "enum": list(WHATS)}
_THREE = {"type": "array", "items": _NUMBER, "minItems": 3, "maxItems": 3}


def _mapping(properties: Schema, *required: str) -> Schema:
    return {"type": "object", "properties": properties, "required": list(required), "additionalProperties": False}


def _list(items: Schema) -> Schema:
    return {"type": ["array", "null"], "items": items}


_PAIR = {"type": "array", "items": {"type": "string"}, "minItems": 2, "maxItems": 2}
_STAMPS = {"type": "array", "items": _NUMBER, "minItems": 2, "maxItems": 2}
_DISTANCE = {"distance_m": _NUMBER, "std_m": _NUMBER}
_PLANE = _mapping({"normal": _THREE, "offset_m": _NUMBER}, "normal", "offset_m")
_QUATERNION = {"type": "array", "items": _NUMBER, "minItems": 4, "maxItems": 4}
_POSE = {"position_m": _THREE, "quaternion": _QUATERNION}
SCHEMA = _mapping(
    {
        "distances": _list(
            {
                "type": "object",
                "oneOf": [
                    _mapping({"between": _PAIR, **_DISTANCE}, "between", "distance_m"),
                    _mapping({"stamps": _STAMPS, **_DISTANCE}, "stamps", "distance_m"),
                ],
            }
        ),
        "fixed": _TEXTS,
        "own_target": _TEXTS,
        "sockets": _TEXTS,
        "known": _list(
            _mapping(
                {"frame": _TEXT, "in": _TEXT, "plane": _PLANE, **_POSE, "std_m": _NUMBER, "std_deg": _NUMBER},
                "frame",
                "in",
            )
        ),
        "tool": {
            **_mapping({**_POSE, "std_m": _NUMBER, "std_deg": _NUMBER}, "position_m", "std_m"),
            "type": ["object", "null"],
        },
        "payloads": _list(_mapping({"mass_kg": _NUMBER, "centre_m": _THREE}, "mass_kg")),
        "gravity": {**_THREE, "type": ["array", "null"]},
        "moved": _list(_mapping({"stamp": _NUMBER, "what": _WHAT}, "stamp", "what")),
        "own_in_recordings": {**_WHAT, "type": ["string"]},
        "repeatability_mm": _NUMBER,
        "repeatability_deg": _NUMBER,
        "repeatability_iso": _NUMBER,
        "instrument_mm": _NUMBER,
        "instrument_deg": _NUMBER,
        "topics": {"type": ["object", "null"], "additionalProperties": {"type": ["string", "array"], "items": _TEXT}},
        "ignore": _TEXTS,
        "tf": {"type": ["string", "null"]},
        "certificate": {**_mapping({field.name: _TEXT for field in fields(Particulars)}), "type": ["object", "null"]},
    }
)


T = TypeVar("T")
# Names of the options of the command line, and what they state
STATEMENTS = {
    "repeatability_mm": "repeatability_mm",
    "repeatability_deg": "repeatability_deg",
    "repeatability_iso": "repeatability_iso_mm",
    "instrument_mm": "instrument_mm",
    "instrument_deg": "instrument_deg",
}
_MIN_STD = 1e-7  # m, deg; what is stated better is stated as fixed
_MAX_KG, _FARTHEST_M = 5000.0, 10.0  # the heaviest arms carry less than they weigh, which is three tonnes
_REMEDY = "see docs/calibration.md and docs/instruments.md"
_OF_CELL = re.compile("cell file|known distance|frame '.*', known in")  # what a cell file alone can state
_AS_DISTANCE = "{between: [a, b], distance_m: 0.05}, or {stamps: [t1, t2], distance_m: 0.05}"
_AS_STATED = "a number, e.g. repeatability_mm: 0.02"
_AS_MOVED = "{stamp: 1700000000.5, what: tool}, or what: base, or both"
_AS_PAYLOAD = "{mass_kg: 2.5, centre_m: [0, 0, 0.05]}, in the tip link"
_AS_GRAVITY = "[0, 0, -9.81], in the base link"
_AS_TOOL = "{position_m: [0, 0, 0.055], std_m: 0.001}, and with orientation quaternion and std_deg"
_AS_KNOWN = "{frame: a, in: b, plane: {normal: [0, 0, 1], offset_m: 0.1}}, or with position_m and quaternion"


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
    data = _read_cell(path)
    distances = tuple(_part(path, _distance, "distances", d, _AS_DISTANCE) for d in data.get("distances") or ())
    for distance in distances:
        if not (0.0 < distance.distance < 50.0 and 0.0 < distance.std < 1.0):
            ends = distance.between if isinstance(distance, Distance) else map(str, distance.stamps)
            raise BadTable(
                f"{path}: distance {' to '.join(ends)}",
                f"{distance.distance:g} ± {distance.std:g} m, 0 to 50 m is allowed",
                "give metres",
            )
    own = data.get("own_in_recordings")
    return Cell(
        distances,
        (*(str(f) for f in data.get("fixed") or ()), *fixed),
        tuple(_part(path, _known, "known", k, _AS_KNOWN) for k in data.get("known") or ()),
        tuple(str(f) for f in data.get("own_target") or ()),
        stated.over(_part(path, stated_from, "repeatability and instrument", data, _AS_STATED)),
        tuple(str(f) for f in data.get("sockets") or ()),
        tuple(sorted((_part(path, _move, "moved", m, _AS_MOVED) for m in data.get("moved") or ()), key=lambda m: m.at)),
        None if own is None else _part(path, _what, "own_in_recordings", own, ", ".join(WHATS)),
        None if data.get("tool") is None else _part(path, _tool, "tool", data["tool"], _AS_TOOL),
        None if data.get("gravity") is None else _part(path, _gravity, "gravity", data["gravity"], _AS_GRAVITY),
        payloads=tuple(_part(path, _payload, "payloads", p, _AS_PAYLOAD) for p in data.get("payloads") or ()),
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


def _part(path: Path, read: Callable[[Any], T], what: str, data: Any, expected: str) -> T:
    try:
        return read(data)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise BadTable(f"{path}: {what}", f"{shown(data)} is not {expected}: {told(error)}", _REMEDY) from error


def _move(data: Mapping[str, Any]) -> Move:
    return Move(float(data["stamp"]), _what(data["what"]))


def _what(said: Any) -> What:
    for what in WHATS:
        if said == what:
            return what
    raise ValueError(f"{said!r} is not one of {', '.join(WHATS)}")


def _distance(data: Mapping[str, Any]) -> AnyDistance:
    distance, std = float(data["distance_m"]), float(data.get("std_m", 5e-5))
    if "stamps" in data:
        first, second = (float(t) for t in data["stamps"])
        return StationDistance((first, second), distance, std)
    return Distance((str(data["between"][0]), str(data["between"][1])), distance, std)


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
    pose = [*data.get("position_m", (0.0, 0.0, 0.0)), *data.get("quaternion", (0.0, 0.0, 0.0, 1.0))]
    values = np.array([float(x) for x in pose])
    if values.shape != (7,) or not 0.99 < float(np.linalg.norm(values[3:])) < 1.01:
        raise ValueError("a position has three numbers, a quaternion four and length one")
    return se3.from_pose(values)


def _known(data: Mapping[str, Any]) -> Known:
    """A frame in another: its plane, its pose, or, for the same plane, nothing."""
    extra = set(data) - {"frame", "in", "plane", "position_m", "quaternion", "std_m", "std_deg"}
    if extra:
        raise ValueError(f"unknown {', '.join(sorted(extra))}")
    frame, to = str(data["frame"]), str(data["in"])
    if "plane" in data:
        normal = np.array([float(x) for x in data["plane"]["normal"]])
        if normal.shape != (3,) or not 0.99 < float(np.linalg.norm(normal)) < 1.01:
            raise ValueError("a normal has three numbers and length one")
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


@dataclass(frozen=True)
class Calibrated:
    """A result, and names and texts of the files it leaves behind."""

    result: Result
    files: dict[str, str]


def calibrate_bag(bag: Path, options: Options, more: tuple[Path, ...] = (), watch: Watch = silent) -> Calibrated:
    """The calibration of the arm in a bag, and in more bags of its cell. Raises ModcalError for unusable ones.

    watch: called with the name of each stage.
    """
    tolerance_asked(options.tolerance_mm, options.tolerance_of)
    cell = read_cell(options.cell_file, options.fixed, stated_from(asdict(options)))
    factory = None if options.factory_kinematics is None else read_yaml(options.factory_kinematics)
    topics = read_topics(options.cell_file, options.topics)
    first = opened(bag, watch, topics)
    robot = described(first.recording, options.delta, options.urdf, options.base, options.tip)
    samples = first.samples(robot, options.clock_limit)
    for at in first.recording.tool_changes:
        cell = cell.with_move(Move(at, "tool"))
    for other in more:
        with about(str(other)):
            added = opened(other, watch, topics).samples(robot, options.clock_limit)
        samples, cell = _with(samples, cell, added, other.name)
    with of_cell(options.cell_file):
        result = calibrate(
            robot,
            samples,
            options.seed,
            cell=cell,
            geometry_only=options.geometry_only,
            block=options.block,
            tolerance_mm=options.tolerance_mm,
            tolerance_of=options.tolerance_of,
            progress=watch,
        )
    if options.by_distances:
        watch("fitting distances alone")
        result = result.with_distances(options.seed)
    watch("writing the report")
    with about(str(options.factory_kinematics)) if factory is not None else nullcontext():
        return Calibrated(result, result.files(factory))


def opened(bag: Path, watch: Watch = silent, topics: Topics | None = None) -> Bag:
    """A bag, the watch being told how far it has been read."""
    return read_bag(bag, topics or Topics(), heard=lambda share: watch(f"reading {bag.name}", share))


def of_calibrated(recorded: Bag, frozen: Calibration, clock_limit: float) -> Samples:
    """The samples of a bag for the arm of a frozen calibration, which knows its base, its tip and its joints. Raises
    BadRecording, for a bag without these joints with the remedy of one who states no robot.
    """
    chain = frozen.nominal.chain
    try:
        return recorded.samples(Robot(chain), clock_limit)
    except BadRecording as error:
        missing = [name for name in chain.names if name not in recorded.joints]
        if not missing or not recorded.joints:
            raise
        raise BadRecording(
            f"joint {', '.join(missing)} of the calibration",
            f"not among the joint states ({', '.join(sorted(recorded.joints))})",
            f"give a recording of the arm that was calibrated ({chain.base} → {chain.tip}), its joints named as then",
        ) from error


def _with(samples: Samples, cell: Cell, added: Samples, name: str) -> tuple[Samples, Cell]:
    """The samples with those of another bag of the same cell behind them, and the cell with what moved between."""
    require_new(added, samples, name)
    later, late = after(added, samples)
    one, two = samples.origin, added.origin
    notes = (*one.notes, *two.notes)
    if late:
        notes = (
            *notes,
            f"{name} overlaps the recordings before it in time: its stamps were shifted {late:.1f} s later.",
        )
    moment = between(samples, later)
    cell = replace(cell, between=tuple(sorted((*cell.between, moment))))
    if cell.own_in_recordings:
        cell = cell.with_move(Move(moment, cell.own_in_recordings))
    stated = together_stated(
        [Stated(instrument_mm=o.instrument_mm, instrument_deg=o.instrument_deg) for o in (one, two)]
    )
    origin = replace(
        one,
        notes=notes,
        dropped=together([one.dropped, two.dropped]),
        doubts=(*one.doubts, *two.doubts),
        instrument_mm=stated.instrument_mm,
        instrument_deg=stated.instrument_deg,
    )
    return replace(samples.followed_by(later), origin=origin), cell
