"""Data, texts, bytes and MCAP files that are nearly right: what is good is changed in one to three ways."""

from __future__ import annotations

import copy
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import lz4.frame
import numpy as np
import zstandard

VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 3, 2**31, 2**64, 10**400, -0.0, 1e-300, 1e300, float("nan"), float("inf"), "", "x", " ",
    "nan", "1e9", "\x1b[31m", "{", "{0}", "{stem}", "../../x", "*", "a" * 3000, [], {}, [[]], [{}], [1, 2], [1.0, 2.0, 3.0],
    ["x", "y", "z"], {"a": 1}, {"x": {}}, [0.0] * 7, [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
    [float("nan")] * 3, "2001-01-01", b"x", (1, 2), {1: 2}, {None: None},
)  # fmt: skip
MAGIC = b"\x89MCAP0\r\n"
CHUNK, SCHEMA, CHANNEL, MESSAGE, INDEX, FOOTER, END = 6, 3, 4, 5, 7, 2, 15
NUMBERS = (0, 1, 2, 4, 127, 128, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
SPECIAL = (np.nan, np.inf, -np.inf, 1e308, -1e-308, 0.0, 1e20)
WORDS = (
    b"float64", b"string", b"float64[]", b"float64[3]", b"uint8[4000000000]", b"Header header", b"string<=5", b"wstring",
    b"my_msgs/Node next", b"Empty[] a", b"bool", b"\n", b"=" * 80 + b"\nMSG: my_msgs/Node\n", b"#", b"[", b"<=", b" = ",
    b"\x1b[31m", b"\xff", b"\x00", b"IDL: a/msg/B\nmodule a {", b"../", b"/joint_states", b"/tf", b"[/red]",
    b"sensor_msgs/msg/JointState", b"geometry_msgs/msg/PoseStamped", b"tf2_msgs/msg/TFMessage", b"std_msgs/msg/String",
)  # fmt: skip
Way = tuple[Any, ...]
Record = tuple[int, bytes]


def one_of(values: Sequence[Any], rng: np.random.Generator) -> Any:
    return values[int(rng.integers(len(values)))]


def places(data: Any, way: Way = ()) -> list[Way]:
    """The ways to every value, but in long lists to the first and last few."""
    out, items = [], []
    if isinstance(data, dict):
        items = list(data.items())
    elif isinstance(data, list):
        items = [(i, data[i]) for i in range(len(data)) if i < 3 or i > len(data) - 2]
    for key, value in items:
        out += [(*way, key), *places(value, (*way, key))]
    return out


def data_case(base: Any, ways: list[Way], rng: np.random.Generator) -> Any:
    """The data with one to three values changed, left out, doubled, or put under another key."""
    data = copy.deepcopy(base)
    for _ in range(1 if rng.integers(3) else int(rng.integers(2, 4))):
        way = one_of(ways, rng)
        place: Any = data
        try:
            for key in way[:-1]:
                place = place[key]
            key, what = way[-1], int(rng.integers(6))
            if what == 0:
                del place[key]
            elif what == 1 and isinstance(place, dict):
                place[str(rng.integers(100)) if rng.integers(2) else f"{key}s"] = place.pop(key)
            elif what == 1:
                place.insert(0, place[key])
            elif what == 2:
                value: Any = base
                for step in one_of(ways, rng):
                    value = value[step]
                place[key] = copy.deepcopy(value)
            else:
                place[key] = copy.deepcopy(one_of(VALUES, rng))
        except (KeyError, IndexError, TypeError, AttributeError):
            continue  # what was to be changed was changed before
    return data


def text_case(base: str, words: Sequence[str], rng: np.random.Generator) -> str:
    """The text with pieces left out, doubled, moved, or words put in."""
    out = base
    for _ in range(int(rng.integers(1, 4))):
        i, j = sorted(int(k) for k in rng.integers(len(out) + 1, size=2))
        j = min(j, i + int(rng.integers(1, 120)))
        what = int(rng.integers(5))
        if what == 0:
            out = out[:i] + out[j:]
        elif what == 1:
            out = out[:j] + out[i:j] + out[j:]
        elif what in (2, 3):
            out = out[:i] + one_of(words, rng) + out[i if what == 2 else j :]
        else:
            out = out[:i] + chr(int(rng.integers(1, 300))) + out[i + 1 :]
    return out


def spoilt(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes with something changed: a bit, a number, a word, a piece gone, doubled or random."""
    if not data:
        return bytes(rng.integers(0, 256, int(rng.integers(0, 20)), dtype=np.uint8))
    at, kind, new, end = int(rng.integers(len(data))), int(rng.integers(8)), b"", 0
    if kind == 0:
        new, end = bytes([data[at] ^ 1 << int(rng.integers(8))]), 1
    elif kind == 1:
        end = int(rng.choice((1, 2, 4, 8)))
        new = (one_of(NUMBERS, rng) % 256**end).to_bytes(end, "little")
    elif kind == 2:
        new = one_of(WORDS, rng)
        end = len(new) if rng.integers(2) else 0
    elif kind == 3:
        end = int(rng.integers(1, 40))
    elif kind == 4:
        new = data[at : at + int(rng.integers(1, 40))]
    elif kind == 5:
        new, end, at = struct.pack("<d", one_of(SPECIAL, rng)), 8, at - at % 4
    elif kind == 6:
        end = len(data)
    else:
        end = int(rng.integers(1, 9))
        new = bytes(rng.integers(0, 256, end, dtype=np.uint8))
    return data[:at] + new + data[at + end :]


@dataclass
class Chunk:
    """What a chunk unpacks to, and how it says that it is packed."""

    records: list[Record]
    compression: bytes = b"zstd"
    size: int | None = None
    crc: int | None = 0


Part = Record | Chunk


def records_of(data: bytes) -> list[Record]:
    out, at = [], 0
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        out.append((opcode, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return out


def parts(data: bytes) -> list[Part]:
    """The records of a whole file, chunks unpacked, without its index."""
    out: list[Part] = []
    for opcode, body in records_of(data[len(MAGIC) :]):
        if opcode in (FOOTER, END):
            break
        if opcode == CHUNK:
            (length,) = struct.unpack_from("<I", body, 28)
            name, packed = body[32 : 32 + length], body[40 + length :]
            content = zstandard.ZstdDecompressor().decompress(packed) if name == b"zstd" else packed
            out.append(Chunk(records_of(content), name))
        else:
            out.append((opcode, body))
    return out


def whole(content: Sequence[Part]) -> bytes:
    out = [MAGIC]
    for part in content:
        if isinstance(part, Chunk):
            packed = data = b"".join(_packed(record) for record in part.records)
            if part.compression == b"zstd":
                packed = zstandard.ZstdCompressor(level=1).compress(data)
            elif part.compression == b"lz4":
                packed = lz4.frame.compress(data)
            size = len(data) if part.size is None else part.size
            crc = zlib.crc32(data) if part.crc is None else part.crc
            head = struct.pack("<QQQII", 0, 0, size, crc, len(part.compression)) + part.compression
            part = CHUNK, head + struct.pack("<Q", len(packed)) + packed
        out.append(_packed(part))
    return b"".join([*out, _packed((END, bytes(4))), _packed((FOOTER, bytes(20))), MAGIC])


def _packed(record: Record) -> bytes:
    return struct.pack("<BQ", record[0], len(record[1])) + record[1]


def mcap_case(base: Sequence[Part], raw: bytes, rng: np.random.Generator) -> bytes:
    """A file that differs from the base in one to three ways; one in five is the raw file with bytes changed."""
    if rng.integers(5) == 0:
        for _ in range(int(rng.integers(1, 4))):
            raw = spoilt(raw, rng)
        return raw
    content = [Chunk(list(part.records), part.compression) if isinstance(part, Chunk) else part for part in base]
    for _ in range(int(rng.integers(1, 4))):
        one_of((_change, _change, _change, _definition, _definition, _order, _chunk, _index), rng)(content, rng)
    data = whole(content)
    return data[: int(rng.integers(len(data)))] if rng.integers(12) == 0 else data


def _list(content: list[Part], rng: np.random.Generator) -> list[Any]:
    chunks = [part for part in content if isinstance(part, Chunk) and part.records]
    return one_of(chunks, rng).records if chunks and rng.integers(6) else content


def _change(content: list[Part], rng: np.random.Generator) -> None:
    """Change the bytes of a record, mostly of a message, a definition or a topic."""
    records = _list(content, rng)
    at = int(rng.integers(len(records))) if records else 0
    if records and not isinstance(records[at], Chunk):
        opcode, body = records[at]
        head = 22 if opcode == MESSAGE and rng.integers(4) else 0
        records[at] = opcode, body[:head] + spoilt(body[head:], rng)


def _definition(content: list[Part], rng: np.random.Generator) -> None:
    """Change a definition, and keep the lengths of the record true, so that it is read."""
    for records in [part.records for part in content if isinstance(part, Chunk)]:
        if found := [i for i, (opcode, _) in enumerate(records) if opcode == SCHEMA]:
            i = one_of(found, rng)
            body = records[i][1]
            n = struct.unpack_from("<I", body, 2)[0] if len(body) >= 14 else len(body)
            if len(body) < 10 + n:  # it was changed before
                return
            (e,) = struct.unpack_from("<I", body, 6 + n)
            name, encoding, data = body[6 : 6 + n], body[10 + n : 10 + n + e], body[14 + n + e :]
            which = int(rng.integers(6))
            name = spoilt(name, rng) if which == 0 else name
            encoding = one_of((b"ros2idl", b"", b"protobuf", b"\x1b"), rng) if which == 1 else encoding
            data = spoilt(data, rng) if which > 1 else data
            records[i] = SCHEMA, body[:2] + b"".join(struct.pack("<I", len(t)) + t for t in (name, encoding, data))
            return


def _order(content: list[Part], rng: np.random.Generator) -> None:
    if records := _list(content, rng):
        i, j = (int(k) for k in rng.integers(len(records), size=2))
        what = int(rng.integers(3))
        if what == 0:
            del records[i]
        elif what == 1:
            records.insert(j, records[i])
        else:
            records[i], records[j] = records[j], records[i]


def _chunk(content: list[Part], rng: np.random.Generator) -> None:
    """Let a chunk say another size, checksum or packing."""
    if chunks := [part for part in content if isinstance(part, Chunk)]:
        chunk = one_of(chunks, rng)
        what = int(rng.integers(3))
        if what == 0:
            chunk.size = one_of(NUMBERS, rng)
        elif what == 1:
            chunk.crc = int(rng.integers(1, 2**32))
        else:
            chunk.compression = one_of((b"", b"lz4", b"zstd", b"none", b"\xff"), rng)


def _index(content: list[Part], rng: np.random.Generator) -> None:
    """Put an index behind a chunk that points anywhere."""
    if at := [i for i, part in enumerate(content) if isinstance(part, Chunk)]:
        picked = rng.integers(14, size=int(rng.integers(0, 6)))
        offsets = [NUMBERS[int(k)] if rng.integers(3) == 0 else int(rng.integers(2000)) for k in picked]
        entries = b"".join(struct.pack("<QQ", 0, offset) for offset in offsets)
        body = struct.pack("<HI", int(rng.integers(5)), len(entries)) + entries
        content.insert(one_of(at, rng) + 1, (INDEX, body[: int(rng.integers(len(body) + 1))] or body))
