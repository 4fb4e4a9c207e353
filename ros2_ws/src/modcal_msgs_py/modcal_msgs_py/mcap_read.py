"""Reading bags, whole or cut.

A file is walked record by record from its beginning, never through the index at its end: an index is missing just when
a recording was cut short, and one way of reading is easier to trust than two. Each chunk's checksum is verified;
reading stops at the first byte that does not fit, and what came before is kept.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import lz4.frame
import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from modcal_core.errors import BadRecording
from modcal_core.measurements.recording import Recording
from modcal_msgs_py.messages import RecordingBuilder
from modcal_msgs_py.types import store_with

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
_SIGNAL_TYPES_LEFT_OUT = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/PointCloud2",
    "rosgraph_msgs/msg/Clock",
    "tf2_msgs/msg/",
)


class RawMessage(NamedTuple):
    """One message as it lies in the file: CDR bytes, and when it was received and published [ns]."""

    topic: str
    type_name: str
    cdr: bytes | memoryview
    received_ns: int
    published_ns: int
    sequence: int
    channel: int


@dataclass
class McapFile:
    """An MCAP file being walked. After the walk, ``cut`` says why it ended early, if it did.

    cdr_only: leave out what is not encoded as ROS 2 encodes. extras: whole attachments and metadata records (bytes
    with opcode and length), as they were met. compression: of the first chunk.
    """

    path: Path
    cdr_only: bool = True
    schemas: dict[str, str] = field(default_factory=dict)
    topics: dict[str, str] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    schema_records: dict[int, Schema] = field(default_factory=dict)
    extras: list[tuple[int, bytes]] = field(default_factory=list)
    compression: str | None = None
    count: int = 0
    cut: str | None = None
    _known: dict[int, tuple[str, str]] = field(default_factory=dict)

    def messages(self) -> Iterator[RawMessage]:
        """Every whole message, in the order of the file. Raises BadRecording for a file that is not MCAP."""
        size = self.path.stat().st_size
        if size == 0:
            raise BadRecording(str(self.path), "is empty", "record again")
        with self.path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if data[: len(MAGIC)] != MAGIC:
                raise BadRecording(str(self.path), "is not an MCAP file", _other_format(data[:16]))
            # memoryviews into the map must be gone before it closes, so chunks are copied out of it
            yield from self._walk(data, min(size, len(data)))

    def _walk(self, data: mmap.mmap, size: int) -> Iterator[RawMessage]:
        at = len(MAGIC)
        while at < size:
            if size - at < _RECORD.size:
                self.cut = f"{size - at} bytes at the end are no record"
                return
            opcode, length = _RECORD.unpack_from(data, at)
            body = at + _RECORD.size
            if not 0x01 <= opcode <= 0x0F and opcode < 0x80:
                self.cut = f"{size - at} bytes from byte {at} are no MCAP records"
                return
            if body + length > size:
                self.cut = f"{size - at} bytes at the end are an unfinished record"
                if opcode == Opcode.CHUNK:
                    yield from self._chunk(data[body:size], whole=False)
                return
            if opcode == Opcode.CHUNK:
                yield from self._chunk(data[body : body + length], whole=True)
            elif opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                yield from self._records(data[at : body + length])
            elif opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
                self.extras.append((opcode, data[at : body + length]))
            elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return
            if self.cut:
                return
            at = body + length
        self.cut = "it ends without an index"

    def _chunk(self, body: bytes, whole: bool) -> Iterator[RawMessage]:
        try:
            _, _, unpacked_size, crc = _CHUNK.unpack_from(body)
            (name_length,) = struct.unpack_from("<I", body, _CHUNK.size)
            start = _CHUNK.size + 4 + name_length + 8
            compression = body[_CHUNK.size + 4 : _CHUNK.size + 4 + name_length].decode()
            content = _unpacked(compression, body[start:], unpacked_size)
        except (struct.error, UnicodeDecodeError, RuntimeError, EOFError, zstandard.ZstdError) as error:
            # of a chunk that is cut already, this says nothing new
            if whole:
                self.cut = f"a chunk cannot be unpacked ({error})"
            return
        if whole and (len(content) != unpacked_size or (crc and zlib.crc32(content) != crc)):
            self.cut = "a chunk's checksum is wrong"
            return
        self.compression = self.compression or compression
        yield from self._records(content)

    def _records(self, content: bytes) -> Iterator[RawMessage]:
        at, size = 0, len(content)
        view = memoryview(content)
        while at + _RECORD.size <= size:
            opcode, length = _RECORD.unpack_from(content, at)
            body = at + _RECORD.size
            if body + length > size:
                self.cut = self.cut or "a chunk ends in the middle of a record"
                return
            if opcode == Opcode.MESSAGE:
                if length < _MESSAGE.size:
                    self.cut = self.cut or "a message is shorter than its head"
                    return
                channel, sequence, received, published = _MESSAGE.unpack_from(content, body)
                known = self._known.get(channel)
                if known is not None:
                    self.count += 1
                    cdr = view[body + _MESSAGE.size : body + length]
                    yield RawMessage(*known, cdr, received, published, sequence, channel)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    self._learn(opcode, content[body : body + length])
                except (struct.error, UnicodeDecodeError, McapError, ValueError) as error:
                    self.cut = self.cut or f"the description of a topic is damaged ({type(error).__name__})"
                    return
            at = body + length

    def _learn(self, opcode: int, record: bytes) -> None:
        stream = ReadDataStream(BytesIO(record))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self.schema_records[schema.id] = schema
            if schema.encoding == "ros2msg":
                self.schemas[schema.name] = schema.data.decode(errors="replace")
            return
        channel = Channel.read(stream)
        schema_name = self.schema_records[channel.schema_id].name if channel.schema_id in self.schema_records else ""
        self.channels[channel.id] = channel
        self.topics[channel.topic] = schema_name
        if channel.message_encoding == "cdr" or not self.cdr_only:
            self._known[channel.id] = (channel.topic, schema_name)


def read_bag(path: Path) -> Recording:
    """The recording in a bag folder or a bare .mcap file.

    A cut file is read to its last whole message, with a warning in the recording. Raises BadRecording for what is no
    bag.
    """
    builder = RecordingBuilder(str(path))
    warnings: list[str] = []
    files, notes = bag_files(path)
    warnings += notes
    total = 0
    for name in files:
        file = McapFile(name)
        try:
            _read_file(file, builder)
        except BadRecording as error:
            # the last of several files may have been begun and no more
            if len(files) == 1 or file.count:
                raise
            file.cut = f"it {error.limit}"
        total += file.count
        if file.cut:
            warnings.append(f"{name.name} was read up to its message {file.count}: {file.cut}.")
    if total == 0:
        raise BadRecording(str(path), "holds no message", "check that the topics were published while recording")
    recording = builder.recording()
    return Recording(
        recording.joints,
        recording.readings,
        recording.signals,
        recording.robot_description,
        recording.source,
        tuple(warnings) + recording.warnings,
    )


def _read_file(file: McapFile, builder: RecordingBuilder) -> None:
    store = store_with({})
    known = 0
    for raw in file.messages():
        if len(file.schemas) != known:
            known = len(file.schemas)
            store = store_with(file.schemas)
        if raw.type_name not in store.types or raw.type_name.startswith(_SIGNAL_TYPES_LEFT_OUT):
            continue
        try:
            message = store.deserialize_cdr(raw.cdr, raw.type_name)
        except Exception as error:  # the decoder raises whatever the bytes lead it to
            raise BadRecording(
                f"{file.path.name}: message {file.count} on {raw.topic}",
                f"is not a {raw.type_name} ({type(error).__name__})",
                "record again, or leave the topic out",
            ) from error
        builder.add(raw.topic, raw.type_name, message, 1e-9 * raw.received_ns)


def bag_files(path: Path) -> tuple[list[Path], list[str]]:
    """The MCAP files of a bag, in order, and what a person should know of the folder."""
    if not path.exists():
        raise BadRecording(str(path), "does not exist", "give a bag folder or a .mcap file")
    if path.is_file():
        return [path], []
    metadata = path / "metadata.yaml"
    found = sorted(path.glob("*.mcap"), key=lambda p: (len(p.name), p.name))
    if metadata.is_file():
        try:
            information = yaml.safe_load(metadata.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
            names = [path / Path(name).name for name in information["relative_file_paths"]]
        except (yaml.YAMLError, KeyError, TypeError, UnicodeDecodeError) as error:
            raise BadRecording(
                str(metadata), f"is damaged ({type(error).__name__})", "remove it; the .mcap is enough"
            ) from error
        missing = [name for name in names if not name.is_file()]
        if missing:
            raise BadRecording(str(missing[0]), "is named by metadata.yaml but not there", "put the file back")
        if any(name.suffix != ".mcap" for name in names):
            raise BadRecording(str(names[0]), "is not MCAP", "convert it: ros2 bag convert, with storage_id mcap")
        return names, []
    if found:
        return found, [f"{path.name} has no metadata.yaml: the recorder was stopped before it could close the bag."]
    if any(path.glob("*.db3")):
        raise BadRecording(str(path), "is a SQLite bag", "convert it: ros2 bag convert, with storage_id mcap")
    raise BadRecording(str(path), "holds no .mcap file", "give a bag folder or a .mcap file")


def _unpacked(compression: str, content: bytes, size: int) -> bytes:
    """The content of a chunk; of one that is cut, as much as can be had."""
    if compression == "":
        return content
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompressobj().decompress(content)
    if compression == "lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=size)
    raise RuntimeError(f"unknown compression {compression}")


def _other_format(start: bytes) -> str:
    if start.startswith(b"SQLite format 3"):
        return "convert it: ros2 bag convert, with storage_id mcap"
    if start.startswith(b"\x28\xb5\x2f\xfd"):
        return "unpack it first: zstd -d"
    return "give a bag folder or a .mcap file"
