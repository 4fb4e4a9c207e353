"""Columns of a table as numbers, by name or by number; missing cells and wrong ones are told apart."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.schema import shown
from modcal_msgs_py.tables.faults import Faults
from modcal_msgs_py.tables.sheet import Sheet

# What exports write where there is no number, in small letters
MISSING = frozenset(
    ("", "nan", "na", "n/a", "#n/a", "#na", "null", "none", "nil", "-", "--", "---", "missing", "inf", "-inf", "-nan",
     "1.#qnan", "-1.#ind", "-nan(ind)", "nan(ind)", "#value!", "#num!")
)  # fmt: skip
LARGEST = 1e19  # of any number in a table; nanoseconds since 1970 are below
NO_READING = -1e28  # NDI writes -3.697314e28 where a tool was not seen


def number(cell: str, decimal: str = ".") -> float | None:
    """The number in a cell; NaN where it says that there is none, None where it says anything else."""
    text = cell.strip()
    if text.lower() in MISSING:
        return float("nan")
    try:
        value = float(text.replace(decimal, ".") if decimal != "." else text)
    except ValueError:
        return None
    return float("nan") if value != value or value < NO_READING else value


@dataclass(frozen=True)
class Table:
    """A sheet whose columns are asked for. missing: further texts that stand for no number."""

    sheet: Sheet
    faults: Faults
    missing: frozenset[str] = frozenset()
    joined: dict[str, list[str]] = field(default_factory=dict)
    _read: dict[Any, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.sheet.rows)

    @property
    def path(self) -> Path:
        """The file."""
        return self.sheet.path

    def numbers(self, keys: Any) -> Array:
        """A column (N,), or several (N, k), by names or numbers; NaN where a cell is missing or noted as faulty."""
        if isinstance(keys, Sequence) and not isinstance(keys, str):
            return np.stack([self.numbers(key) for key in keys], axis=1)
        if keys not in self._read:
            self._read[keys] = self._numbers(keys)
        return self._read[keys]

    def present(self, keys: Any) -> np.ndarray:
        """Rows in which all of these columns have a number (N,); the others are noted as missing."""
        several = isinstance(keys, Sequence) and not isinstance(keys, str)
        there = np.ones(len(self), bool)
        for key in keys if several else [keys]:
            found = np.isfinite(self.numbers(key))
            self.lack(np.flatnonzero(~found & ~self._faulty), f"column {key}")
            there &= found
        return there

    def blank_zeros(self, keys: Sequence[Any]) -> None:
        """Rows in which all of these columns are zero have no numbers there."""
        rows = (self.numbers(keys) == 0.0).all(axis=1)
        for key in keys:
            self._read[key] = np.where(rows, np.nan, self.numbers(key))

    def lack(self, rows: Iterable[int], what: str) -> None:
        """Note that these rows lack something."""
        lines = [self.sheet.lines[i] for i in rows]
        if lines:
            self.faults.missing(lines, what)

    def bad(self, row: int, column: object, said: str, kind: str = "") -> None:
        """Note a faulty cell."""
        self._faulty[row] = True
        self.faults.bad(self.sheet.lines[row], column, said, kind)

    def text(self, key: Any) -> list[str]:
        """A column as text; of several, what they hold with a blank between."""
        if isinstance(key, Sequence) and not isinstance(key, str):
            return [" ".join(cells).strip() for cells in zip(*(self.text(k) for k in key), strict=True)]
        if key in self.joined:
            return self.joined[key]
        index = self._index(key)
        return [row[index].strip() if index < len(row) else "" for row in self.sheet.rows]

    @cached_property
    def _faulty(self) -> np.ndarray:
        return np.zeros(len(self.sheet.rows), bool)

    def _numbers(self, key: Any) -> Array:
        out = np.full(len(self), np.nan)
        for i, cell in enumerate(self.text(key)):
            if cell in self.missing:
                continue
            value = number(cell, self.sheet.decimal)
            if value is None:
                self.bad(i, key, f"'{shown(cell)[1:-1]}' is not a number", "is not a number")
            elif abs(value) >= LARGEST:
                self.bad(i, key, f"{value:g} is not finite", "is not finite")
            else:
                out[i] = value
        return out

    def _index(self, key: Any) -> int:
        header, first = self.sheet.header, self.sheet.rows[0]
        if isinstance(key, int) and not isinstance(key, bool) and 0 <= key < len(first):
            return key
        if key in header:
            if header.count(key) > 1:
                places = ", ".join(str(i) for i, label in enumerate(header) if label == key)
                said = f"has {header.count(key)} columns {key}"
                raise BadTable(self.path.name, said, f"give the number of the one that is meant: {places}")
            return header.index(key)
        known = ", ".join((*header, *self.joined)) or f"0 to {len(first) - 1}"
        raise BadTable(self.path.name, f"has no column {key}", f"columns are {known}")
