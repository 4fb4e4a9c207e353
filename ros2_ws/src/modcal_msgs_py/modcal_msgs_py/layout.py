"""Many messages of one layout at once: where the numbers stand in the bytes, and which bytes must be the same.

Messages of one topic nearly always look alike: the same joints, the same frame, the same lengths. Then every number
stands at the same place, and a column of numbers is one view into the bytes. What may vary besides the numbers
(counts, texts) is compared with the message that the layout was made from; one that differs has a layout of its own.

A type is told by its fields: ``(name, kind)`` where the kind is the type of a number as NumPy writes it (``f8``),
``string``, a list of fields, or ``[kind]`` with a count: ``Many(kind, n)``, n None where the message says how many.

Those of ROS come from rosbags, others out of the definitions that bags bring along.
"""

from __future__ import annotations

import contextlib
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from modcal_core.geometry import Array

if TYPE_CHECKING:  # of those who read or write bags: a node on topics of the contract works where rosbags is missing
    from rosbags.typesys.store import Typestore

_MAX_STEPS = 20_000  # fields of one message that are looked at; more, and it has no layout
_SPARE = 3  # bytes that may follow a message
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

    counts: how many fields that are not numbers (texts, messages) there are, by path. fixed: spans of bytes that must
    be the same in all of them.
    """

    size: int
    columns: dict[str, Column] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    fixed: list[tuple[int, int]] = field(default_factory=list)
    _same: NDArray[np.uint64] | None = None
    _mask: NDArray[np.uint64] | None = None

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
        if not len(sample) - _SPARE <= end <= len(sample):
            return None
        made.fixed.append((0, 2))
        made._compare(sample)
        return made

    def _compare(self, sample: bytes) -> None:
        """Remember the bytes that must be the same, in words of eight."""
        mask = np.zeros(self.width, np.uint8)
        for start, stop in self.fixed:
            mask[_HEAD + start : _HEAD + stop] = 0xFF
        same = np.zeros(self.width, np.uint8)
        same[_HEAD : _HEAD + self.size] = np.frombuffer(sample, np.uint8)
        words = np.flatnonzero(mask.view(np.uint64))
        self._words = slice(words[0], words[-1] + 1)
        self._mask = mask.view(np.uint64)[self._words]
        self._same = same.view(np.uint64)[self._words] & self._mask

    @property
    def width(self) -> int:
        """Bytes of a row: four before the message, so that its numbers are aligned, the message, and some after it."""
        return -(-(self.size + _HEAD) // 8) * 8

    def rows(self, content: Bytes, offsets: NDArray[np.int64]) -> Bytes:
        """The messages that begin at these offsets (n,), as rows (n, width). Content must go on for a width behind."""
        everywhere = np.ndarray((len(content) - self.width + 1,), f"V{self.width}", content, 0, (1,))
        return everywhere[offsets - _HEAD].view(np.uint8).reshape(-1, self.width)

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
        self.made.fixed.append((at, at + 4))
        return int(count), at + 4

    def text(self, path: str, at: int) -> int:
        length, at = self.count(at)
        if at + length > len(self.data):
            raise ValueError("ends too early")
        self.made.fixed.append((at, at + length))
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


# Numbers below these are no signals: stamps, counters, names of something
_NO_SIGNAL = frozenset(("header", "stamp", "sec", "nanosec", "seq", "id", "goal_id", "line", "level"))
_MOST = 32  # numbers of an array that are signals


@dataclass(frozen=True)
class MessageRows:
    """Messages of one layout: rows (n, width) of bytes."""

    layout: MessageLayout
    rows: Bytes

    def has(self, path: str) -> bool:
        """Whether there are numbers at this path."""
        return path in self.layout.columns

    def column(self, path: str) -> Array:
        """The numbers at a path, (n, k)."""
        return self.layout.numbers(self.rows, path).astype(float, copy=False)

    def text(self, path: str) -> str:
        """The text at a path; "" where there is none."""
        return self.layout.texts.get(path, "")

    def texts(self, path: str) -> tuple[str, ...]:
        """The texts of an array."""
        return tuple(self.layout.texts[f"{path}[{i}]"] for i in range(self.count(path)))

    def count(self, path: str) -> int:
        """How many fields an array has that are no numbers."""
        return self.layout.counts.get(path, 0)

    def signals(self) -> Iterator[tuple[str, Array]]:
        """Every number that a signal is made of, by its path, (n,): none of the header, nor of arrays of messages."""
        for path, column in self.layout.columns.items():
            if _NO_SIGNAL & set(path.split("/")) or "]" in path or (column.many and column.count > _MOST):
                continue
            values = self.column(path)
            yield from ((f"{path}[{i}]" if column.many else path, values[:, i]) for i in range(column.count))


@dataclass(frozen=True)
class OneMessage:
    """The same of one message object, of rclpy or decoded from a bag, but for signals."""

    message: Any

    def has(self, path: str) -> bool:
        """Whether there is anything at this path."""
        return self._at(path) is not None

    def column(self, path: str) -> Array:
        """The numbers at a path, (1, k)."""
        return np.atleast_2d(np.asarray(self._at(path), dtype=float))

    def text(self, path: str) -> str:
        """The text at a path; "" where there is none."""
        found = self._at(path)
        return "" if found is None else str(found)

    def texts(self, path: str) -> tuple[str, ...]:
        """The texts of an array."""
        return tuple(self._at(path))

    def count(self, path: str) -> int:
        """How many fields an array has."""
        return len(self._at(path) or ())

    def _at(self, path: str) -> Any:
        value = self.message
        for name in _names(path):
            value = value[name] if isinstance(name, int) else getattr(value, name, None)
        return value


Messages: TypeAlias = MessageRows | OneMessage


@cache
def _names(path: str) -> tuple[str | int, ...]:
    """Fields and places in arrays on the way that a path leads."""
    return tuple(int(word) if word.isdigit() else word for word in re.findall(r"[^/\[\]]+", path))


# --- ROS 2 Jazzy message types without ROS: definitions, serialisation, type hashes

_LONGEST_TEXT = 1 << 18  # of a definition; real ones have some kilobytes
_LINE = "=" * 80 + "\n"  # between the definitions of a text


@cache
def jazzy() -> Typestore:
    """The message types of ROS 2 Jazzy, shared by all callers."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def message_class(type_name: str) -> Any:
    """The class of a message type, such as ``sensor_msgs/msg/JointState``."""
    return jazzy().types[type_name]


def definition(type_name: str) -> tuple[str, str]:
    """(full definition text, RIHS01 type hash) of a message type."""
    text, _ = jazzy().generate_msgdef(type_name, ros_version=2)
    return text, jazzy().hash_rihs01(type_name)


_IDL = {"double": "float64", "float": "float32", "boolean": "bool", "octet": "byte"}
_FIELD = re.compile(r"(?:sequence<)?([\w/]+)>?(\[\d+\])?")


def learn(type_name: str, load: Callable[[str], Any]) -> bool:
    """Know a message type by its class, and those that it uses; whether that is possible.

    load: the class that ROS has generated for a name such as ``a/msg/B``; None where there is none.
    """
    kind = load(type_name)
    if kind is None or type_name in jazzy().types:
        return kind is not None
    lines = []
    for name, written in kind.get_fields_and_field_types().items():
        found = _FIELD.fullmatch(written)
        if found is None:
            return False  # a bounded sequence or text
        inner, size = _IDL.get(found[1], found[1]), found[2] or ("[]" if written.startswith("sequence") else "")
        if "/" in inner and not learn(inner.replace("/", "/msg/"), load):
            return False
        lines.append(f"{inner}{size} {name}")
    from rosbags.typesys import get_types_from_msg

    jazzy().register(get_types_from_msg("\n".join(lines), type_name))
    return True


def serialise(message: Any, type_name: str) -> bytes:
    """CDR bytes of a message."""
    return bytes(jazzy().serialize_cdr(message, type_name))


@lru_cache(maxsize=256)
def definitions(type_name: str, text: str) -> dict[str, Any]:
    """What a definition text, as MSG or IDL, says of a type and of those it uses; nothing where it cannot be read.

    A text comes from a file and may say anything. The reader of definitions is not made for that: it raises whatever
    the text leads it to, and goes as deep as the text does.
    """
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if len(text) > _LONGEST_TEXT:
        return {}
    try:
        if "\nIDL: " not in f"\n{text}":
            return dict(get_types_from_msg(text, type_name))
        found: dict[str, Any] = {}
        for part in text.split(_LINE):
            head, _, body = part.partition("\n")
            found.update(get_types_from_idl(body) if head.startswith("IDL: ") else {})
        return found
    except Exception:
        return {}


@lru_cache(maxsize=16)
def store_with(type_name: str, text: str) -> Typestore:
    """The Jazzy types, and besides them those that the definition of this type adds, as far as they can be had."""
    if type_name in jazzy().types or not text:
        return jazzy()
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    with contextlib.suppress(Exception):  # as above
        store.register({k: v for k, v in definitions(type_name, text).items() if k not in store.types})
    return store


_NUMBERS = {
    "bool": "u1", "byte": "u1", "octet": "u1", "uint8": "u1", "int8": "i1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_MAX_DEPTH, _MAX_FIELDS = 32, 4096  # of types in types


def fields_of(type_name: str, schemas: Mapping[str, str]) -> Fields | None:
    """The fields of a message type; None for one that is not known, or holds more than numbers and texts.

    schemas: definitions that a bag brings along, by type.
    """
    if type_name in jazzy().fielddefs:
        return expanded(type_name, "")
    return expanded(type_name, schemas[type_name]) if type_name in schemas else None


@lru_cache(maxsize=256)
def expanded(type_name: str, text: str) -> Fields | None:
    """The fields of a type of Jazzy (no text), or of one that a text defines."""
    own = definitions(type_name, text) if text else {}
    try:
        return _Expansion({**own, **jazzy().fielddefs} if own else jazzy().fielddefs).fields(type_name, 0)
    except (KeyError, ValueError):
        return None


@dataclass
class _Expansion:
    """Fields of types in fields of types, within bounds that no real type meets."""

    known: Mapping[str, Any]
    count: int = 0

    def fields(self, type_name: str, depth: int) -> Fields:
        """Raises KeyError for what is neither a number nor a text, ValueError for what has no end."""
        described = self.known[type_name][1]
        self.count += len(described)
        if depth > _MAX_DEPTH or self.count > _MAX_FIELDS:
            raise ValueError(f"{type_name} is deeper or larger than any message")
        return [(name, self.kind(what, depth)) for name, what in described]

    def kind(self, described: Any, depth: int) -> Kind:
        node, what = described
        if node.name == "BASE":
            return "string" if what[0] == "string" else _NUMBERS[what[0]]
        if node.name == "NAME":
            return self.fields(what, depth + 1)
        inner, count = what
        return Many(self.kind(inner, depth), count if node.name == "ARRAY" else None)
