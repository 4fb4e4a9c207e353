"""Bags: laid out as by ros2 bag record, written from a thread, and read whole or cut."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli.recordings import stations, streams
from mcap.reader import make_reader
from mcap.writer import Writer
from msgs import bag_forms as forms
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from modcal_core.errors import BadRecording
from modcal_core.measurements import ReadingTrack, Recording
from modcal_msgs_py.images import read_messages
from modcal_msgs_py.layout import serialise
from modcal_msgs_py.mcap_read import read_recording
from modcal_msgs_py.mcap_walk import McapFile
from modcal_msgs_py.mcap_write import DiskFile
from modcal_msgs_py.messages import RecordingBuilder
from modcal_msgs_py.recording_write import write_recording


def test_an_independent_reader_finds_the_same(tmp_path: Path) -> None:
    recording = streams(4)
    write_recording(recording, tmp_path / "bag")
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == len(recording.joints[0].stamps) + len(recording.readings[0].stamps) + 1
        positions = [
            store.deserialize_cdr(raw, c.msgtype).position
            for c, _, raw in reader.messages()
            if c.topic == "/joint_states"
        ]
    assert np.array_equal(np.array(positions), recording.joints[0].position)


def test_layout_is_that_of_ros2_bag_record(tmp_path: Path) -> None:
    write_recording(stations(10), tmp_path / "bag")
    information = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["version"] == 9
    assert information["storage_identifier"] == "mcap"
    assert information["ros_distro"] == "jazzy"
    assert information["relative_file_paths"] == ["bag_0.mcap"]
    assert information["message_count"] == 21
    assert information["duration"]["nanoseconds"] == 18_000_000_000
    topics = {t["topic_metadata"]["name"]: t for t in information["topics_with_message_count"]}
    description = topics["/robot_description"]["topic_metadata"]["offered_qos_profiles"][0]
    assert (description["durability"], description["depth"]) == ("transient_local", 1)
    assert topics["/joint_states"]["message_count"] == 10
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        for channel in summary.channels.values():
            assert channel.message_encoding == "cdr"
            assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
            assert yaml.safe_load(channel.metadata["offered_qos_profiles"])[0]["reliability"] == "reliable"
        assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
        assert [m.name for m in reader.iter_metadata()] == ["rosbag2"]


@pytest.mark.parametrize(("encoding", "remedy"), [("json", "write them as a table"), ("ros1", "rosbags-convert")])
def test_messages_of_other_encodings_are_counted_and_named(encoding: str, remedy: str, tmp_path: Path) -> None:
    for name, ros2 in (("alone", 0), ("beside", 5)):
        with (tmp_path / f"{name}.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile="", library="")
            odd = writer.register_channel("/tracker/pose", encoding, 0)
            schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
            plain = writer.register_channel("/x", "cdr", schema)
            for i in range(7):
                writer.add_message(odd, i, b"{}", i)
            for i in range(ros2):
                writer.add_message(plain, i, b"\0\1\0\0" + bytes(8), i)
            writer.finish()
    said = f"holds 7 messages in the encoding {encoding} on /tracker/pose, which is not read: .*{remedy}"
    with pytest.raises(BadRecording, match=said):
        read_recording(tmp_path / "alone.mcap")
    (warning,) = read_recording(tmp_path / "beside.mcap").warnings
    assert re.search(said, warning)


def test_messages_of_the_wire_take_the_same_path() -> None:
    """A message of rclpy and one of a bag give the same recording, and each reads the other's bytes."""
    from geometry_msgs.msg import PoseStamped
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import JointState

    wire = JointState(name=["b", "a"], position=[1.0, 2.0], effort=[3.0, 4.0])
    wire.header.stamp.sec, wire.header.stamp.nanosec = 12, 500_000_000
    rest = forms.joint_state(12_500_000_000, ["b", "a"], [1.0, 2.0])
    rest.effort = np.array([3.0, 4.0])
    # bytes between fields are padding that nobody sets, so messages are compared, not bytes
    assert deserialize_message(serialise(rest, "sensor_msgs/msg/JointState"), JointState) == wire
    pose = PoseStamped()
    pose.header.frame_id = "tracker"
    pose.pose.position.x = 0.5
    tracks = []
    for message in (wire, rest):
        builder = RecordingBuilder()
        builder.add("/joint_states", "sensor_msgs/msg/JointState", message, 13.0)
        builder.add("/cell/tracker/pose", "geometry_msgs/msg/PoseStamped", pose, 13.0)
        recording = builder.recording()
        tracks.append(recording.joints[0])
        assert recording.readings[0].frame == "tracker"
        assert recording.readings[0].stamps[0] == 13.0  # it had no stamp
        assert "no stamp" in recording.warnings[0]
    for field in ("names", "stamps", "position", "effort", "received"):
        assert np.array_equal(getattr(tracks[0], field), getattr(tracks[1], field))
    assert np.isnan(tracks[0].velocity).all()


_KILLED = """
import os, signal, sys
from pathlib import Path
from modcal_msgs_py.mcap_write import BagWriter
from modcal_msgs_py.layout import message_class, serialise
bag = BagWriter(Path(sys.argv[1]))
bag.add_topic("/robot_description", "std_msgs/msg/String")
cdr = serialise(message_class("std_msgs/msg/String")(data="x"), "std_msgs/msg/String")
for k in range(100):
    bag.write_raw("/robot_description", cdr, k)
    if k == 59:
        bag.flush()
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_a_killed_recorder_loses_at_most_the_last_chunk(tmp_path: Path) -> None:
    """What was flushed is on disk although nothing was ever closed."""
    killed = subprocess.run([sys.executable, "-c", _KILLED, str(tmp_path / "bag")], timeout=60.0)
    assert killed.returncode == -signal.SIGKILL
    file = McapFile(tmp_path / "bag" / "bag_0.mcap")
    assert len(list(file.messages())) == 60
    assert file.cut == "it ends without an index"
    assert "no metadata.yaml" in read_recording(tmp_path / "bag").warnings[0]


def test_a_message_of_a_point_has_no_turn_of_a_pose_before(tmp_path: Path) -> None:
    t, stated = np.array([1.0, 2.0]), np.full((2, 2), 1e-3)
    pose = ReadingTrack("pose", "t", t, np.tile([1.0, 2.0, 3.0, 0.6, 0.0, 0.8, 0.0], (2, 1)), t, "", stated)
    point = ReadingTrack("point", "t", t, np.tile([1.0, 2.0, 3.0], (2, 1)), t, "", stated)
    write_recording(Recording((), (pose, point), (), None, "made", ()), tmp_path / "bag")
    turns = [message.pose.pose.orientation for _, message in read_messages(tmp_path / "bag", "/tracker/point")]
    assert [(q.x, q.y, q.z, q.w) for q in turns] == 2 * [(0.0, 0.0, 0.0, 1.0)]


def test_what_is_handed_over_is_in_the_file(tmp_path: Path, rng: np.random.Generator) -> None:
    pieces = [rng.bytes(int(n)) for n in rng.integers(0, 100_000, 200)]
    file = DiskFile(tmp_path / "file")
    for k, piece in enumerate(pieces):
        file.write(piece)
        assert file.tell() == sum(map(len, pieces[: k + 1]))
        if k % 50 == 49:
            file.drain(sync=k % 100 == 99)
            assert (tmp_path / "file").read_bytes() == b"".join(pieces[: k + 1])
            assert file.waiting == 0
            assert k % 100 != 99 or file.on_disk == file.tell()
    file.close()
    assert (tmp_path / "file").read_bytes() == b"".join(pieces)
    file.close()


@pytest.mark.slow
def test_a_sync_that_hangs_holds_up_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is handed over meanwhile is with the system, and so outlives a process that is killed."""
    moves = threading.Event()
    at_work = threading.Event()

    def stands_still(handle: int) -> None:
        at_work.set()
        moves.wait()

    monkeypatch.setattr(os, "fdatasync", stands_still)
    file = DiskFile(tmp_path / "file")
    file.write(b"first")
    assert at_work.wait(30.0)
    for _ in range(1000):
        file.write(b"more")
    file.drain()
    assert (tmp_path / "file").read_bytes() == b"first" + 1000 * b"more"
    assert (file.waiting, file.on_disk) == (0, 0)
    moves.set()
    file.drain(sync=True)
    assert file.on_disk == 4005
    file.close()


def test_nobody_waits_for_a_disk_that_takes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moves = threading.Event()
    write = os.write

    def stands_still(handle: int, data: bytes) -> int:
        moves.wait()
        return write(handle, data)

    monkeypatch.setattr(os, "write", stands_still)
    file = DiskFile(tmp_path / "file")
    for _ in range(1000):
        file.write(b"more")
    assert file.waiting == 4000
    moves.set()
    file.drain(sync=True)
    assert (tmp_path / "file").read_bytes() == 1000 * b"more"
    file.close()


_REFUSED = """
import errno, resource, sys
from pathlib import Path
from modcal_msgs_py.mcap_write import DiskFile
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
file = DiskFile(Path(sys.argv[1]))
file.write(bytes(600))
file.drain()
file.write(bytes(600))
for call in (file.drain, lambda: file.drain(sync=True), lambda: file.write(b"x"), file.check, file.close, file.close):
    try:
        call()
    except OSError as error:
        print(error.errno == errno.EFBIG)
"""


def test_a_refusal_is_raised_by_every_later_call(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _REFUSED, str(tmp_path / "file")], capture_output=True, text=True, timeout=60.0
    )
    assert done.stdout.split() == ["True"] * 6, done.stderr
    assert (tmp_path / "file").stat().st_size == 1000
