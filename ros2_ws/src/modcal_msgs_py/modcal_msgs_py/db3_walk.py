"""Walking through the SQLite file of a bag, as ``mcap_walk`` walks through MCAP: the same blocks of messages."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadRecording
from modcal_msgs_py.mcap_walk import HEAD, PADDING, Block

_MAX_BYTES, _MAX_MESSAGES = 1 << 22, 10_000  # of a block


@dataclass
class Db3File:
    """A SQLite file of a bag being walked; attributes as of :class:`~modcal_msgs_py.mcap_walk.McapFile`."""

    path: Path
    schemas: dict[str, str] = field(default_factory=dict)
    known: dict[int, tuple[str, str]] = field(default_factory=dict)
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
