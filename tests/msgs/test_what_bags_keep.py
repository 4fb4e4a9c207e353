"""Times, names and silent topics: what a bag must hold besides the bytes of its messages."""

from __future__ import annotations

import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from msgs import bag_forms as forms

from modcal_core.errors import BadRecording
from modcal_msgs_py.layout import message_class, serialise
from modcal_msgs_py.mcap_read import read_recording
from modcal_msgs_py.mcap_repair import repair_bag
from modcal_msgs_py.mcap_write import BagWriter
from modcal_msgs_py.messages import RecordingBuilder
from modcal_msgs_py.readings import seconds, set_seconds
from modcal_msgs_py.tables import import_tables

STRING, JOINTS = "std_msgs/msg/String", "sensor_msgs/msg/JointState"


def joint_state(names: list[str], sec: int) -> Any:
    return forms.joint_state(sec * 10**9, names, np.arange(float(len(names))))


def test_a_stamp_is_the_nearest_nanosecond(rng: np.random.Generator) -> None:
    for nanoseconds in rng.integers(0, 10**12, 300).tolist():
        stamp = SimpleNamespace(sec=0, nanosec=0)
        for part, nearest in ((0.0, 0), (0.4, 0), (0.6, 1)):
            set_seconds(stamp, (nanoseconds + part) * 1e-9)
            assert stamp.sec * 10**9 + stamp.nanosec == nanoseconds + nearest
        assert seconds(stamp) == pytest.approx(nanoseconds * 1e-9, abs=2e-9)


def test_when_a_message_was_published_is_kept_beside_when_it_came(tmp_path: Path) -> None:
    cdr = serialise(message_class(STRING)(data="x"), STRING)
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/said", STRING)
        bag.write_raw("/said", cdr, 2000, 1500)
        bag.write_raw("/said", cdr, 3000)
    with bag.file.open("rb") as stream:
        times = [(m.log_time, m.publish_time) for _, _, m in make_reader(stream).iter_messages()]
    assert times == [(2000, 1500), (3000, 3000)]


def bag_with_a_silent_topic(folder: Path) -> Path:
    cdr = serialise(message_class(STRING)(data="x"), STRING)
    with BagWriter(folder) as bag:
        bag.add_topic("/said", STRING)
        bag.add_topic("/silent", STRING)
        for k in range(5):
            bag.write_raw("/said", cdr, 1000 + k)
    return bag.file


def test_a_topic_without_a_message_is_in_the_repaired_bag_too(tmp_path: Path) -> None:
    file = bag_with_a_silent_topic(tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    repair_bag(tmp_path / "bag", tmp_path / "new")
    with (tmp_path / "new" / "new_0.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert {channel.topic for channel in summary.channels.values()} == {"/said", "/silent"}
    assert file.exists()


def test_an_index_that_counts_other_messages_is_a_fault(tmp_path: Path) -> None:
    data = bytearray(bag_with_a_silent_topic(tmp_path / "bag").read_bytes())
    # the record of statistics: opcode 0x0b, its length, then the count of messages
    at = next(
        i
        for i in range(len(data) - 1, 0, -1)
        if data[i] == 0x0B and 46 <= struct.unpack_from("<Q", data, i + 1)[0] <= 100
        and struct.unpack_from("<Q", data, i + 9)[0] == 5
    )  # fmt: skip
    struct.pack_into("<Q", data, at + 9, 7)
    (tmp_path / "alone.mcap").write_bytes(data)
    done = repair_bag(tmp_path / "alone.mcap", tmp_path / "new")
    assert done.saved["/said"] == 5
    assert any("counts 7 messages, it holds 5" in reason for reason in done.reasons)


def test_a_name_that_stands_twice_is_refused() -> None:
    with pytest.raises(BadRecording, match="2 positions for 2 names, 1 of them distinct"):
        RecordingBuilder().add("/joint_states", JOINTS, joint_state(["a", "a"], 1))


def test_a_message_without_a_stamp_is_of_when_it_came() -> None:
    builder = RecordingBuilder()
    for k in range(3):
        builder.add("/joint_states", JOINTS, joint_state(["a", "b"], 0), 100.0 + k)
    recording = builder.recording()
    assert recording.joints[0].stamps.tolist() == [100.0, 101.0, 102.0]
    assert "3 messages on /joint_states had no stamp" in recording.warnings[0]


def test_the_plain_topic_is_preferred_to_one_in_a_namespace() -> None:
    builder = RecordingBuilder()
    builder.add("/left/joint_states", JOINTS, joint_state(["a", "b"], 1))
    assert [track.topic for track in builder.recording().joints] == ["/left/joint_states"]
    builder.add("/joint_states", JOINTS, joint_state(["a", "b"], 2))
    assert [track.topic for track in builder.recording().joints] == ["/joint_states"]


def test_tables_that_have_lost_their_clock_follow_one_another(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text("j,x,y,z\n0.1,1,2,3\n0.2,1,2,4\n0.3,1,2,5\n")
    entry = {
        "files": "*.csv",
        "time": {"order": {"period_s": 10.0}},
        "joints": {"unit": "rad", "columns": {"j": "j"}},
        "point": {"frame": "tracker", "unit": "m", "position": ["x", "y", "z"]},
    }
    recording = import_tables({"tables": [entry]}, tmp_path, "mapping")
    (joints,) = recording.joints
    assert len(joints.stamps) == 6
    assert (np.diff(joints.stamps) > 0.0).all()


def test_logs_stamps_and_counters_are_no_signals(tmp_path: Path) -> None:
    time = message_class("builtin_interfaces/msg/Time")(sec=5, nanosec=7)
    header = message_class("std_msgs/msg/Header")(stamp=time, frame_id="")
    told = {
        "sensor_msgs/msg/TimeReference": {"header": header, "time_ref": time, "source": "gps"},
        "rcl_interfaces/msg/Log": {
            "stamp": time, "level": 20, "name": "n", "msg": "m", "file": "f", "function": "g", "line": 12
        },
        "std_msgs/msg/Float64": {"data": 1.5},
    }  # fmt: skip
    with BagWriter(tmp_path / "bag") as bag:
        for k, (type_name, values) in enumerate(told.items()):
            bag.write(f"/topic_{k}", type_name, message_class(type_name)(**values), 10**18 + k)
    recording = read_recording(tmp_path / "bag")
    assert [signal.name for signal in recording.signals] == ["signal:/topic_2"]
