"""Values of dataclasses as plain data (mappings, lists, texts, numbers) and back, by the types of their fields.

Fields that hold their default are left out. What is read is checked: keys that nobody knows, fields that are missing,
values of another type, and numbers that are not finite where nothing says that they may be.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.schema import shown

Writers = Mapping[type, Callable[[Any], Any]]
_NO_WRITERS: Writers = {}


def to_plain(value: Any, own: Writers = _NO_WRITERS) -> Any:
    """The value as plain data; floats keep every digit. own: how values of some types are written instead."""
    if type(value) in own:
        return own[type(value)](value)
    if is_dataclass(value) and not isinstance(value, type):
        kept = {f.name: getattr(value, f.name) for f in fields(value) if not _is_default(f, getattr(value, f.name))}
        return {name: to_plain(one, own) for name, one in kept.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): to_plain(one, own) for key, one in value.items()}
    return [to_plain(one, own) for one in value] if isinstance(value, tuple | list) else value


def _is_default(of: Field[Any], value: Any) -> bool:
    default = of.default if of.default_factory is MISSING else of.default_factory()
    if default is MISSING or type(value) is not type(default):
        return False
    if isinstance(default, np.ndarray):
        return np.array_equal(value, default)
    return bool(value == default) or (value != value and default != default)  # of numbers that are unknown


@lru_cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


@dataclass(frozen=True)
class PlainReader:
    """Reads what :func:`to_plain` wrote.

    remedy: of what is not understood. own: how values of some types are read, from the data and its place in the file.
    infinite: names of fields whose numbers may be infinite.
    """

    remedy: str
    own: Mapping[Any, Callable[[PlainReader, Any, str], Any]] = field(default_factory=dict)
    infinite: frozenset[str] = frozenset()

    def read(self, kind: Any, data: Any, place: str) -> Any:
        """The value of this type. Raises BadTable, naming the place in the file."""
        origin, arguments = typing.get_origin(kind), typing.get_args(kind)
        if kind in self.own:
            return self.own[kind](self, data, place)
        if origin in (typing.Union, types.UnionType):  # with None
            return None if data is None else self.read(arguments[0], data, place)
        if is_dataclass(kind):
            return kind(**self.fields_of(typing.cast("type", kind), data, place))  # type: ignore[operator]
        if origin is np.ndarray or kind is np.ndarray:
            return self._array(data, place)
        if origin in (tuple, list):
            self.require(isinstance(data, list), data, "a list", place)
            each = arguments[:1] * len(data) if arguments[-1] is ... or origin is list else arguments
            self.require(len(each) == len(data), data, f"a list of {len(each)}", place)
            return origin(
                self.read(one, item, f"{place}, entry {i + 1}")
                for i, (one, item) in enumerate(zip(each, data, strict=True))
            )
        if origin is not None and issubclass(origin, Mapping):
            self.require(isinstance(data, Mapping), data, "a mapping", place)
            return {str(key): self.read(arguments[1], one, f"{place}: {key}") for key, one in data.items()}
        if kind is float and type(data) is int:
            data = float(data)
        self.require(type(data) is kind, data, {str: "a text", bool: "true or false"}.get(kind, "a number"), place)
        if kind is float:
            self._array(data, place)
        return data

    def fields_of(self, kind: type, data: Any, place: str, beside: Sequence[str] = ()) -> dict[str, Any]:
        """The fields of a dataclass that the data states, by name. beside: keys that are there and read elsewhere."""
        self.require(isinstance(data, Mapping), data, "a mapping", place)
        known = {f.name: f for f in fields(kind)}
        for name in data:
            if name not in (*known, *beside):
                said = f"unknown key {str(name)[:80]}; known are {', '.join((*beside, *known))}"
                raise BadTable(place, said, self.remedy)
        data = {name: value for name, value in data.items() if name in known and value is not None}
        for name, one in known.items():
            if name not in data and one.default is MISSING and one.default_factory is MISSING:
                raise BadTable(place, f"{name} is missing", self.remedy)
        return {name: self.read(_hints(kind)[name], one, f"{place}: {name}") for name, one in data.items()}

    def require(self, holds: bool, data: Any, wanted: str, place: str) -> None:
        """Raises BadTable unless this holds."""
        if not holds:
            raise BadTable(place, f"{shown(data)} is not {wanted}", self.remedy)

    def _array(self, data: Any, place: str) -> np.ndarray:
        try:
            out = np.array(data)
        except ValueError:
            out = np.array(None)
        numbers = out.dtype.kind in "bif" or not out.size
        self.require(numbers, data, "numbers, in rows of one length", place)
        may = place.rpartition(": ")[2] in self.infinite
        self.require(not (np.isnan(out) if may else ~np.isfinite(out)).any(), data, "finite", place)
        return out if out.dtype == bool else out.astype(float)
