"""The index at the end of an MCAP file: which topics there are, and what the file says of its own size.

It is a hint only: what is read of a file is what stands in it (see ``mcap_walk``). Nothing is unpacked here.
"""

from __future__ import annotations

import mmap
import struct
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_FOOTER = struct.Struct("<BQQQI")
_MAX_RECORDS = 1_000_000


@dataclass
class Index:
    """What a summary says. topics: number of messages by topic and type, 0 where it is not counted.

    messages, chunks: as it counts them, None where it does not; listed: chunks that it lists.
    """

    topics: dict[tuple[str, str], int] = field(default_factory=dict)
    messages: int | None = None
    chunks: int | None = None
    listed: int = 0


def read_index(path: Path) -> Index | None:
    """The index of a file; None where it has none. Raises ValueError for one that is damaged."""
    with path.open("rb") as stream:
        try:
            data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        except ValueError:  # of an empty file
            return None
        with data:
            try:
                return _index(data)
            except (McapError, struct.error, KeyError, MemoryError) as error:
                raise ValueError(type(error).__name__) from error


def _index(data: mmap.mmap) -> Index | None:
    end = len(data) - len(_MAGIC) - _FOOTER.size
    if end < len(_MAGIC) or data[-len(_MAGIC) :] != _MAGIC:
        raise ValueError("the file does not end correctly")
    opcode, length, at, _, _ = _FOOTER.unpack_from(data, end)
    if opcode != Opcode.FOOTER or length != _FOOTER.size - _RECORD.size:
        raise ValueError("the file does not end correctly")
    if at == 0:
        return None
    if not len(_MAGIC) <= at <= end:
        raise ValueError("it begins outside of the file")
    out, schemas, channels = Index(), {0: ""}, {}
    counts: dict[int, int] = {}
    for _ in range(_MAX_RECORDS):
        if at + _RECORD.size > end:
            break
        opcode, length = _RECORD.unpack_from(data, at)
        body, at = at + _RECORD.size, at + _RECORD.size + length
        if at > end:
            raise ValueError("a record goes beyond its end")
        if opcode == Opcode.CHUNK_INDEX:
            out.listed += 1
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
            record = ReadDataStream(BytesIO(data[body:at]))
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(record)
                schemas[schema.id] = schema.name
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(record)
                channels[channel.id] = channel
            else:
                stated = Statistics.read(record)
                out.messages, out.chunks = stated.message_count, stated.chunk_count
                counts = stated.channel_message_counts
    for channel in channels.values():
        key = (channel.topic, schemas.get(channel.schema_id, ""))
        out.topics[key] = out.topics.get(key, 0) + counts.get(channel.id, 0)
    return out
