"""MCAP files that are nearly right.

Records, chunks, definitions and messages are changed one at a time, and put together again.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import lz4.frame
import numpy as np
import zstandard

MAGIC = b"\x89MCAP0\r\n"
CHUNK, SCHEMA, CHANNEL, MESSAGE, INDEX, FOOTER = 6, 3, 4, 5, 7, 2
NUMBERS = (0, 1, 2, 4, 127, 128, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
WORDS = (
    b"float64", b"string", b"float64[]", b"float64[3]", b"uint8[4000000000]", b"Header header", b"string<=5", b"wstring",
    b"my_msgs/Node next", b"Empty[] a", b"bool", b"\n", b"=" * 80 + b"\nMSG: my_msgs/Node\n", b"#", b"[", b"<=", b" = ",
    b"\x1b[31m", b"\xff", b"\x00", b"IDL: a/msg/B\nmodule a {", b"../", b"/joint_states", b"/tf", b"[/red]",
    b"sensor_msgs/msg/JointState", b"geometry_msgs/msg/PoseStamped", b"tf2_msgs/msg/TFMessage", b"std_msgs/msg/String",
)  # fmt: skip
_MIN_SCHEMA = 14  # bytes
Record = tuple[int, bytes]


@dataclass
class Chunk:
    """What a chunk unpacks to, and how it says that it is packed."""

    records: list[Record]
    compression: bytes = b"zstd"
    size: int | None = None
    crc: int | None = 0


def parts(data: bytes) -> list[Record | Chunk]:
    """The records of a whole file, chunks unpacked, without its index."""
    out: list[Record | Chunk] = []
    for opcode, body in _records(data[len(MAGIC) :]):
        if opcode == CHUNK:
            (length,) = struct.unpack_from("<I", body, 28)
            name, packed = body[32 : 32 + length], body[40 + length :]
            content = zstandard.ZstdDecompressor().decompress(packed) if name == b"zstd" else packed
            out.append(Chunk(_records(content), name))
        elif opcode in (FOOTER, 15):
            break
        else:
            out.append((opcode, body))
    return out


def _records(data: bytes) -> list[Record]:
    out, at = [], 0
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        out.append((opcode, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return out


def whole(content: Sequence[Record | Chunk]) -> bytes:
    """A file of these records."""
    out = [MAGIC]
    for part in content:
        if isinstance(part, Chunk):
            data = b"".join(_packed(record) for record in part.records)
            packed = data
            if part.compression == b"zstd":
                packed = zstandard.ZstdCompressor(level=1).compress(data)
            elif part.compression == b"lz4":
                packed = lz4.frame.compress(data)
            size = len(data) if part.size is None else part.size
            crc = zlib.crc32(data) if part.crc is None else part.crc
            head = struct.pack("<QQQI", 0, 0, size, crc) + struct.pack("<I", len(part.compression)) + part.compression
            out.append(_packed((CHUNK, head + struct.pack("<Q", len(packed)) + packed)))
        else:
            out.append(_packed(part))
    return b"".join([*out, _packed((15, bytes(4))), _packed((FOOTER, bytes(20))), MAGIC])


def _packed(record: Record) -> bytes:
    return struct.pack("<BQ", record[0], len(record[1])) + record[1]


def spoilt_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes with something changed: a bit, a number, a word, a piece gone, doubled or random."""
    if not data:
        return bytes(rng.integers(0, 256, int(rng.integers(0, 20)), dtype=np.uint8))
    out = bytearray(data)
    at = int(rng.integers(len(out)))
    kind = int(rng.integers(8))
    if kind == 0:
        out[at] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        width = int(rng.choice((1, 2, 4, 8)))
        number = NUMBERS[int(rng.integers(len(NUMBERS)))]
        out[at : at + width] = (number % 256**width).to_bytes(width, "little")
    elif kind == 2:
        word = WORDS[int(rng.integers(len(WORDS)))]
        out[at : at + (len(word) if rng.integers(2) else 0)] = word
    elif kind == 3:
        del out[at : at + int(rng.integers(1, 40))]
    elif kind == 4:
        out[at:at] = out[at : at + int(rng.integers(1, 40))]
    elif kind == 5:
        special = (np.nan, np.inf, -np.inf, 1e308, -1e-308, 0.0, 1e20)[int(rng.integers(7))]
        at -= at % 4
        out[at : at + 8] = struct.pack("<d", special)
    elif kind == 6:
        out[at:] = b""
    else:
        n = int(rng.integers(1, 9))
        out[at : at + n] = bytes(rng.integers(0, 256, n, dtype=np.uint8))
    return bytes(out)


def case(base: Sequence[Record | Chunk], raw: bytes, rng: np.random.Generator) -> bytes:
    """A file that differs from the base in one to three ways; one in five is the raw file with bytes changed."""
    if rng.integers(5) == 0:
        for _ in range(int(rng.integers(1, 4))):
            raw = spoilt_bytes(raw, rng)
        return raw
    content: list[Record | Chunk] = [
        Chunk(list(part.records), part.compression) if isinstance(part, Chunk) else part for part in base
    ]
    for _ in range(int(rng.integers(1, 4))):
        _CHANGES[int(rng.integers(len(_CHANGES)))](content, rng)
    data = whole(content)
    return data[: int(rng.integers(len(data)))] if rng.integers(12) == 0 else data


def _list(content: list[Record | Chunk], rng: np.random.Generator) -> list:
    chunks = [part for part in content if isinstance(part, Chunk) and part.records]
    return chunks[int(rng.integers(len(chunks)))].records if chunks and rng.integers(6) else content


def _change(content: list[Record | Chunk], rng: np.random.Generator) -> None:
    """Change the bytes of a record, mostly of a message, a definition or a topic."""
    records = _list(content, rng)
    at = int(rng.integers(len(records))) if records else 0
    if records and not isinstance(records[at], Chunk):
        opcode, body = records[at]
        head = 22 if opcode == MESSAGE and rng.integers(4) else 0
        records[at] = opcode, body[:head] + spoilt_bytes(body[head:], rng)


def _definition(content: list[Record | Chunk], rng: np.random.Generator) -> None:
    """Change a definition, and keep the lengths of the record true, so that it is read."""
    for records in [part.records for part in content if isinstance(part, Chunk)]:
        found = [i for i, (opcode, _) in enumerate(records) if opcode == SCHEMA]
        if found:
            i = found[int(rng.integers(len(found)))]
            body = records[i][1]
            if len(body) < _MIN_SCHEMA:  # it was changed before
                return
            (n,) = struct.unpack_from("<I", body, 2)
            if len(body) < 10 + n:
                return
            (e,) = struct.unpack_from("<I", body, 6 + n)
            name, encoding, data = body[6 : 6 + n], body[10 + n : 10 + n + e], body[14 + n + e :]
            which = int(rng.integers(6))
            name = spoilt_bytes(name, rng) if which == 0 else name
            encoding = (b"ros2idl", b"", b"protobuf", b"\x1b")[int(rng.integers(4))] if which == 1 else encoding
            data = spoilt_bytes(data, rng) if which > 1 else data
            texts = b"".join(struct.pack("<I", len(text)) + text for text in (name, encoding, data))
            records[i] = SCHEMA, body[:2] + texts
            return


def _order(content: list[Record | Chunk], rng: np.random.Generator) -> None:
    """Leave a record out, double it, or put it elsewhere."""
    records = _list(content, rng)
    if records:
        i, j = (int(k) for k in rng.integers(len(records), size=2))
        what = int(rng.integers(3))
        if what == 0:
            del records[i]
        elif what == 1:
            records.insert(j, records[i])
        else:
            records[i], records[j] = records[j], records[i]


def _chunk(content: list[Record | Chunk], rng: np.random.Generator) -> None:
    """Let a chunk say another size, checksum or packing."""
    chunks = [part for part in content if isinstance(part, Chunk)]
    if chunks:
        one = chunks[int(rng.integers(len(chunks)))]
        what = int(rng.integers(3))
        if what == 0:
            one.size = NUMBERS[int(rng.integers(len(NUMBERS)))]
        elif what == 1:
            one.crc = int(rng.integers(1, 2**32))
        else:
            one.compression = (b"", b"lz4", b"zstd", b"none", b"\xff")[int(rng.integers(5))]


def _index(content: list[Record | Chunk], rng: np.random.Generator) -> None:
    """Put an index behind a chunk that points anywhere."""
    at = [i for i, part in enumerate(content) if isinstance(part, Chunk)]
    if at:
        n = int(rng.integers(0, 6))
        offsets = [
            NUMBERS[int(k)] if rng.integers(3) == 0 else int(rng.integers(2000)) for k in rng.integers(14, size=n)
        ]
        entries = b"".join(struct.pack("<QQ", 0, offset) for offset in offsets)
        body = struct.pack("<HI", int(rng.integers(5)), len(entries)) + entries
        content.insert(at[int(rng.integers(len(at)))] + 1, (INDEX, body[: int(rng.integers(len(body) + 1))] or body))


_CHANGES: tuple[Callable[[list[Record | Chunk], np.random.Generator], None], ...] = (
    _change, _change, _change, _definition, _definition, _order, _chunk, _index,
)  # fmt: skip
