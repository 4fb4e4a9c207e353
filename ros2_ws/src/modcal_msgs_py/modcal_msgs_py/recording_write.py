"""Recordings from data sets of LeRobot, and a recording to a bag.

Data sets of LeRobot: a leader's joints beside a follower's, episode by episode, in Parquet files.

``observation.state`` is where the follower's joints were, ``action`` where the leader's were, which the follower was
told to go to. Values beyond two turns are taken for degrees; so are normalised ones, whose sizes then mean nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache, reduce
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.files import read_json
from modcal_core.geometry import Array
from modcal_core.measurements import PART, POINT, POSE, JointTrack, ReadingTrack, Recording
from modcal_msgs_py.bag_files import appearing
from modcal_msgs_py.layout import jazzy, message_class, serialise
from modcal_msgs_py.mcap_write import BagWriter
from modcal_msgs_py.readings import paths_of
from modcal_msgs_py.topics import JOINT_STATES, NOTES, READINGS, ROBOT_DESCRIPTION, TEMPERATURE, TYPES

_INFO = Path("meta") / "info.json"
_STATE, _ACTION = "observation.state", "action"
_TURNS = 4.0 * np.pi  # rad, beyond which values are degrees
_DAY = 86400.0  # s from one episode to the next, for a data set has no clock


def is_lerobot(folder: Path) -> bool:
    """Whether a folder is such a data set."""
    return (folder / _INFO).is_file()


def episodes_of(folder: Path) -> list[tuple[str, Recording]]:
    """Names and recordings of the episodes of a data set, in order. Raises BadRecording for one that cannot be used."""
    import pyarrow
    import pyarrow.parquet as parquet

    info = read_json(folder / _INFO, "copy the data set again")
    files = sorted((folder / "data").rglob("*.parquet"))
    try:
        features = info["features"]
        said = features[_STATE]["names"]
        names = [n for part in said.values() for n in part] if isinstance(said, dict) else list(said or ())
        told = features[_ACTION]["names"]
        acted = [n for part in told.values() for n in part] if isinstance(told, dict) else list(told or ())
        tables = [parquet.read_table(f, columns=[_STATE, _ACTION, "timestamp", "episode_index"]) for f in files]
        columns = pyarrow.concat_tables(tables).to_pydict()
        state, action = (np.array(columns[key], dtype=float) for key in (_STATE, _ACTION))
        if state.shape[1] != len(names) or action.shape[1] != len(acted) or set(names) - set(acted):
            raise ValueError("action and observation.state do not name the same joints")
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, pyarrow.ArrowInvalid) as error:
        said_of = f"is no data set of a leader and a follower ({type(error).__name__}: {str(error)[:80]})"
        raise BadRecording(str(folder), said_of, "give one with info.json, action and observation.state") from error
    factor = np.pi / 180.0 if np.abs(state).max(initial=0.0) > _TURNS else 1.0
    plain = tuple(str(n).removesuffix(".pos") for n in names)
    order = [acted.index(n) for n in names]
    episode, t = np.array(columns["episode_index"]), np.array(columns["timestamp"], dtype=float)
    out = []
    for k in np.unique(episode):
        rows = episode == k
        stamps = _DAY * float(k) + t[rows]
        tracks = (_track(plain, stamps, factor * x, topic) for x, topic in (
            (state[rows], "/joint_states"), (action[rows][:, order], "/leader")))  # fmt: skip
        follower, leader = tracks
        source = f"{folder.name} {int(k)}"
        out.append((source, Recording((follower,), commands=(leader,), source=source)))
    return out


def _track(names: tuple[str, ...], stamps: Array, q: Array, topic: str) -> JointTrack:
    unknown = np.full(q.shape, np.nan)
    return JointTrack(names, stamps, q, unknown, unknown, np.full(len(stamps), np.nan), topic)


_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_SIGNAL, _RANGE = "std_msgs/msg/Float64", "sensor_msgs/msg/Range"
_ORIGIN = dict(zip(paths_of(POSE, _WITH_COVARIANCE), (*[0.0] * 6, 1.0), strict=True))  # where only a point is known
_TOPIC_OF = {kind: role for role, kind in READINGS.items()}
_MANY = 500  # messages between two words of how far it is


def write_recording(recording: Recording, folder: Path, heard: Callable[[float], None] = lambda share: None) -> None:
    """Write joint states, commands, readings, temperatures, signals, description and notes of a recording as a bag.

    The folder appears at once and whole, or not at all. heard: is told the share that is written. Signals of messages
    with one number are written. Raises BadRecording when the folder exists already, or cannot be written.
    """
    with appearing(folder) as stage:
        try:
            _write(recording, stage, heard)
        except BadRecording as error:  # of a disk that refuses; nothing is left for a repair
            raise BadRecording(str(folder), error.limit, "make room on the disk, or write elsewhere") from error


def _write(recording: Recording, folder: Path, heard: Callable[[float], None]) -> None:
    count = sum(len(t.stamps) for tracks in (recording.joints, recording.readings, recording.signals) for t in tracks)
    stamped = []
    for message in _messages(recording):
        stamped.append(message)
        if len(stamped) % _MANY == 0:
            heard(0.5 * len(stamped) / max(count, len(stamped)))
    stamped.sort(key=lambda m: m[0])
    start = stamped[0][0] if stamped else 0
    with BagWriter(folder) as bag:
        texts = [] if recording.robot_description is None else [(ROBOT_DESCRIPTION, recording.robot_description)]
        for role, text in (*texts, *((NOTES, note) for note in recording.warnings)):
            bag.write(f"/{role}", TYPES[role], message_class(TYPES[role])(data=text), start)
        for i, (stamp, topic, type_name, cdr) in enumerate(stamped):
            bag.add_topic(topic, type_name)
            bag.write_raw(topic, cdr, stamp)
            if i % _MANY == 0:
                heard(0.5 * (1.0 + i / len(stamped)))


_Message = tuple[int, str, str, bytes]  # time [ns], topic, type, CDR bytes


def _messages(recording: Recording) -> Iterator[_Message]:
    """Everything but texts."""
    states = ((f"/{JOINT_STATES}", track) for track in recording.joints)
    for topic, track in (*states, *((track.topic, track) for track in recording.commands)):
        for i, stamp in enumerate(track.stamps):
            velocity, effort = (
                row if np.isfinite(row).all() else row[:0] for row in (track.velocity[i], track.effort[i])
            )
            values = {"name": list(track.names), "position": track.position[i], "velocity": velocity, "effort": effort}
            yield _message(stamp, topic, TYPES[JOINT_STATES], "", values)
    for reading in recording.readings:  # a topic has one type
        own = any(r.stated is not None for r in recording.readings if r.kind == reading.kind)
        yield from _readings(reading, own and reading.kind in (POSE, POINT))
    for signal in recording.signals:
        role, _, name = signal.name.partition(":")
        for stamp, value in zip(signal.stamps.tolist(), signal.values[:, 0].tolist(), strict=True):
            if role == TEMPERATURE:
                yield _message(stamp, f"/{TEMPERATURE}", TYPES[TEMPERATURE], name, {"temperature": value})
            elif PART not in name:  # what was one of many numbers of a message of another type is not made up again
                yield _message(stamp, name, _SIGNAL, None, {"data": value})


def _readings(reading: ReadingTrack, with_covariance: bool) -> Iterator[_Message]:
    role = _TOPIC_OF[reading.kind]
    type_name = _WITH_COVARIANCE if with_covariance else TYPES[role]
    paths = paths_of(reading.kind, type_name)
    for i, (stamp, row) in enumerate(zip(reading.stamps, reading.values.tolist(), strict=True)):
        values: dict[str, Any] = dict(zip(paths, row, strict=True))
        if with_covariance:
            # RMS over space of position [m] and angle [rad], spread evenly over the axes; zeros where it is unknown
            own = np.zeros(2) if reading.stated is None else np.nan_to_num(reading.stated[i], posinf=0.0)
            values = {**_ORIGIN, **values, "pose/covariance": np.diag(np.repeat(own**2 / 3.0, 3)).ravel()}
        elif type_name == _RANGE:
            values["radiation_type"] = 1  # infrared: of a gauge nothing is known, and the message has no type for one
        yield _message(stamp, f"/{role}", type_name, reading.frame, values)


def _message(stamp: float, topic: str, type_name: str, frame: str | None, values: Mapping[str, Any]) -> _Message:
    """A message with these values at their paths, and zeros elsewhere. frame: None where there is no header."""
    ns = round(stamp * 1e6) * 1000  # seconds as a float are exact to a fifth of a microsecond
    if frame is not None:
        values = {
            "header/stamp/sec": ns // 10**9,
            "header/stamp/nanosec": ns % 10**9,
            "header/frame_id": frame,
            **values,
        }
    for path, value in values.items():
        owner, name = _field(type_name, path)
        setattr(owner, name, np.ascontiguousarray(value) if isinstance(value, np.ndarray) else value)
    return ns, topic, type_name, serialise(_blank(type_name), type_name)


@cache
def _field(type_name: str, path: str) -> tuple[Any, str]:
    """The part of the message of this type that is filled again and again which has a field, and the field's name."""
    *way, name = path.split("/")
    return reduce(getattr, way, _blank(type_name)), name


@cache
def _blank(type_name: str) -> Any:
    """A message of zeros, whose parts are its own."""
    described = jazzy().fielddefs[type_name][1]
    return message_class(type_name)(**{name: _zero(what) for name, what in described})


def _zero(described: Any) -> Any:
    node, what = described
    if node.name == "NAME":
        return _blank.__wrapped__(what)
    if node.name == "BASE":
        return "" if what[0] == "string" else 0.0 if what[0].startswith("float") else 0
    return np.zeros(what[1] if node.name == "ARRAY" else 0)
