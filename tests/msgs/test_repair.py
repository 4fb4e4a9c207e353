"""Repair and damage: what is whole before a cut is in the new bag, and what is damaged costs itself, said in one line."""

from __future__ import annotations

import hashlib
import resource
import shutil
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import yaml
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer
from msgs import bag_forms as forms
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from modcal_core.errors import BadRecording
from modcal_core.measurements.recording import Recording
from modcal_msgs_py.layout import definition, message_class, serialise
from modcal_msgs_py.mcap_read import read_recording
from modcal_msgs_py.mcap_repair import repair_bag
from modcal_msgs_py.mcap_walk import MAGIC
from modcal_msgs_py.mcap_write import BagWriter

STRING = "std_msgs/msg/String"
QOS_OF_OLD = """- history: 3
  depth: 0
  reliability: 2
  durability: 2
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""


class Told(NamedTuple):
    """What a reader tells of one message."""

    topic: str
    type_name: str
    received: int
    published: int
    sequence: int
    cdr: bytes


def record(
    file: Path,
    rng: np.random.Generator,
    count: int,
    compression: CompressionType = CompressionType.NONE,
    chunked: bool = True,
) -> list[Told]:
    """A file as another recorder leaves it: several topics, stamps that jump back, sequence numbers of its own."""
    told = []
    text, type_hash = definition(STRING)
    with file.open("wb") as stream:
        writer = Writer(stream, chunk_size=4000, compression=compression, use_chunking=chunked)
        writer.start(profile="ros2", library="another")
        schema = writer.register_schema(STRING, "ros2msg", text.encode())
        channels: dict[str, int] = {}
        for k in range(count):
            topic = f"/cell_{rng.integers(1 + k // 20)}/talk"
            if topic not in channels:
                described = {"offered_qos_profiles": QOS_OF_OLD, "topic_type_hash": type_hash}
                channels[topic] = writer.register_channel(topic, "cdr", schema, described)
            words = f"message {k} " + "".join(map(chr, rng.integers(97, 123, rng.integers(300))))
            cdr = serialise(message_class(STRING)(data=words), STRING)
            received, sequence = int(1e18) + int(rng.integers(-1000, 1000)) + 100 * k, 7 * k
            writer.add_message(channels[topic], received, cdr, received - 55, sequence)
            told.append(Told(topic, STRING, received, received - 55, sequence, cdr))
        writer.add_metadata("cell", {"operator": "nobody"})
        writer.finish()
    return told


def told_by_mcap(folder: Path) -> list[Told]:
    """The messages of a bag by the index of its files."""
    told = []
    information = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    for name in information["relative_file_paths"]:
        with (folder / name).open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            before = len(told)
            told += [
                Told(c.topic, s.name, m.log_time, m.publish_time, m.sequence, m.data)
                for s, c, m in reader.iter_messages(log_time_order=False)
                if s is not None
            ]
            assert summary.statistics.message_count == len(told) - before
    assert information["message_count"] == len(told)
    return told


def check_whole(folder: Path, expected: list[Told]) -> None:
    """Two independent readers, going by index and metadata, find exactly these messages."""
    assert told_by_mcap(folder) == expected
    with Reader(folder) as reader:
        assert reader.message_count == len(expected)
        assert reader.start_time == min(m.received for m in expected)
        found = [(c.topic, stamp, bytes(raw)) for c, stamp, raw in reader.messages()]
    assert sorted(found) == sorted((m.topic, m.received, m.cdr) for m in expected)


def prints(place: Path) -> dict[str, str]:
    files = [place] if place.is_file() else sorted(place.rglob("*"))
    return {f"{p.name} {p.stat().st_mtime_ns}": hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.mark.slow
@pytest.mark.parametrize("chunked", [True, False])
def test_of_any_cut_exactly_what_is_whole_before_it(chunked: bool, tmp_path: Path, rng: np.random.Generator) -> None:
    told = record(tmp_path / "whole.mcap", rng, 150, chunked=chunked)
    whole = (tmp_path / "whole.mcap").read_bytes()
    ends = np.array([whole.index(m.cdr) + len(m.cdr) for m in told])
    assert (np.diff(ends) > 0).all()
    cut = tmp_path / "cut.mcap"
    border = [0, 3, 8, ends[0] - 1, ends[0], ends[-1] - 1, ends[-1], len(whole) - 1]
    for size in [*border, *rng.integers(0, len(whole), 30)]:
        cut.write_bytes(whole[:size])
        before = prints(cut)
        expected = told[: int((ends <= size).sum())]
        if expected:
            done = repair_bag(cut, tmp_path / "new")
            assert done.folder == tmp_path / "new"
            assert sum(done.saved.values()) == len(expected)
            assert done.reasons
            check_whole(tmp_path / "new", expected)
            # once more: now there is nothing to do
            assert repair_bag(tmp_path / "new", tmp_path / "newer").folder is None
            shutil.rmtree(tmp_path / "new")
        else:
            with pytest.raises(BadRecording, match=r"is empty|is not an MCAP file|holds no whole message"):
                repair_bag(cut, tmp_path / "new")
        assert prints(cut) == before
        assert {p.name for p in tmp_path.iterdir()} == {"whole.mcap", "cut.mcap"}


@pytest.mark.slow
@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_of_packed_chunks_at_least_the_whole_ones(
    compression: CompressionType, tmp_path: Path, rng: np.random.Generator
) -> None:
    told = record(tmp_path / "whole.mcap", rng, 200, compression)
    whole = (tmp_path / "whole.mcap").read_bytes()
    with (tmp_path / "whole.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
        stream.seek(0)
        chunks = [r for r in StreamReader(stream, emit_chunks=True).records if isinstance(r, Chunk)]
    assert len(chunks) > 4
    held = np.cumsum([sum(isinstance(r, Message) for r in breakup_chunk(chunk)) for chunk in chunks])
    assert held[-1] == len(told)
    ends = np.array([index.chunk_start_offset + index.chunk_length for index in summary.chunk_indexes])
    cut = tmp_path / "cut.mcap"
    for size in rng.integers(ends[0], len(whole), 20):
        cut.write_bytes(whole[:size])
        done = repair_bag(cut, tmp_path / "new")
        found = told_by_mcap(tmp_path / "new")
        assert found == told[: len(found)]
        assert len(found) >= held[ends <= size][-1]
        assert len(found) == sum(done.saved.values())
        check_whole(tmp_path / "new", found)
        shutil.rmtree(tmp_path / "new")


def test_a_folder_keeps_what_its_metadata_said(tmp_path: Path, rng: np.random.Generator) -> None:
    """Topics, types, hashes, QoS (numbers of an old bag as names), and other records."""
    told = record(tmp_path / "whole.mcap", rng, 60)
    (tmp_path / "bag").mkdir()
    whole = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "bag" / "bag_0.mcap").write_bytes(whole)
    done = repair_bag(tmp_path / "bag", tmp_path / "new")
    assert done.reasons == ("metadata.yaml is missing: the recorder did not close the bag.",)
    check_whole(tmp_path / "new", told)
    information = yaml.safe_load((tmp_path / "new" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    topics = {t["topic_metadata"]["name"]: t for t in information["topics_with_message_count"]}
    assert {name: t["message_count"] for name, t in topics.items()} == dict(done.saved)
    for topic in topics.values():
        described = topic["topic_metadata"]
        assert described["type"] == STRING
        assert described["type_description_hash"] == definition(STRING)[1]
        profile = described["offered_qos_profiles"][0]
        assert (profile["history"], profile["reliability"]) == ("unknown", "best_effort")
        assert (profile["durability"], profile["liveliness"]) == ("volatile", "automatic")
        assert profile["deadline"] == {"sec": 9223372036, "nsec": 854775807}
    with (tmp_path / "new" / "new_0.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert {m.name: m.metadata for m in reader.iter_metadata()} == {"cell": {"operator": "nobody"}}
        summary = reader.get_summary()
        assert {c.metadata["offered_qos_profiles"] for c in summary.channels.values()} == {QOS_OF_OLD}
        assert [s.data for s in summary.schemas.values()] == [definition(STRING)[0].encode()]


def test_several_files_of_one_bag(tmp_path: Path, rng: np.random.Generator) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    # eleven of them, so that the order of names is not the order of letters; the last has just been begun
    told = [record(bag / f"bag_{k}.mcap", rng, 10) for k in range(11)]
    (bag / "bag_11.mcap").touch()
    middle = bag / "bag_4.mcap"
    data = middle.read_bytes()
    middle.write_bytes(data[: data.index(told[4][5].cdr) + 1])
    told[4] = told[4][:5]
    before = prints(bag)
    done = repair_bag(bag, tmp_path / "new")
    check_whole(tmp_path / "new", [m for part in told for m in part])
    assert [r.split()[0].rstrip(":") for r in done.reasons] == ["metadata.yaml", "bag_4.mcap", "bag_11.mcap"]
    assert prints(bag) == before
    with AnyReader([tmp_path / "new"]) as reader:
        assert sum(1 for _ in reader.messages()) == 105


def test_a_bag_that_lost_its_index_or_a_file(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(20):
            bag.write("/talk", STRING, message_class(STRING)(data=f"{k}"), k)
    assert repair_bag(tmp_path / "bag", tmp_path / "new").folder is None
    told = told_by_mcap(tmp_path / "bag")
    file, metadata = tmp_path / "bag" / "bag_0.mcap", tmp_path / "bag" / "metadata.yaml"
    whole, stated = file.read_bytes(), metadata.read_text()

    def repaired(reason: str) -> None:
        assert reason in " ".join(repair_bag(tmp_path / "bag", tmp_path / "new").reasons)
        check_whole(tmp_path / "new", told)
        shutil.rmtree(tmp_path / "new")

    file.write_bytes(whole[:-30])
    repaired("its index is damaged")
    # the index of another file of the same length would not do either
    file.write_bytes(whole[: -len(whole) // 4] + bytes(len(whole) // 4))
    repaired("bag_0.mcap: ")
    file.write_bytes(whole)
    metadata.write_text(stated.replace("message_count: 20", "message_count: 21"))
    repaired("metadata.yaml counts other messages")
    metadata.write_text(stated.replace("- bag_0.mcap", "- bag_0.mcap\n  - bag_1.mcap"))
    repaired("bag_1.mcap is named by metadata.yaml, but not there")
    metadata.write_text("{")
    repaired("metadata.yaml is damaged")


def test_of_a_chunk_with_a_wrong_bit_nothing_is_believed(tmp_path: Path, rng: np.random.Generator) -> None:
    told = record(tmp_path / "bad.mcap", rng, 100)
    data = bytearray((tmp_path / "bad.mcap").read_bytes())
    with (tmp_path / "bad.mcap").open("rb") as stream:
        chunks = [r for r in StreamReader(stream, emit_chunks=True).records if isinstance(r, Chunk)]
    held = [sum(isinstance(r, Message) for r in breakup_chunk(chunk)) for chunk in chunks]
    data[bytes(data).index(told[sum(held[:2]) + 1].cdr) + 12] ^= 1  # in the third chunk
    (tmp_path / "bad.mcap").write_bytes(data)
    assert repair_bag(tmp_path / "bad.mcap", tmp_path / "new").reasons == ("bad.mcap: a chunk's checksum is wrong.",)
    check_whole(tmp_path / "new", told[: sum(held[:2])])


def test_what_cannot_be_repaired_is_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    cut = tmp_path / "cut.mcap"
    record(cut, rng, 20)
    cut.write_bytes(cut.read_bytes()[:-1])

    def refused(bag: Path, out: Path, said: str) -> None:
        before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}
        with pytest.raises(BadRecording, match=said):
            repair_bag(bag, out)
        assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")} == before

    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "old_0.db3").write_bytes(b"SQLite format 3\x00")
    refused(tmp_path / "old", tmp_path / "new", "is a SQLite bag")
    (tmp_path / "nothing").mkdir()
    refused(tmp_path / "nothing", tmp_path / "new", "holds no .mcap or .db3 file")
    refused(cut, tmp_path / "nothing", "nothing: exists already")
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "bag_0.mcap").write_bytes(cut.read_bytes())
    refused(tmp_path / "bag", tmp_path / "bag" / "new", "lies in the bag")
    (tmp_path / "file").touch()
    refused(cut, tmp_path / "file" / "new", "cannot be written")


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
