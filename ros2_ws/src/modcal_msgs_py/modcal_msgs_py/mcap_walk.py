"""Walking through an MCAP file, whole or cut.

A file is walked record by record from its beginning, never through the index at its end: an index is missing just when
a recording was cut short, and one way of reading is easier to trust than two. Each chunk's checksum is verified.
Reading stops at the first byte that does not fit; what came before is kept.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Schema
from mcap.summary import Summary
from numpy.typing import NDArray

from modcal_core.errors import BadRecording

MAGIC = b"\x89MCAP0\r\n"
ZSTD = b"\x28\xb5\x2f\xfd"
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
HEAD = np.dtype(  # of a message's record
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("received", "<u8"),
        ("published", "<u8"),
    ]
)
_LOOSE = 1 << 22  # bytes of messages outside of chunks that are taken at once
_MESSAGE_HEAD = 22  # bytes before the CDR bytes that a record counts as its own
_MESSAGE = int(Opcode.MESSAGE)  # looked up for every record
_LOOSE_RECORDS = (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)
_MAX_CHUNK = 1 << 28  # bytes of an unpacked chunk; recorders write some MiB
# What a file may unpack to: nothing that was recorded is packed more than some hundred times as tightly, and a file
# made to fill the memory is packed ten thousand times as tightly.
_MAX_RATIO, _FREE = 400, 1 << 25
_MAX_WINDOW = 1 << 27  # bytes that a zstd decompressor may keep behind it
_TABLES = (".csv", ".tsv", ".txt")  # what instruments and robots export
PADDING = bytes(8)  # behind a block's bytes, for those who read them in words


class RawMessage(NamedTuple):
    """One message as it lies in the file: CDR bytes, and when it was received and published [ns]."""

    topic: str
    type_name: str
    cdr: bytes | memoryview
    received_ns: int
    published_ns: int
    sequence: int
    channel: int


@dataclass(frozen=True)
class Block:
    """Messages that lie in the file one behind the other.

    content: their bytes and more, PADDING at the end. heads: (n,) opcode, length, channel, sequence, received and
    published [ns]. starts, stops: (n,) where the CDR bytes of each stand in the content.
    """

    content: bytes
    heads: NDArray[np.void]
    starts: NDArray[np.int64]
    stops: NDArray[np.int64]


@dataclass
class McapFile:
    """An MCAP file being walked. After the walk, ``cut`` says why it ended early, if it did.

    cdr_only: leave out what is not encoded as ROS 2 encodes. extras: whole attachments and metadata records (bytes
    with opcode and length), as they were met. compression: of the first chunk. known: topic and type by channel.
    offered: QoS profiles by topic, in YAML. share: of the file that has been walked. unread: messages left out by topic
    and encoding.
    """

    path: Path
    cdr_only: bool = True
    schemas: dict[str, str] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    schema_records: dict[int, Schema] = field(default_factory=dict)
    extras: list[tuple[int, bytes]] = field(default_factory=list)
    compression: str | None = None
    count: int = 0
    cut: str | None = None
    known: dict[int, tuple[str, str]] = field(default_factory=dict)
    offered: dict[str, str] = field(default_factory=dict)
    share: float = 0.0
    unread: Counter[tuple[str, str]] = field(default_factory=Counter)
    _unpacked: int = 0
    _is_known: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(1 << 16, bool))

    def messages(self) -> Iterator[RawMessage]:
        """Every whole message, in the order of the file. Raises BadRecording for a file that is not MCAP."""
        for block in self.blocks():
            view = memoryview(block.content)
            for head, start, stop in zip(
                block.heads.tolist(), block.starts.tolist(), block.stops.tolist(), strict=True
            ):
                _, _, channel, sequence, received, published = head
                self.count += 1
                yield RawMessage(*self.known[channel], view[start:stop], received, published, sequence, channel)

    def blocks(self) -> Iterator[Block]:
        """Every whole message, many at once. Raises BadRecording for a file that is not MCAP."""
        size = self.path.stat().st_size
        if size == 0:
            raise BadRecording(str(self.path), "is empty", "record again")
        with self.path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if data[: len(MAGIC)] != MAGIC:
                raise BadRecording(str(self.path), "is not an MCAP file", _other_format(self.path, data[:16]))
            # memoryviews into the map must be gone before it closes, so chunks are copied out of it
            yield from self._walk(data, min(size, len(data)))

    def _walk(self, data: mmap.mmap, size: int) -> Iterator[Block]:
        at = len(MAGIC)
        while at < size:
            self.share = at / size
            if size - at < _RECORD.size:
                self.cut = f"{size - at} bytes at the end are not a record"
                return
            opcode, length = _RECORD.unpack_from(data, at)
            body = at + _RECORD.size
            if not 0x01 <= opcode <= 0x0F and opcode < 0x80:
                self.cut = f"{size - at} bytes from byte {at} are not MCAP records"
                return
            if body + length > size:
                self.cut = f"{size - at} bytes at the end are an unfinished record"
                if opcode == Opcode.CHUNK:
                    yield from self._chunk(data, body, size, whole=False, room=self._room(size))
                return
            at_next = body + length
            if opcode == Opcode.CHUNK:
                yield from self._chunk(data, body, at_next, whole=True, room=self._room(at_next))
            elif opcode in _LOOSE_RECORDS:
                at_next = _end_of_loose(data, at, size)
                yield from self._records(data[at:at_next] + PADDING)
            elif opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
                self.extras.append((opcode, data[at:at_next]))
            elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return
            if self.cut:
                return
            at = at_next
        self.cut = "it ends without an index"

    def _room(self, read: int) -> int:
        """Bytes that may still be unpacked after this many bytes of the file."""
        return max(0, min(_MAX_CHUNK, _FREE + _MAX_RATIO * read - self._unpacked))

    def _chunk(self, data: mmap.mmap, body: int, end: int, whole: bool, room: int) -> Iterator[Block]:
        """The messages of a chunk whose record's content stands between these bytes of the file."""
        try:
            head = data[body : min(end, body + _CHUNK.size + 4)]
            _, _, unpacked_size, crc = _CHUNK.unpack_from(head)
            (name_length,) = struct.unpack_from("<I", head, _CHUNK.size)
            name = body + len(head)
            start = name + name_length + 8
            compression = data[name : min(end, name + name_length)].decode()
            if unpacked_size > room and whole:
                self.cut = f"a chunk of {end - body} bytes declares {unpacked_size}, {room} is the limit"
                return
            content = _unpacked(compression, data, min(start, end), end, min(unpacked_size, room))
        except (struct.error, UnicodeDecodeError, RuntimeError, EOFError, MemoryError, zstandard.ZstdError) as error:
            # of a chunk that is cut already, this says nothing new
            if whole:
                self.cut = f"a chunk cannot be unpacked ({error})"
            return
        size = len(content) - len(PADDING)
        self._unpacked += size
        if whole and (size != unpacked_size or (crc and zlib.crc32(content[:size]) != crc)):
            self.cut = "a chunk's checksum is wrong"
            return
        self.compression = self.compression or compression
        yield from self._records(content)

    def _records(self, content: bytes) -> Iterator[Block]:
        """The messages in these bytes, behind which there is PADDING."""
        found: list[int] = []
        at, size, read = 0, len(content) - len(PADDING), _RECORD.unpack_from
        while at + _RECORD.size <= size:
            opcode, length = read(content, at)
            body = at + _RECORD.size
            if body + length > size:
                self.cut = self.cut or "a chunk ends in the middle of a record"
                break
            if opcode == _MESSAGE:
                if length < _MESSAGE_HEAD:
                    self.cut = self.cut or "a message is shorter than its head"
                    break
                found.append(at)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    self._learn(opcode, content[body : body + length])
                except (struct.error, UnicodeDecodeError, McapError, ValueError) as error:
                    self.cut = self.cut or f"the description of a topic is damaged ({type(error).__name__})"
                    break
            at = body + length
        if not found:
            return
        places = np.array(found, np.int64)
        everywhere = np.ndarray((len(content) - HEAD.itemsize + 1,), f"V{HEAD.itemsize}", content, 0, (1,))
        heads = everywhere[places].view(HEAD)
        known = self._is_known[heads["channel"]]
        if not known.all():
            for channel in heads["channel"][~known].tolist():
                if (of := self.channels.get(channel)) is not None:
                    self.unread[of.topic, of.message_encoding] += 1
            places, heads = places[known], heads[known]
        if len(places):
            starts = places + HEAD.itemsize
            yield Block(content, heads, starts, starts + heads["length"].astype(np.int64) - _MESSAGE_HEAD)

    def _learn(self, opcode: int, record: bytes) -> None:
        stream = ReadDataStream(BytesIO(record))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self.schema_records[schema.id] = schema
            if schema.encoding in ("ros2msg", "ros2idl"):
                self.schemas[schema.name] = schema.data.decode(errors="replace")
            return
        channel = Channel.read(stream)
        schema_name = self.schema_records[channel.schema_id].name if channel.schema_id in self.schema_records else ""
        self.channels[channel.id] = channel
        if channel.message_encoding == "cdr" or not self.cdr_only:
            self.known[channel.id] = (channel.topic, schema_name)
            self._is_known[channel.id] = True


def _end_of_loose(data: mmap.mmap, at: int, size: int) -> int:
    """Where whole messages and descriptions end that begin here, or enough of them."""
    begin = at
    while at + _RECORD.size <= size and at - begin < _LOOSE:
        opcode, length = _RECORD.unpack_from(data, at)
        if opcode not in _LOOSE_RECORDS or at + _RECORD.size + length > size:
            break
        at += _RECORD.size + length
    return at


def _unpacked(compression: str, data: mmap.mmap, start: int, end: int, size: int) -> bytes:
    """The content of a chunk with PADDING behind it; of one that is cut, as much as can be had.

    start, end: where its packed bytes stand in the file. size: that it should have; of what is longer, at most one
    byte more is unpacked, so that it is noticed.
    """
    if compression == "":
        return data[start:end] + PADDING
    if compression == "zstd":
        reader = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(data[start:end])
        return reader.read(size + 1) + PADDING
    if compression == "lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(data[start:end], max_length=size + 1) + PADDING
    raise RuntimeError(f"unknown compression {compression[:20]!r}")


def _other_format(path: Path, start: bytes) -> str:
    if path.suffix.lower() in _TABLES:
        return f"make a bag of a table: modcal import {path} --urdf ROBOT"
    if start.startswith(b"SQLite format 3"):
        return "make its name end in .db3"
    if start.startswith(ZSTD):
        return "make its name end in .mcap.zstd, or unpack it: zstd -d"
    if start.startswith(b"#ROSBAG"):
        return "it is a bag of ROS 1: convert it with rosbags-convert"
    return "give a bag folder or a .mcap file"


def read_index(path: Path) -> Summary | None:
    """The index at the end of a file; None where it has none. Raises ValueError for one that is damaged."""
    try:
        with path.open("rb") as stream:
            stream.seek(-len(MAGIC), os.SEEK_END)
            if stream.read() != MAGIC:
                raise ValueError("the file does not end correctly")
            stream.seek(0)
            return SeekingReader(stream, record_size_limit=path.stat().st_size).get_summary()
    except ValueError:
        raise
    except Exception as error:  # the reader raises whatever the bytes lead it to
        raise ValueError(type(error).__name__) from error
