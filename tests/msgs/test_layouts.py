"""Quick ways to read: messages many at once, rows of tracks that grow; each as one by one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType
from msgs import bag_forms as forms

from modcal_core.measurements.recording import Recording
from modcal_msgs_py import layout as fields
from modcal_msgs_py.layout import MessageLayout, OneMessage, jazzy, message_class, serialise
from modcal_msgs_py.mcap_read import _of_own_layout, read_recording
from modcal_msgs_py.messages import RecordingBuilder
from modcal_msgs_py.topics import WRENCH, role_of
from modcal_msgs_py.track_rows import TrackRows

Message = tuple[str, str, Any]
TYPES = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/joint_commands": "sensor_msgs/msg/JointState",
    "/arm/joint_commands": "trajectory_msgs/msg/JointTrajectory",
    "/tracker/pose": "geometry_msgs/msg/PoseStamped",
    "/tracker/point": "geometry_msgs/msg/PointStamped",
    "/tracker/range": "sensor_msgs/msg/Range",
    "/tracker/bearing": "geometry_msgs/msg/Vector3Stamped",
    "/temperature": "sensor_msgs/msg/Temperature",
    "/wrench": "geometry_msgs/msg/WrenchStamped",
    "/battery": "sensor_msgs/msg/BatteryState",  # texts, arrays, an array of no fixed length
    "/grid": "nav_msgs/msg/MapMetaData",  # no header
    "/lights": "std_msgs/msg/UInt8MultiArray",  # an array of messages, which have texts
    "/modcal/notes": "std_msgs/msg/String",
}


def filled(type_name: str, rng: np.random.Generator, n: int, frame: str) -> Any:
    """A message of this type with numbers at random; n: length of every array that has no fixed one."""

    def value(described: Any) -> Any:
        node, what = described
        if node.name == "BASE":
            if what[0] == "string":
                return frame
            if what[0].startswith("float"):
                return float(np.float32(rng.normal()))
            return bool(rng.integers(2)) if what[0] == "bool" else int(rng.integers(1, 100))
        if node.name == "NAME":
            return filled(what, rng, n, frame)
        inner, count = what
        count = count if node.name == "ARRAY" else n
        if inner[0].name == "BASE" and inner[1][0] != "string":
            kind = {"float64": float, "float32": np.float32, "uint8": np.uint8}[inner[1][0]]
            return rng.normal(50.0, 9.0, count).astype(kind)
        return [f"{frame}{i}" if inner[0].name == "BASE" else value(inner) for i in range(count)]

    described = jazzy().fielddefs[type_name][1]
    return message_class(type_name)(**{name: value(what) for name, what in described})


def written(path: Path, messages: list[Message], **how: Any) -> Path:
    """An MCAP file with these messages (topic, type, message), a millisecond apart."""
    timed = [(*message, 10**18 + i * 10**6) for i, message in enumerate(messages)]
    return forms.mcap_file(path, timed, **{"chunk_size": 4096, **how})


def one_by_one(messages: list[Message]) -> Recording:
    """The recording of these messages, each taken as an object; signals, which no object gives, each by its layout."""
    builder = RecordingBuilder()
    for i, (topic, type_name, message) in enumerate(messages):
        said: Any = OneMessage(message)
        if role_of(topic, type_name) in (None, WRENCH):
            said = _of_own_layout(fields.fields_of(type_name, {}), serialise(message, type_name))
        builder.take(topic, type_name, said, np.array([1e-9 * (10**18 + i * 10**6)]))
    return builder.recording()


def same(one: Recording, other: Recording) -> None:
    """Raises unless both are equal to the last bit."""
    assert one.robot_description == other.robot_description
    assert one.warnings == other.warnings
    for kind in ("joints", "readings", "signals", "commands"):
        tracks, others = ({(t.topic, *_key(t)): t for t in getattr(r, kind)} for r in (one, other))
        assert tracks.keys() == others.keys()
        for key, track in tracks.items():
            for name, values in vars(track).items():
                if isinstance(values, np.ndarray):
                    np.testing.assert_array_equal(values, getattr(others[key], name), err_msg=f"{key} {name}")


def _key(track: Any) -> tuple[Any, ...]:
    return tuple(getattr(track, name, None) for name in ("names", "name", "frame", "kind"))


@pytest.mark.slow
@given(
    plan=st.lists(st.tuples(st.sampled_from(sorted(TYPES)), st.integers(0, 3), st.integers(1, 12)), min_size=1),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_mixture_is_read_alike(plan: list[tuple[str, int, int]], seed: int, tmp_path_factory: Any) -> None:
    """Runs of messages whose arrays and texts change their lengths in between."""
    rng = np.random.default_rng(seed)
    messages = [
        (topic, TYPES[topic], filled(TYPES[topic], rng, n, "abc"[: n % 4]))
        for topic, n, count in plan
        for _ in range(count)
    ]
    same(read_recording(written(tmp_path_factory.mktemp("bags") / "any.mcap", messages)), one_by_one(messages))


@pytest.mark.slow
@pytest.mark.parametrize(
    "how",
    [
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"little_endian": False},
    ],
    ids=str,
)
def test_however_it_is_written(how: dict[str, Any], tmp_path: Path, rng: np.random.Generator) -> None:
    messages = [
        (topic, TYPES[topic], filled(TYPES[topic], rng, 6, "frame"))
        for _ in range(200)
        for topic in ("/joint_states", "/tracker/pose", "/battery")
    ]
    usual = read_recording(written(tmp_path / "usual.mcap", messages))
    assert len(usual.joints[0].stamps) == len(usual.readings[0].stamps) == 200
    same(read_recording(written(tmp_path / "other.mcap", messages, **how)), usual)


def test_bytes_that_are_no_such_message_have_no_layout(rng: np.random.Generator) -> None:
    kind = "sensor_msgs/msg/JointState"
    good = bytes(jazzy().serialize_cdr(filled(kind, rng, 3, "f"), kind))
    described = fields.fields_of(kind, {})
    assert described is not None
    assert MessageLayout.of(described, good) is not None
    assert MessageLayout.of(described, b"\x00\x03" + good[2:]) is None  # another encoding
    for size in range(len(good) - 3):
        assert MessageLayout.of(described, good[:size]) is None
    for at in range(4, len(good), 4):  # wherever a count may stand
        MessageLayout.of(described, good[:at] + b"\xff\xff\xff\xff" + good[at + 4 :])


WIDTH = 3
_PLACES: tuple[Any, ...] = (0, 1, slice(2, 3), slice(3, None))  # of stamps, received, a and b


@given(st.lists(st.tuples(st.sampled_from(["extend", "look", "forget"]), st.integers(0, 70)), max_size=30))
def test_rows_are_those_that_were_added(steps: list[tuple[str, int]]) -> None:
    """In their order; also what was looked at before more came."""
    rows, truth = TrackRows(), np.empty((0, 2 + WIDTH))
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    count = 0
    for what, n in steps:
        new = 10.0 * np.arange(count, count + n)[:, None] + np.arange(2 + WIDTH)
        if what == "extend":
            rows.extend(stamps=new[:, 0], received=new[:, 1], a=new[:, 2:3].astype(">f8"), b=new[:, 3:].astype("f4"))
            truth, count = np.vstack([truth, new]), count + n
        elif what == "look":
            seen += [(x, truth[:, k]) for x, k in zip(rows.columns().values(), _PLACES, strict=False)]  # same memory
        elif len(truth):
            border = truth[len(truth) // 2, 1]
            rows.forget_before(border)
            truth = truth[truth[:, 1] >= border]
        assert len(rows) == len(truth)
    seen += [(x, truth[:, k]) for x, k in zip(rows.columns().values(), _PLACES, strict=False)]
    assert all(np.array_equal(there, then) for there, then in seen)
