"""Bags that are damaged, or made to do damage: each costs what is damaged, is said, and ends in no traceback."""

from __future__ import annotations

import resource
import struct
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from mcap.opcode import Opcode
from msgs import bag_forms as forms

from modcal_core.errors import BadRecording
from modcal_core.measurements.recording import Recording
from modcal_msgs_py.layout import definition
from modcal_msgs_py.mcap_read import read_recording
from modcal_msgs_py.mcap_repair import repair_bag
from modcal_msgs_py.mcap_walk import MAGIC

LINE = "=" * 80 + "\n"
EVENT = f"""service_msgs/ServiceEventInfo info
std_srvs/srv/SetBool_Request[<=1] request
std_srvs/srv/SetBool_Response[<=1] response
{LINE}MSG: service_msgs/ServiceEventInfo
uint8 event_type
{LINE}MSG: std_srvs/srv/SetBool_Request
bool data
{LINE}MSG: std_srvs/srv/SetBool_Response
bool success
string message
"""
SELF = f"my_msgs/Node left\nfloat64 value\n{LINE}MSG: my_msgs/Node\nmy_msgs/Node left\nfloat64 value\n"
# each type has ten of the one before: thirty-two of them have more fields than there are atoms
WIDE = "my_msgs/T31 a\n" + "".join(
    f"{LINE}MSG: my_msgs/T{i}\n" + "".join(f"my_msgs/T{i - 1} f{k}\n" for k in range(10)) for i in range(31, 0, -1)
)


def bag_with(path: Path, others: list[tuple[str, str, str, bytes]]) -> Path:
    """A joint state at 1, 2, … 5 s, and a message of each other topic (topic, type, definition, bytes) at its side."""
    messages: list[forms.Message] = []
    for t in range(1, 6):
        ns = t * 10**9
        messages.append(("/joint_states", forms.JOINT_STATE, forms.joint_state(ns, ["a", "b"], [0.1 * t, 0.2]), ns))
        messages += [(topic, name, data, ns + 1) for topic, name, _, data in others]
    return forms.mcap_file(path, messages, {name: ("ros2msg", text) for _, name, text, _ in others})


def joints_of(path: Path) -> Recording:
    recording = read_recording(path)
    assert [len(track.stamps) for track in recording.joints] == [5]
    return recording


@pytest.mark.parametrize(
    ("type_name", "text"),
    [
        ("std_srvs/srv/SetBool_Event", EVENT),
        ("std_srvs/srv/SetBool_Event", ""),
        ("my_msgs/msg/Node", SELF),
        ("my_msgs/msg/Wide", WIDE),
        ("my_msgs/msg/Broken", "float64 [ x ]]\x00 = \n"),
        ("my_msgs/msg/Long", "float64 x\n" * 100_000),
        ("my_msgs/msg/Big", "Empty[1000000000] x\n" + LINE + "MSG: my_msgs/Empty\n"),
        ("my_msgs/msg/Huge", "float64[4000000000] x\n"),
        ("wide", "wstring x\n"),
        ("", ""),
    ],
)  # fmt: skip
def test_a_definition_that_cannot_be_read_costs_its_topic(tmp_path: Path, type_name: str, text: str) -> None:
    path = bag_with(tmp_path / "bag.mcap", [("/other", type_name, text, bytes(64))])
    began = time.process_time()
    joints_of(path)
    assert time.process_time() - began < 2.0


def test_definitions_of_a_bag_are_still_read(tmp_path: Path) -> None:
    """What is refused is what cannot be read, no more: a type of one's own is a signal as before."""
    text = f"my_msgs/Inner inner\nstring[] names\n{LINE}MSG: my_msgs/Inner\nfloat64 value\n"
    cdr = b"\0\1\0\0" + struct.pack("<dI", 3.5, 0)
    recording = joints_of(bag_with(tmp_path / "bag.mcap", [("/heat", "my_msgs/msg/Heat", text, cdr)]))
    (signal,) = recording.signals
    assert signal.name == "signal:/heat"
    assert signal.values.tolist() == [[3.5]] * 5


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0", bytes(7), b"\xff" * 40])
def test_a_malformed_message_costs_itself(tmp_path: Path, data: bytes) -> None:
    kind = "sensor_msgs/msg/Imu"
    bag = bag_with(tmp_path / "bag.mcap", [("/imu", kind, definition(kind)[0], data)])
    said = " ".join(joints_of(bag).warnings)
    assert "5 messages on /imu were left out: they are not of type sensor_msgs/msg/Imu." in said


def chunk(records: bytes, size: int, compression: str) -> bytes:
    """A whole file with one chunk that says that it unpacks to so many bytes."""
    name = compression.encode()
    body = struct.pack("<QQQI", 0, 0, size, 0) + struct.pack("<I", len(name)) + name + struct.pack("<Q", len(records))
    body += records
    header = struct.pack("<II", 0, 0)
    return MAGIC + struct.pack("<BQ", 1, len(header)) + header + struct.pack("<BQ", Opcode.CHUNK, len(body)) + body


def bomb() -> bytes:
    """100 MiB of zeros in some kilobytes."""
    packer = zstandard.ZstdCompressor(level=1).compressobj()
    zeros = bytes(1 << 20)
    return b"".join(packer.compress(zeros) for _ in range(100)) + packer.flush()


@pytest.mark.parametrize(
    ("make", "declared", "compression"),
    [
        (bomb, 12 << 30, "zstd"),
        (bomb, 100 << 20, "zstd"),  # as it is: more than any recorder would pack
        (bomb, 1, "zstd"),
        (lambda: bytes(100), 2**64 - 1, "lz4"),
        (lambda: bytes(100), 2**64 - 1, "zstd"),
        (lambda: bytes(100), 2**63, "lz4"),
        (lambda: bytes(100), 2**64 - 1, ""),
        (lambda: bytes(100), 100, "\x1b[31mred"),
    ],
)  # fmt: skip
def test_a_chunk_that_would_fill_the_memory_is_not_unpacked(
    tmp_path: Path, make: Callable[[], bytes], declared: int, compression: str
) -> None:
    (tmp_path / "bomb.mcap").write_bytes(chunk(make(), declared, compression))
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    for act in (read_recording, lambda path: repair_bag(path, tmp_path / "new")):
        with pytest.raises(BadRecording, match="holds no (whole )?message"):
            act(tmp_path / "bomb.mcap")
    assert time.process_time() - began < 2.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000  # kB


def test_the_reason_is_in_the_refusal(tmp_path: Path) -> None:
    (tmp_path / "bomb.mcap").write_bytes(chunk(bytes(100), 12 << 30, "zstd"))
    with pytest.raises(
        BadRecording, match=r"holds no message \(a chunk of 144 bytes declares 12884901888, \d+ is the limit\)"
    ):
        read_recording(tmp_path / "bomb.mcap")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu"])
def test_a_few_kilobytes_of_empty_messages_take_no_minutes(tmp_path: Path, kind: str) -> None:
    """They pack a thousand times as tightly as they are slow to decode, one by one."""
    count, path = 200_000, tmp_path / "bag.mcap"

    def text(data: bytes) -> bytes:
        return struct.pack("<I", len(data)) + data

    def record(opcode: int, body: bytes) -> bytes:
        return struct.pack("<BQ", opcode, len(body)) + body

    schema = struct.pack("<H", 1) + text(kind.encode()) + text(b"ros2msg") + text(definition(kind)[0].encode())
    channel = struct.pack("<HH", 1, 1) + text(b"/joint_states") + text(b"cdr") + text(b"")
    message = record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 0, 0, 0))
    records = record(Opcode.SCHEMA, schema) + record(Opcode.CHANNEL, channel) + count * message
    path.write_bytes(chunk(zstandard.ZstdCompressor(level=1).compress(records), len(records), "zstd"))
    assert path.stat().st_size < 100_000
    began = time.process_time()
    recording = read_recording(path)
    assert time.process_time() - began < 2.0
    assert f"{count} messages on /joint_states were left out: they are not of type {kind}." in recording.warnings


@pytest.mark.parametrize("stated", ["[]", "3", "[3]", "['']", "{a: b}", "null", "['../../etc/passwd']", "[no.mcap]",
                                    pytest.param(f"[{'a' * 3000}]", id="too long"), pytest.param("['\\ud800']", id="half")])  # fmt: skip
def test_a_folder_that_names_no_files(tmp_path: Path, stated: str) -> None:
    (tmp_path / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {{relative_file_paths: {stated}}}")
    for act in (read_recording, lambda path: repair_bag(path, tmp_path / "new")):
        with pytest.raises(BadRecording):
            act(tmp_path)
