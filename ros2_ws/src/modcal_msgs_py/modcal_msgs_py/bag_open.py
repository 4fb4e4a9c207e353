"""The files of a bag as something to walk through: MCAP or SQLite, whole files or single messages packed with zstd.

What is packed says how much it will be; it is unpacked no further than anything that was recorded would.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import zstandard

from modcal_core.errors import BadRecording
from modcal_msgs_py.bag_files import bag_files, to_yaml
from modcal_msgs_py.mcap_walk import HEAD, PADDING, ZSTD, Block, McapFile, read_index

_MAX_BYTES, _MAX_MESSAGES = 1 << 22, 10_000  # of a block


@dataclass
class Db3File:
    """A SQLite file of a bag being walked; attributes as of :class:`~modcal_msgs_py.mcap_walk.McapFile`."""

    path: Path
    schemas: dict[str, str] = field(default_factory=dict)
    known: dict[int, tuple[str, str]] = field(default_factory=dict)
    offered: dict[str, str] = field(default_factory=dict)
    count: int = 0
    cut: str | None = None
    share: float = 0.0
    _reader: Any = None  # kept for the walk: opening counts all messages

    def topics(self) -> dict[tuple[str, str], int]:
        """How many messages there are by topic and type. Raises BadRecording for a file that is no bag."""
        self._reader = self._reader or self._opened()
        out: dict[tuple[str, str], int] = {}
        for c in _named(self._reader):
            out[c.topic, c.msgtype] = out.get((c.topic, c.msgtype), 0) + c.msgcount
            profiles = [{"depth": q.depth, **{k: getattr(q, k).name.lower() for k in ("reliability", "durability")}}
                        for q in c.ext.offered_qos_profiles]  # fmt: skip
            self.offered[c.topic] = to_yaml(profiles) if profiles else ""
        return out

    def blocks(self) -> Iterator[Block]:
        """Every message, many at once, in the order of reception. Raises BadRecording for a file that is no bag."""
        opened, self._reader = self._reader or self._opened(), None
        with closing(opened) as reader:
            connections = [c for c in _named(reader) if c.ext.serialization_format == "cdr"]
            number = {c.id: i for i, c in enumerate(connections[: 1 << 16])}
            self.known = {i: (connections[i].topic, connections[i].msgtype) for i in number.values()}
            texts = {c.msgtype: c.msgdef.data for c in connections if c.msgdef.data}
            self.schemas = {name: text for name, text in texts.items() if isinstance(text, str)}
            total = sum(c.msgcount for c in connections)
            rows: list[tuple[int, int, bytes]] = []
            size = 0
            done = 0
            # message by message, so that what comes before a damaged page is kept
            messages = reader.messages(connections) if connections else iter(())
            while True:
                try:
                    connection, received, data = next(messages)
                except StopIteration:
                    break
                except Exception as error:  # whatever a damaged database leads to
                    self.cut = f"the database is damaged ({type(error).__name__})"
                    break
                done += 1
                if connection.id not in number or not isinstance(data, bytes) or not 0 <= received < 1 << 63:
                    continue
                rows.append((number[connection.id], received, data))
                size += len(data)
                if size > _MAX_BYTES or len(rows) >= _MAX_MESSAGES:
                    self.share = min(1.0, done / max(total, 1))
                    yield block_of(rows)
                    rows, size = [], 0
            if rows:
                yield block_of(rows)

    def _opened(self) -> Any:
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader  # few bags are SQLite

        reader = Sqlite3Reader(self.path)
        try:
            reader.open()
        except Exception as error:  # a database says in many ways that it is none
            said = f"cannot be read as a SQLite bag ({type(error).__name__})"
            raise BadRecording(str(self.path), said, "convert it: ros2 bag convert, or record again") from error
        return reader


def _named(reader: Any) -> list[Any]:
    """The connections of a database whose topic and type are texts; a cell may hold anything."""
    return [c for c in reader.connections if isinstance(c.topic, str) and isinstance(c.msgtype, str)]


def block_of(rows: list[tuple[int, int, bytes]]) -> Block:
    """A block of messages: channel, time of reception [ns] and bytes of each."""
    sizes = np.array([len(data) for _, _, data in rows], np.int64)
    stops = len(PADDING) + np.cumsum(sizes)
    heads = np.zeros(len(rows), HEAD)
    heads["channel"] = [channel for channel, _, _ in rows]
    heads["received"] = heads["published"] = [received for _, received, _ in rows]
    return Block(PADDING + b"".join(data for _, _, data in rows) + PADDING, heads, stops - sizes, stops)


PACKED = (".zstd", ".zst")
_MAX_RATIO, _FREE = 400, 1 << 25  # as of a chunk
_MAX_MESSAGE = 1 << 26  # bytes of one unpacked message
_PIECE = 1 << 20

BagFile: TypeAlias = McapFile | Db3File


def bag_file(path: Path) -> BagFile:
    """A file of a bag, opened by its first bytes and its name."""
    with path.open("rb") as stream:
        start = stream.read(16)
    if path.suffix == ".db3" or start.startswith(b"SQLite format 3"):
        return Db3File(path)
    return McapFile(path)


@contextmanager
def unpacked(files: list[Path]) -> Iterator[list[Path]]:
    """The files with those that are packed as a whole unpacked beside the others, while the block lasts.

    Raises BadRecording for a file that cannot be unpacked, or that would fill the disk.
    """
    if not any(file.suffix in PACKED for file in files):
        yield files
        return
    folder = Path(tempfile.mkdtemp(prefix="modcal-"))
    try:
        yield [_unpacked(file, folder / f"{i}" / file.stem) if file.suffix in PACKED else file
               for i, file in enumerate(files)]  # fmt: skip
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _unpacked(file: Path, out: Path) -> Path:
    out.parent.mkdir()
    limit = min(_FREE + _MAX_RATIO * file.stat().st_size, shutil.disk_usage(out.parent).free // 2)
    written = 0
    try:
        with file.open("rb") as source, out.open("wb") as target:
            stream = zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(source)
            while piece := stream.read(_PIECE):
                written += len(piece)
                if written > limit:
                    raise BadRecording(str(file), f"unpacks to more than {limit} bytes", "unpack it by hand: zstd -d")
                target.write(piece)
    except zstandard.ZstdError as error:
        if not written:
            raise BadRecording(str(file), f"cannot be unpacked ({error})", "give the file as it was written") from error
    return out


def message_unpacked(block: Block) -> tuple[Block, int]:
    """The block with its messages unpacked, where single messages were packed, and how many could not be."""
    content = np.frombuffer(block.content, np.uint8)
    if not (content[block.starts] == ZSTD[0]).any():  # CDR begins with a zero
        return block, 0
    rows, lost = [], 0
    room = _FREE + _MAX_RATIO * len(content)
    decompressor = zstandard.ZstdDecompressor(max_window_size=1 << 27)
    for head, start, stop in zip(block.heads, block.starts.tolist(), block.stops.tolist(), strict=True):
        data = block.content[start:stop]
        if data.startswith(ZSTD):
            try:
                limit = min(room, _MAX_MESSAGE)
                data = decompressor.stream_reader(data).read(limit + 1)
            except zstandard.ZstdError:
                data = b""
            room -= len(data)
            if not data or len(data) > limit:
                lost += 1
                continue
        rows.append((int(head["channel"]), int(head["received"]), data))
    return block_of(rows), lost


class PackedMessage(NamedTuple):
    """A message as it lies in a bag. definition: of its type, as the bag states it."""

    topic: str
    type_name: str
    definition: str
    received_ns: int
    cdr: bytes


def packed_messages(
    path: Path,
    topics: Collection[str],
    heard: Callable[[float], None] = lambda share: None,
    said: Callable[[str], None] = lambda text: None,
) -> Iterator[PackedMessage]:
    """Every message of these topics, as the files have them. heard: is told the share that has been read. said: is told
    what cannot be read.
    """
    packed, _ = bag_files(path)
    with unpacked(packed) as files:
        for i, name in enumerate(files):
            file, lost = bag_file(name), 0
            for whole in file.blocks():
                block, unreadable = message_unpacked(whole)
                lost += unreadable
                for head, start, stop in zip(block.heads, block.starts.tolist(), block.stops.tolist(), strict=True):
                    topic, type_name = file.known[int(head["channel"])]
                    if topic in topics:
                        definition, received = file.schemas.get(type_name, ""), int(head["received"])
                        yield PackedMessage(topic, type_name, definition, received, block.content[start:stop])
                heard((i + file.share) / len(files))
            if lost:
                said(f"{name.name}: {lost} packed messages cannot be unpacked")
            if file.cut:
                said(f"{name.name} was read as far as it goes: {file.cut}")


def topics_of(file: BagFile) -> dict[tuple[str, str], int]:
    """How many messages a file has by topic and type: by its index, or else by walking through all of it.

    Sets what the file states of their QoS, ``offered``.
    """
    if isinstance(file, Db3File):
        return file.topics()
    try:
        index = read_index(file.path)
    except (ValueError, OSError):
        index = None
    said = index and index.statistics
    if index and said and said.message_count == sum(said.channel_message_counts.get(c, 0) for c in index.channels) > 0:
        channels, schemas, counts = index.channels, index.schemas, said.channel_message_counts
    else:
        walked, counts = McapFile(file.path), dict[int, int]()
        for block in walked.blocks():
            for channel, count in enumerate(np.bincount(block.heads["channel"]).tolist()):
                counts[channel] = counts.get(channel, 0) + count
        channels, schemas = walked.channels, walked.schema_records
    out: dict[tuple[str, str], int] = {}
    for one in channels.values():
        key = one.topic, schemas[one.schema_id].name if one.schema_id in schemas else ""
        out[key] = out.get(key, 0) + counts.get(one.id, 0)
        file.offered[one.topic] = one.metadata.get("offered_qos_profiles", "")
    return out
