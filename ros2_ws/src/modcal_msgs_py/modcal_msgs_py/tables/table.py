"""Columns of a sheet as numbers; missing cells and wrong ones are told apart, and noted with their lines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.measurements import shown
from modcal_msgs_py.tables.sheet import Sheet, cell_value, index, number

_LARGEST = 1e19  # of any number in a table; nanoseconds since 1970 are below
_MAX_LINES, _MAX_KINDS = 20, 12  # that a message lists; more are counted


@dataclass
class Faults:
    """Faulty cells and missing ones of one file. skip: whether rows with missing cells are left out and counted."""

    file: str
    skip: bool = False
    _cells: dict[tuple[str, str], list[tuple[int, str]]] = field(default_factory=dict)
    _missing: dict[str, set[int]] = field(default_factory=dict)

    def bad(self, line: int, column: object, said: str, kind: str = "") -> None:
        """Note a cell that cannot be used. kind: what cells with the same fault have in common."""
        found = self._cells.setdefault((f"column {column}" if column is not None else "", kind or said), [])
        if all(line != seen for seen, _ in found[-1:]):
            found.append((line, said))

    def missing(self, lines: Iterable[int], what: str) -> None:
        """Note rows that lack something that is needed."""
        self._missing.setdefault(what, set()).update(lines)

    def require_none(self) -> None:
        """Raises BadTable that names all faulty rows with the reasons, if there are any."""
        told = [_told(column, cells) for (column, _), cells in self._cells.items()]
        rows = {line for cells in self._cells.values() for line, _ in cells}
        remedy = "correct the cells, or leave the rows out"
        if not self.skip and self._missing:
            told += [f"{_lines(sorted(lines))}, {what}: no number" for what, lines in self._missing.items()]
            rows = rows.union(*self._missing.values())
            remedy = "correct the cells, leave the rows out, or state missing: skip"
        if not told:
            return
        more = f"; {len(told) - _MAX_KINDS} more reasons" if len(told) > _MAX_KINDS else ""
        count = f"{len(rows)} faulty rows: " if len(rows) > 1 else ""
        raise BadTable(self.file, f"{count}{'; '.join(told[:_MAX_KINDS])}{more}", remedy)

    def notes(self) -> list[str]:
        """A sentence for each reason why rows were left out."""
        return [
            f"{self.file}: {len(lines)} row{'s were' if len(lines) > 1 else ' was'} left out: no number in {what}."
            for what, lines in self._missing.items()
            if lines
        ]


def _told(column: str, cells: list[tuple[int, str]]) -> str:
    line, said = cells[0]
    also = f" (also {_lines([other for other, _ in cells[1:]])})" if len(cells) > 1 else ""
    return f"line {line}{', ' if column else ''}{column}: {said}{also}"


def _lines(lines: list[int]) -> str:
    more = f" and {len(lines) - _MAX_LINES} more" if len(lines) > _MAX_LINES else ""
    return f"line{'s' if len(lines) > 1 else ''} {', '.join(map(str, lines[:_MAX_LINES]))}{more}"


@dataclass(frozen=True)
class Table:
    """A sheet whose columns are asked for. missing: further texts that stand for no number."""

    sheet: Sheet
    faults: Faults
    missing: frozenset[str] = frozenset()
    _read: dict[Any, Array] = field(default_factory=dict)

    @classmethod
    def of(cls, sheet: Sheet) -> Table:
        """A table of which nothing more is stated."""
        return cls(sheet, Faults(sheet.path.name))

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
        return self.sheet.column(index(self.sheet, key))

    @cached_property
    def _faulty(self) -> np.ndarray:
        return np.zeros(len(self.sheet.rows), bool)

    def _numbers(self, key: Any) -> Array:
        out = np.full(len(self), np.nan)
        for i, cell in enumerate(self.text(key)):
            if cell in self.missing:
                continue
            value = number(cell, self.sheet.form.decimal)
            if value is None:
                self.bad(i, key, f"'{shown(cell)[1:-1]}' is not a number", "is not a number")
            elif abs(value) >= _LARGEST:
                self.bad(i, key, f"{value:g} is not finite", "is not finite")
            else:
                out[i] = value
        return out


def chosen(sheet: Sheet, rows: Mapping[Any, Any], source: str) -> Sheet:
    """The rows of a sheet in which every column holds the stated value, or one of several. Raises BadTable for none."""
    keep = np.ones(len(sheet.rows), bool)
    for key, wanted in rows.items():
        values = {cell_value(str(one)) for one in (wanted if isinstance(wanted, list) else [wanted])}
        keep &= [cell_value(cell, sheet.form.decimal) in values for cell in sheet.column(index(sheet, key))]
    if not keep.any():
        raise BadTable(f"{source}: rows", f"no row of {sheet.path.name} is as stated", "check column and values")
    some = np.flatnonzero(keep).tolist()
    return replace(sheet, rows=[sheet.rows[i] for i in some], lines=[sheet.lines[i] for i in some])
