"""Many messages of one layout at once: where the numbers stand in the bytes, and which bytes must be the same.

Messages of one topic nearly always look alike: the same joints, the same frame, the same lengths. Then every number
stands at the same place, and a column of numbers is one view into the bytes. What may vary besides the numbers
(counts, texts) is compared with the message that the layout was made from; one that differs has a layout of its own.

A type is told by its fields: ``(name, kind)`` where the kind is the type of a number as NumPy writes it (``f8``),
``string``, a list of fields, or ``[kind]`` with a count: ``Many(kind, n)``, n None where the message says how many.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

_MAX_STEPS = 20_000  # fields of one message that are looked at; more, and it has no layout
_MAX_GAPS = 16  # between numbers, that are compared one by one; where there are more, word by word is quicker
_HEAD = 4  # bytes that say how the rest is encoded; alignment counts from there


@dataclass(frozen=True)
class Many:
    """Several of one kind: ``count`` of them, or as many as the message says (None)."""

    kind: Kind
    count: int | None = None


Bytes: TypeAlias = NDArray[np.uint8]
Fields: TypeAlias = "Sequence[tuple[str, Kind]]"
Kind: TypeAlias = "str | Many | Fields"


@dataclass(frozen=True)
class Column:
    """Numbers of one field. many: whether it is an array, if only of one number."""

    dtype: str
    at: int
    count: int
    many: bool


@dataclass
class MessageLayout:
    """Where everything stands in messages of ``size`` bytes. columns, texts: by path, such as ``pose/position/x``.

    counts: how many fields that are not numbers (texts, messages) there are, by path.
    """

    size: int
    columns: dict[str, Column] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    _fixed: list[tuple[int, int]] = field(default_factory=list)
    _same: NDArray[np.uint64] | None = None
    _mask: NDArray[np.uint64] | None = None
    _gaps: list[tuple[int, bytes]] | None = None

    @classmethod
    def of(cls, fields: Fields, sample: bytes) -> MessageLayout | None:
        """The layout of a message of these fields; None for bytes that are no such message, or not plain CDR."""
        if len(sample) < _HEAD or sample[0] != 0 or sample[1] not in (0, 1):
            return None
        made = cls(len(sample))
        try:
            end = _LayoutWalk(made, sample, "<" if sample[1] else ">").fields(fields, "", _HEAD)
        except (struct.error, UnicodeDecodeError, ValueError):
            return None
        if not len(sample) - 3 <= end <= len(sample):
            return None
        made._fixed.append((0, 2))
        made._compare(sample)
        return made

    def _compare(self, sample: bytes) -> None:
        """Remember the bytes that must be the same, in words of eight."""
        mask = np.zeros(self.width, np.uint8)
        for start, stop in self._fixed:
            mask[_HEAD + start : _HEAD + stop] = 0xFF
        same = np.zeros(self.width, np.uint8)
        same[_HEAD : _HEAD + self.size] = np.frombuffer(sample, np.uint8)
        words = np.flatnonzero(mask.view(np.uint64))
        self._words = slice(words[0], words[-1] + 1)
        self._mask = mask.view(np.uint64)[self._words]
        self._same = same.view(np.uint64)[self._words] & self._mask
        ends = [(c.at, c.at + c.count * np.dtype(c.dtype).itemsize) for c in self.columns.values() if c.count]
        numbers = [(0, 0), *sorted(ends), (self.size, self.size)]
        gaps = [(end, begin) for (_, end), (begin, _) in pairwise(numbers) if mask[_HEAD + end : _HEAD + begin].any()]
        self._gaps = [(_HEAD + end, sample[end:begin]) for end, begin in gaps] if len(gaps) <= _MAX_GAPS else None

    @property
    def width(self) -> int:
        """Bytes of a row: four before the message, so that its numbers are aligned, the message, and some after it."""
        return -(-(self.size + _HEAD) // 8) * 8

    def rows(self, content: Bytes, offsets: NDArray[np.int64]) -> Bytes:
        """The messages that begin at these offsets (n,), as rows (n, width). Content must go on for a width behind."""
        everywhere = np.ndarray((len(content) - self.width + 1,), f"V{self.width}", content, 0, (1,))
        return everywhere[offsets - _HEAD].view(np.uint8).reshape(-1, self.width)

    def fit_all(self, rows: Bytes) -> bool:
        """Whether all rows are the sample's between their numbers; if not, each may have this layout all the same."""
        return self._gaps is not None and all(_equal(rows, at, same) for at, same in self._gaps)

    def fits(self, rows: Bytes) -> NDArray[np.bool_]:
        """Which rows have this layout (n,)."""
        assert self._mask is not None
        different = (rows.view(np.uint64)[:, self._words] & self._mask) != self._same
        return ~different.any(axis=1)

    def numbers(self, rows: Bytes, path: str) -> NDArray[np.generic]:
        """The numbers of a field (n, count)."""
        column = self.columns[path]
        dtype = np.dtype(column.dtype)
        return np.ndarray((len(rows), column.count), dtype, rows, _HEAD + column.at, (rows.strides[0], dtype.itemsize))


def _equal(rows: Bytes, at: int, same: bytes) -> bool:
    """Whether these bytes stand at this place in all rows: in the first, and in each what is in the one before."""
    size = len(same)
    word = next(word for word in (8, 4, 2, 1) if size % word == 0)
    if size > word:
        words = np.ndarray(len(rows), f"V{size}", rows, at, rows.strides[:1]).copy().view(f"u{word}")
    else:
        words = np.ndarray(len(rows), f"u{word}", rows, at, rows.strides[:1])
    n = size // word
    return words[:n].tobytes() == same and bool((words[n:] == words[:-n]).all())


@dataclass
class _LayoutWalk:
    """A walk through one message, which leaves behind where everything stands."""

    made: MessageLayout
    data: bytes
    order: str
    steps: int = 0

    def fields(self, fields: Fields, path: str, at: int) -> int:
        for name, kind in fields:
            at = self.field(kind, f"{path}{name}", at)
        return at

    def field(self, kind: Kind, path: str, at: int) -> int:
        self.steps += 1
        if self.steps > _MAX_STEPS:
            raise ValueError("has more fields than a layout is good for")
        if isinstance(kind, Many):
            return self.many(kind, path, at)
        if kind == "string":
            return self.text(path, at)
        if isinstance(kind, str):
            return self.column(kind, path, at, 1, many=False)
        return self.fields(kind, f"{path}/", at)

    def column(self, kind: str, path: str, at: int, count: int, many: bool) -> int:
        size = int(kind[1:])
        at = _aligned(at, size) if count else at
        if at + count * size > len(self.data):
            raise ValueError("ends too early")
        self.made.columns[path] = Column(f"{self.order}{kind}", at, count, many)
        return at + count * size

    def count(self, at: int) -> tuple[int, int]:
        at = _aligned(at, 4)
        (count,) = struct.unpack_from(f"{self.order}I", self.data, at)
        if count > len(self.data):
            raise ValueError("more than there is room for")
        self.made._fixed.append((at, at + 4))
        return int(count), at + 4

    def text(self, path: str, at: int) -> int:
        length, at = self.count(at)
        if at + length > len(self.data):
            raise ValueError("ends too early")
        self.made._fixed.append((at, at + length))
        self.made.texts[path] = self.data[at : at + length].rstrip(b"\0").decode()
        return at + length

    def many(self, kind: Many, path: str, at: int) -> int:
        count, at = self.count(at) if kind.count is None else (kind.count, at)
        if isinstance(kind.kind, str) and kind.kind != "string":
            return self.column(kind.kind, path, at, count, many=True)
        self.made.counts[path] = count
        for i in range(count):
            at = self.field(kind.kind, f"{path}[{i}]", at)
        return at


def _aligned(at: int, size: int) -> int:
    return at + -(at - _HEAD) % size


def numeric_paths(layout: MessageLayout) -> Iterator[tuple[str, int | None]]:
    """Every number that a signal is made of: (path, place in its array or None), the header left out.

    As for messages taken one by one: arrays of up to 32 numbers, and nothing out of arrays of messages.
    """
    for path, column in layout.columns.items():
        if "header" in path.split("/") or "]" in path:
            continue
        if not column.many:
            yield path, None
        elif 0 < column.count <= 32:
            yield from ((path, i) for i in range(column.count))
