"""Bags as recordings.

Messages of one topic nearly always have one layout, and are decoded many at once (see ``layout``); those that have
not, or whose type is not plain numbers and texts, are decoded one by one. Both ways give the same recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from modcal_core.errors import BadRecording
from modcal_core.measurements.recording import Piece, Recording
from modcal_msgs_py.bag_files import bag_files
from modcal_msgs_py.fields import fields_of
from modcal_msgs_py.layout import Bytes, Fields, Layout
from modcal_msgs_py.mcap_walk import Block, McapFile
from modcal_msgs_py.messages import RecordingBuilder
from modcal_msgs_py.topics import ADDED, role_of

_LEFT_OUT = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/PointCloud2",
    "rosgraph_msgs/msg/Clock",
    "tf2_msgs/msg/",
)
PIECE = 400_000  # joint states; seven minutes at 1 kHz
OVERLAP = 30.0  # s, longer than any station
_MOST_LAYOUTS = 8  # of one topic in one block; more than that, and one by one is quicker
_MOST_KEPT = 64
_SHORTEST_RUN = 4  # messages of one layout in a row, on the average, below which one by one is quicker


def read_bag(path: Path, layouts: bool = True) -> Recording:
    """The recording in a bag folder or a bare .mcap file.

    A cut file is read to its last whole message, with a warning in the recording. layouts: False decodes all messages
    one by one, which gives the same. Raises BadRecording for what is no bag.
    """
    (whole,) = read_pieces(path, None, layouts)
    return whole.recording


def read_pieces(
    path: Path, most: int | None = PIECE, layouts: bool = True, heard: Callable[[float], None] = lambda _: None
) -> Iterator[Piece]:
    """The same recording in pieces of so many joint states, so that it may be longer than memory holds.

    heard: is told the share of the files that has been read.
    Where the clock of the joint states was set back, a piece goes on until the end.
    """
    builder = RecordingBuilder(str(path))
    warnings: list[str] = []
    files, notes = bag_files(path)
    warnings += notes
    total, since = 0, -np.inf
    for i, name in enumerate(files):
        file = McapFile(name)
        try:
            reader = _Reader(file, builder, layouts)
            for block in file.blocks():
                reader.take(block)
                heard((i + file.share) / len(files))
                if most is not None and builder.joint_states >= most:
                    recording = builder.recording()
                    if (border := _border(recording)) is not None:
                        yield Piece(recording, since, border.stamp)
                        since = border.stamp
                        builder.forget_before(border.received - OVERLAP)
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
    yield Piece(replace(recording, warnings=(*warnings, *recording.warnings)), since)


class _Border(NamedTuple):
    stamp: float
    received: float


def _border(recording: Recording) -> _Border | None:
    """Where a piece is to end, with an overlap behind it; None where stamps go back, or it is too short for that."""
    joints = max(recording.joints, key=lambda track: len(track.stamps))
    if (np.diff(joints.stamps) < 0.0).any() or (np.diff(joints.received) < 0.0).any():
        return None
    row = int(np.searchsorted(joints.received, joints.received[-1] - OVERLAP))
    if joints.received[row] - joints.received[0] < 2.0 * OVERLAP:
        return None
    return _Border(float(joints.stamps[row]), float(joints.received[row]))


class _Reader:
    """Decodes the blocks of one file. layouts: those that were met, by topic."""

    def __init__(self, file: McapFile, builder: RecordingBuilder, layouts: bool) -> None:
        self._file, self._builder = file, builder
        self._use_layouts = layouts
        self._layouts: dict[tuple[str, str], list[Layout]] = {}

    def take(self, block: Block) -> None:
        """Decode a block, topic by topic."""
        channels = np.ascontiguousarray(block.heads["channel"])
        topics: dict[tuple[str, str], list[int]] = {}
        for channel in np.flatnonzero(np.bincount(channels)).tolist():
            topics.setdefault(self._file.known[channel], []).append(channel)
        for (topic, type_name), ids in topics.items():
            which = np.flatnonzero(channels == ids[0] if len(ids) == 1 else np.isin(channels, ids))
            if not type_name.startswith(_LEFT_OUT):
                self._topic(topic, type_name, block, which)
        self._file.count += len(channels)

    def _topic(self, topic: str, type_name: str, block: Block, which: NDArray[np.int64]) -> None:
        own = role_of(topic, type_name) in ADDED  # a package's, which takes messages one by one
        fields = fields_of(type_name, self._file.schemas) if self._use_layouts and not own else None
        met = self._layouts.setdefault((topic, type_name), [])
        pieces = [] if fields is None else _sorted(block, which, fields, met)
        if not pieces:
            self._one_by_one(topic, type_name, block, which)
        for piece in pieces:
            if piece.layout is None:
                self._one_by_one(topic, type_name, block, piece.which)
            else:
                received = 1e-9 * block.heads["received"][piece.which]
                self._builder.add_rows(topic, type_name, piece.layout, piece.rows, received)

    def _one_by_one(self, topic: str, type_name: str, block: Block, which: NDArray[np.int64]) -> None:
        from modcal_msgs_py.types import store_with  # reading the definitions of all types takes half a second

        store = store_with(self._file.schemas)
        if type_name not in store.types:
            return
        for i in which.tolist():
            try:
                message = store.deserialize_cdr(bytes(block.content[block.starts[i] : block.stops[i]]), type_name)
            except Exception as error:  # the decoder raises whatever the bytes lead it to
                raise BadRecording(
                    f"{self._file.path.name}: message {self._file.count + i + 1} on {topic}",
                    f"is not a {type_name} ({type(error).__name__})",
                    "record again, or leave the topic out",
                ) from error
            self._builder.add(topic, type_name, message, 1e-9 * int(block.heads["received"][i]))


class _Piece(NamedTuple):
    """Messages of a block in a row (their numbers) that have one layout, as rows; or none."""

    layout: Layout | None
    which: NDArray[np.int64]
    rows: Bytes


def _sorted(block: Block, which: NDArray[np.int64], fields: Fields, met: list[Layout]) -> list[_Piece]:
    """These messages of a block, in their order, by layout; nothing where that does not pay.

    met: the layouts of this topic so far; new ones are added.
    """
    if len(met) > _MOST_KEPT:  # texts that change: what was met will not be met again
        met.clear()
    content = np.frombuffer(block.content, np.uint8)
    starts = block.starts[which]
    sizes = block.stops[which] - starts
    number, left = np.full(len(which), -1), np.arange(len(which))
    for i in range(len(met) + _MOST_LAYOUTS):
        if i == len(met):
            first = left[0]
            made = Layout.of(fields, bytes(block.content[starts[first] : starts[first] + sizes[first]]))
            if made is None:
                break
            met.append(made)
        same = left[sizes[left] == met[i].size]
        if len(same):
            rows = met[i].rows(content, starts[same])
            fits = met[i].fits(rows)
            if len(same) == len(which) and fits.all():  # nearly always
                return [_Piece(met[i], which, rows)]
            number[same[fits]] = i
            left = left[number[left] < 0]
        if not len(left):
            break
    ends = np.flatnonzero(np.r_[number[1:] != number[:-1], True]) + 1
    if len(ends) * _SHORTEST_RUN > len(which) + _SHORTEST_RUN:
        return []
    pieces = []
    for start, stop in zip(np.r_[0, ends[:-1]].tolist(), ends.tolist(), strict=True):
        layout = met[number[start]] if number[start] >= 0 else None
        rows = layout.rows(content, starts[start:stop]) if layout else np.empty((0, 0), np.uint8)
        pieces.append(_Piece(layout, which[start:stop], rows))
    return pieces
