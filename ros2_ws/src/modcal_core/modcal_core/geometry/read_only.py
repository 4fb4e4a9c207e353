"""Arrays that cannot be written to, for values that do not change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")


def view(array: np.ndarray) -> np.ndarray:
    """The same numbers, not to be written to through this view; whoever made the array may go on with it."""
    if not array.flags.writeable:
        return array
    out = array.view()
    out.flags.writeable = False
    return out


def sealed(value: T) -> T:
    """The value, every array in it being read-only from now on: in fields, tuples, lists and mappings, however deep."""
    for array in arrays_in(value):
        array.flags.writeable = False
    return value


def arrays_in(value: Any) -> list[np.ndarray]:
    """Every array that a value contains; each object is visited once."""
    found: list[np.ndarray] = []
    seen: set[int] = set()
    waiting: list[Any] = [value]
    while waiting:
        one = waiting.pop()
        if id(one) in seen:
            continue
        seen.add(id(one))
        if isinstance(one, np.ndarray):
            found.append(one)
        elif isinstance(one, Mapping):
            waiting += one.values()
        elif isinstance(one, tuple | list):
            waiting += one
        elif is_dataclass(one) and not isinstance(one, type):
            waiting += [getattr(one, field.name) for field in fields(one) if hasattr(one, field.name)]
    return found
