"""Bags as recordings.

Messages of one topic nearly always have one layout, and are decoded many at once (see ``layout``); those that have not
are decoded one by one.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from modcal_core.errors import BadRecording
from modcal_core.measurements import UNREAD, Listed, Recording, Stretch, elsewhen
from modcal_msgs_py.bag_files import bag_files
from modcal_msgs_py.bag_open import BagFile, bag_file, message_unpacked, topics_of, unpacked
from modcal_msgs_py.layout import Bytes, Fields, MessageLayout, MessageRows, Messages, OneMessage, fields_of, store_with
from modcal_msgs_py.mcap_walk import PADDING, Block, McapFile
from modcal_msgs_py.messages import RecordingBuilder, why_left_out
from modcal_msgs_py.topics import ADDED, Topics, resolve

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

# Of these nothing is a signal: images, what programs log and ask of one another, and what is drawn
_LEFT_OUT = re.compile(
    r"sensor_msgs/msg/(Image|PointCloud2)|(rosgraph|rcl_interfaces|action|actionlib|moveit|visualization|octomap|diagnostic"
    r"|lifecycle|bond)(_msgs)?/|.*(Action(Goal|Result|Feedback)|_(Goal|FeedbackMessage|Request|Response))$"
)
_NO_TOPICS = Topics()
PIECE = 400_000  # joint states; seven minutes at 1 kHz
OVERLAP = 30.0  # s, longer than any station
_MAX_LAYOUTS = 8  # of one topic in one block; more than that, and one by one is quicker
_MAX_KEPT = 64
_NAMED = 3  # topics of other encodings
_FIRST = np.array([len(PADDING)])  # where a message begins behind it


def read_recording(path: Path, topics: Topics = _NO_TOPICS) -> Recording:
    """The recording in a bag folder or a bare file, MCAP or SQLite, packed with zstd or not.

    A cut file is read to its last whole message, with a warning in the recording. topics: what is said of them. Raises
    BadRecording for what is no bag.
    """
    (whole,) = read_pieces(path, None, topics=topics)
    return whole.recording


def read_pieces(
    path: Path,
    most: int | None = PIECE,
    heard: Callable[[float], None] = lambda _: None,
    topics: Topics = _NO_TOPICS,
) -> Iterator[Stretch]:
    """The same recording in pieces of so many joint states, so that it may be longer than memory holds.

    heard: is told the share of the files that has been read.
    Where the clock of the joint states was set back, a piece goes on until the end.
    """
    packed, notes = bag_files(path)
    with unpacked(packed) as files:
        waiting = [bag_file(name) for name in files]
        roles = resolve(_listed(waiting), topics, path.name)
        builder = RecordingBuilder(str(path), roles)
        warnings = list(notes)
        total, since, unread = 0, -np.inf, Counter[tuple[str, str]]()
        for i, name in enumerate(files):
            file = waiting.pop(0)
            try:
                reader = _Reader(file, builder)
                for block in file.blocks():
                    reader.take(block)
                    heard((i + file.share) / len(files))
                    if most is not None and builder.joint_states >= most:
                        recording = builder.recording()
                        if (border := _border(recording)) is not None:
                            stretch, since = Stretch(recording, since, border.stamp), border.stamp
                            builder.forget_before(border.received - OVERLAP)
                            del recording  # not to be held beside the next
                            yield stretch
                            del stretch
            except BadRecording as error:
                # the last of several files may have been begun and no more
                if len(files) == 1 or file.count:
                    raise
                file.cut = f"it {error.limit}"
            total += file.count
            if file.cut:
                warnings.append(f"{name.name} was read up to its message {file.count}: {file.cut}.")
            if isinstance(file, McapFile) and file.unread:
                unread += file.unread
        if unread:
            what, remedy = _unread(unread)
            if total == 0:
                raise BadRecording(str(path), f"holds {what}", remedy)
            warnings.append(f"{UNREAD}{what}: {remedy}.")
        if total == 0:
            why = f" ({file.cut})" if file.cut else ""
            remedy = "check that the topics were published while recording"
            raise BadRecording(str(path), f"holds no message{why}", remedy)
        recording = builder.recording()
    yield Stretch(replace(recording, warnings=(*warnings, *recording.warnings)), since)


def _unread(messages: Counter[tuple[str, str]]) -> tuple[str, str]:
    """What messages of other encodings are, by topic and encoding, and what to do with them."""
    kinds = sorted({encoding for _, encoding in messages})
    names = [topic for (topic, _), _ in messages.most_common(_NAMED)] + ["…"] * (len(messages) > _NAMED)
    said = f"{messages.total()} messages in the encoding {' and '.join(kinds)} on {', '.join(names)}, which is not read"
    table = "write them as a table, which modcal import reads, or record the topics of ROS 2"
    return said, "convert the bag of ROS 1 with rosbags-convert" if kinds == ["ros1"] else table


def list_topics(path: Path) -> tuple[Listed, ...]:
    """The topics of a bag, with the number of their messages. Raises BadRecording for what is no bag."""
    with unpacked(bag_files(path)[0]) as files:
        return _listed([bag_file(name) for name in files])


def _listed(files: list[BagFile]) -> tuple[Listed, ...]:
    """The topics of the files of a bag; of a file that is none, as far as others tell, nothing."""
    counts: dict[tuple[str, str], int] = {}
    for file in files:
        try:
            found = topics_of(file)
        except BadRecording:
            continue  # said when it is read
        for key, count in found.items():
            counts[key] = counts.get(key, 0) + count
    return tuple(Listed(topic, type_name, count) for (topic, type_name), count in counts.items())


class _Border(NamedTuple):
    stamp: float
    received: float


def _border(recording: Recording) -> _Border | None:
    """Where a piece is to end, with an overlap behind it; None where stamps go back, or it is too short for that."""
    joints = max(recording.joints, key=lambda track: len(track.stamps), default=None)
    if joints is None:
        return None
    keep = ~elsewhen(joints.stamps)
    stamps, received = joints.stamps[keep], joints.received[keep]
    if (np.diff(stamps) < 0.0).any() or (np.diff(received) < 0.0).any():
        return None
    row = int(np.searchsorted(received, received[-1] - OVERLAP))
    if received[row] - received[0] < 2.0 * OVERLAP:
        return None
    return _Border(float(stamps[row]), float(received[row]))


class _Reader:
    """Decodes the blocks of one file. layouts: those that were met, by topic.

    A message that cannot be decoded costs itself: it is counted, and said at the end. Topics of no known role are
    signals that an error may depend on; of these nothing is decoded but by layouts, which no definition that a file
    brings along can lead astray.
    """

    def __init__(self, file: BagFile, builder: RecordingBuilder) -> None:
        self._file, self._builder = file, builder
        self._layouts: dict[tuple[str, str], list[MessageLayout]] = {}

    def take(self, block: Block) -> None:
        """Decode a block, topic by topic."""
        block, unreadable = message_unpacked(block)
        if unreadable:
            self._builder.lose("packed topics", "they cannot be unpacked", unreadable)
        channels = np.ascontiguousarray(block.heads["channel"])
        topics: dict[tuple[str, str], list[int]] = {}
        for channel in np.flatnonzero(np.bincount(channels)).tolist():
            topics.setdefault(self._file.known[channel], []).append(channel)
        for (topic, type_name), ids in topics.items():
            which = np.flatnonzero(channels == ids[0] if len(ids) == 1 else np.isin(channels, ids))
            told = self._builder.role(topic, type_name) is not None or not _LEFT_OUT.match(type_name)
            if told and self._builder.reads(topic, type_name):
                self._topic(topic, type_name, block, which)
        self._file.count += len(channels)

    def _topic(self, topic: str, type_name: str, block: Block, which: NDArray[np.int64]) -> None:
        if self._builder.role(topic, type_name) in ADDED:  # a package's, which takes messages one by one
            store = store_with(type_name, self._file.schemas.get(type_name, ""))
            if type_name in store.types:
                self._one_by_one(topic, type_name, block, which, partial(_decoded, store, type_name))
            return
        fields = fields_of(type_name, self._file.schemas)
        if fields is None:
            return
        for piece in _sorted(block, which, fields, self._layouts.setdefault((topic, type_name), [])):
            if piece.layout is not None:
                received = 1e-9 * block.heads["received"][piece.which]
                self._take(topic, type_name, MessageRows(piece.layout, piece.rows), received)
            else:
                self._one_by_one(topic, type_name, block, piece.which, partial(_of_own_layout, fields))

    def _take(self, topic: str, type_name: str, said: Messages, received: NDArray[np.float64]) -> None:
        try:
            self._builder.take(topic, type_name, said, received)
        except BadRecording as error:
            self._builder.lose(topic, why_left_out(error), len(received))

    def _one_by_one(
        self,
        topic: str,
        type_name: str,
        block: Block,
        which: NDArray[np.int64],
        decode: Callable[[bytes], Messages | None],
    ) -> None:
        """decode: None for bytes that are no such message."""
        for i in which.tolist():
            said = decode(bytes(block.content[block.starts[i] : block.stops[i]]))
            if said is not None:
                self._take(topic, type_name, said, np.array([1e-9 * int(block.heads["received"][i])]))
            else:
                self._builder.lose(topic, f"they are not of type {type_name}")


def _decoded(store: Typestore, type_name: str, data: bytes) -> OneMessage | None:
    try:
        return OneMessage(store.deserialize_cdr(data, type_name))
    except Exception:  # the decoder raises whatever the bytes lead it to
        return None


def _of_own_layout(fields: Fields, data: bytes) -> MessageRows | None:
    """A message whose layout changes from one to the next."""
    layout = MessageLayout.of(fields, data)
    if layout is None:
        return None
    return MessageRows(layout, layout.rows(np.frombuffer(PADDING + data + bytes(layout.width), np.uint8), _FIRST))


class _LayoutRun(NamedTuple):
    """Messages of a block in a row (their numbers) that have one layout, as rows; or none."""

    layout: MessageLayout | None
    which: NDArray[np.int64]
    rows: Bytes


def _sorted(block: Block, which: NDArray[np.int64], fields: Fields, met: list[MessageLayout]) -> list[_LayoutRun]:
    """These messages of a block, in their order, by layout.

    met: the layouts of this topic so far; new ones are added.
    """
    if len(met) > _MAX_KEPT:  # texts that change: what was met will not be met again
        met.clear()
    content = np.frombuffer(block.content, np.uint8)
    starts = block.starts[which]
    sizes = block.stops[which] - starts
    number, left = np.full(len(which), -1), np.arange(len(which))
    for i in range(len(met) + _MAX_LAYOUTS):
        if i == len(met):
            first = left[0]
            made = MessageLayout.of(fields, bytes(block.content[starts[first] : starts[first] + sizes[first]]))
            if made is None:
                break
            met.append(made)
        same = left[sizes[left] == met[i].size]
        if len(same):
            rows = met[i].rows(content, starts[same])
            fits = met[i].fits(rows)
            if len(same) == len(which) and fits.all():  # nearly always
                return [_LayoutRun(met[i], which, rows)]
            number[same[fits]] = i
            left = left[number[left] < 0]
        if not len(left):
            break
    ends = np.flatnonzero(np.r_[number[1:] != number[:-1], True]) + 1
    pieces = []
    for start, stop in zip(np.r_[0, ends[:-1]].tolist(), ends.tolist(), strict=True):
        layout = met[number[start]] if number[start] >= 0 else None
        rows = layout.rows(content, starts[start:stop]) if layout else np.empty((0, 0), np.uint8)
        pieces.append(_LayoutRun(layout, which[start:stop], rows))
    return pieces
