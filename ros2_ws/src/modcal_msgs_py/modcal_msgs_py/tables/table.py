"""Columns of a sheet as numbers; missing cells and wrong ones are told apart, and noted with their lines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.measurements import shown
from modcal_msgs_py.tables.sheet import Sheet, cell_value, index, number

_LARGEST = 1e19  # of any number in a table; nanoseconds since 1970 are below
_MAX_LINES, _MAX_KINDS = 20, 12  # that a message lists; more are counted


@dataclass(frozen=True)
class Table:
    """A sheet whose columns are asked for, and what was found wrong in it. missing: further texts that stand for no
    number. skip: whether rows that lack a number are left out and counted.
    """

    sheet: Sheet
    missing: frozenset[str] = frozenset()
    skip: bool = False
    _read: dict[Any, Array] = field(default_factory=dict)
    _wrong: dict[tuple[str, str], dict[int, str]] = field(default_factory=dict)  # by column and kind: sentences of rows
    _lacking: dict[str, set[int]] = field(default_factory=dict)  # rows, by what they lack

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
            faulty = {row for cells in self._wrong.values() for row in cells}
            self.lack((i for i in np.flatnonzero(~found).tolist() if i not in faulty), f"column {key}")
            there &= found
        return there

    def blank_zeros(self, keys: Sequence[Any]) -> None:
        """Rows in which all of these columns are zero have no numbers there."""
        rows = (self.numbers(keys) == 0.0).all(axis=1)
        for key in keys:
            self._read[key] = np.where(rows, np.nan, self.numbers(key))

    def lack(self, rows: Iterable[int], what: str) -> None:
        """Note that these rows lack something."""
        self._lacking.setdefault(what, set()).update(rows)

    def bad(self, row: int, column: object, said: str, kind: str = "") -> None:
        """Note a faulty cell. kind: what cells with the same fault have in common."""
        self._wrong.setdefault((f"column {column}", kind or said), {}).setdefault(row, said)

    def require_sound(self) -> None:
        """Raises BadTable that names all faulty rows with the reasons, if there are any."""
        lacking = {} if self.skip else {what: rows for what, rows in self._lacking.items() if rows}
        told = [(column, list(cells), next(iter(cells.values()))) for (column, _), cells in self._wrong.items()]
        told += [(what, sorted(rows), "no number") for what, rows in lacking.items()]
        if not told:
            return
        reasons = []
        for where, (first, *others), said in told:
            lines = ", ".join(str(self.sheet.lines[i]) for i in others[:_MAX_LINES])
            more = f" and {len(others) - _MAX_LINES} more" if len(others) > _MAX_LINES else ""
            also = f" (also line{'s' * (len(others) > 1)} {lines}{more})" if others else ""
            reasons.append(f"line {self.sheet.lines[first]}, {where}: {said}{also}")
        rest = f"; {len(reasons) - _MAX_KINDS} more reasons" if len(reasons) > _MAX_KINDS else ""
        count = len({row for _, rows, _ in told for row in rows})
        faulty = f"{count} faulty rows: " if count > 1 else ""
        remedy = f"correct the cells, or leave the rows out{', or state missing: skip' if lacking else ''}"
        raise BadTable(self.path.name, f"{faulty}{'; '.join(reasons[:_MAX_KINDS])}{rest}", remedy)

    def notes(self) -> list[str]:
        """A sentence for each reason why rows were left out."""
        return [
            f"{self.path.name}: {len(rows)} row{'s were' if len(rows) > 1 else ' was'} left out: no number in {what}."
            for what, rows in self._lacking.items()
            if rows
        ]

    def text(self, key: Any) -> list[str]:
        """A column as text; of several, what they hold with a blank between."""
        if isinstance(key, Sequence) and not isinstance(key, str):
            return [" ".join(cells).strip() for cells in zip(*(self.text(k) for k in key), strict=True)]
        return self.sheet.column(index(self.sheet, key))

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
