"""A table's text as cells, and its columns as numbers; missing cells and wrong ones are told apart."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.measurements import shown

BLANKS = " "  # as a delimiter: any run of blanks and tabs


@dataclass(frozen=True)
class Form:
    """How a file is written. preamble_rows: lines above the header. units_rows: lines between header and numbers."""

    delimiter: str = ","
    decimal: str = "."
    encoding: str = "utf-8-sig"
    header: bool = True
    preamble_rows: int = 0
    units_rows: int = 0

    @classmethod
    def stated(cls, entry: Mapping[str, Any]) -> Form:
        """The form that an entry of a mapping states."""
        return cls(**{name: entry[name] for name in cls.__dataclass_fields__ if name in entry})

    def entry(self) -> dict[str, Any]:
        """What an entry of a mapping states of it: what is not as by default."""
        return {name: value for name, value in vars(self).items() if value != getattr(Form, name)}


@dataclass(frozen=True)
class Sheet:
    """Cells of one file. header: labels of the columns, empty where there are none. lines: of the rows, from 1."""

    path: Path
    header: tuple[str, ...]
    rows: list[list[str]]
    lines: list[int]
    decimal: str = "."


def read_sheet(path: Path, form: Form) -> Sheet:
    """The cells of a file in a stated form; empty lines are left out. Raises BadTable."""
    try:
        text = path.read_text(encoding=form.encoding)
    except UnicodeError as error:
        raise BadTable(str(path), "is not text in the stated encoding", "state its encoding") from error
    except OSError as error:
        raise BadTable(str(path), f"cannot be read ({error.strerror})", "check the file") from error
    above = text.split("\n", form.preamble_rows)
    body = above[form.preamble_rows] if len(above) > form.preamble_rows else ""
    try:
        filled = [
            (form.preamble_rows + line, cells)
            for line, cells in cells_of(body, form.delimiter)
            if any(cell.strip() for cell in cells)
        ]
    except (csv.Error, TypeError) as error:
        raise BadTable(str(path), f"is not a table ({error})", "state its delimiter, or give a CSV file") from error
    rows = filled[int(form.header) + form.units_rows :]
    if not rows:
        raise BadTable(str(path), "has no row", "leave the file out")
    header = labels(filled[0][1], len(rows[0][1])) if form.header else ()
    return Sheet(path, header, [cells for _, cells in rows], [line for line, _ in rows], form.decimal)


def labels(cells: list[str], width: int) -> tuple[str, ...]:
    """Labels of so many columns; a mark of a comment (#, %) before the first is left out."""
    out = [cell.strip() for cell in cells]
    if out and out[0][:1] in ("#", "%"):
        first = out[0].lstrip("#% ")
        out = [first, *out[1:]] if first or len(out) <= width else out[1:]
    return tuple(out)


def cells_of(text: str, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """(number of the line from 1, cells) of every line of a text. Raises csv.Error."""
    lines = [f"{line}\n" for line in text.split("\n")]
    if delimiter == BLANKS:
        reader = csv.reader((line.strip().replace("\t", " ") for line in lines), delimiter=" ", skipinitialspace=True)
    else:
        reader = csv.reader(lines, delimiter=delimiter)
    before = 0
    for cells in reader:
        yield before + 1, cells
        before = reader.line_num


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
        if not self.skip:
            for what, lines in self._missing.items():
                told.append(f"{_lines(sorted(lines))}, {what}: no number")
                rows |= lines
            if self._missing:
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


# --- Columns of another file beside those of a table: rows belong together by a station's number, a name, or a time


def join(table: Table, stated: Mapping[str, Any], folder: Path, source: str) -> None:
    """Put the columns of another file into a table, each under its own name, or FILE.NAME where that is taken.

    Rows without a partner have empty cells there. Raises BadTable where no row has one, or one has several.
    """
    name = str(stated["files"]).replace("{stem}", table.path.stem).replace("{folder}", table.path.parent.name)
    path = folder / name
    if not path.is_file():
        raise BadTable(
            f"{source}: joined {name}", "is not a file", "give its name relative to the folder of the tables"
        )
    other = Table(read_sheet(path, Form.stated({"decimal": table.sheet.decimal, **stated})), Faults(path.name))
    (ours, theirs), *_ = stated["by"].items()
    partner = _partners(table, ours, other, theirs, stated.get("within"))
    if not (partner >= 0).any():
        said = f"no row of {path.name} has a {theirs} that is a {ours} of {table.path.name}"
        raise BadTable(f"{source}: joined", said, "check the columns in by, or state within")
    taken = {*table.sheet.header, *table.joined}
    for i, label in enumerate(other.sheet.header):
        cells = other.text(i)
        if other.sheet.decimal != table.sheet.decimal:
            cells = [cell.replace(other.sheet.decimal, table.sheet.decimal) for cell in cells]
        key = label if label not in taken else f"{path.stem}.{label}"
        table.joined[key] = [cells[k] if k >= 0 else "" for k in partner]


def _partners(table: Table, ours: str, other: Table, theirs: str, within: float | None) -> np.ndarray:
    """The row of the other table that belongs to each row (N,), −1 for none."""
    if within is None:
        rows: dict[object, int] = {}
        for k, cell in enumerate(other.text(theirs)):
            key = _key(cell, other.sheet.decimal)
            if key in rows and cell:
                said = f"lines {other.sheet.lines[rows[key]]} and {other.sheet.lines[k]} both have {theirs} {cell}"
                raise BadTable(other.path.name, said, "state within: for times, or leave one of them out")
            rows[key] = k
        return np.array([rows.get(_key(cell, table.sheet.decimal), -1) for cell in table.text(ours)])
    wanted, known = table.numbers(ours), other.numbers(theirs)
    order = np.argsort(known)
    order = order[np.isfinite(known[order])]
    if not len(order):
        return np.full(len(wanted), -1)
    right = np.clip(np.searchsorted(known[order], wanted), 1, max(len(order) - 1, 1))
    right = np.minimum(right, len(order) - 1)
    left = np.maximum(right - 1, 0)
    nearer = np.where(np.abs(known[order[left]] - wanted) <= np.abs(known[order[right]] - wanted), left, right)
    partner = order[nearer]
    return np.where(np.abs(known[partner] - wanted) <= within, partner, -1)


def _key(cell: str, decimal: str) -> object:
    value = number(cell, decimal)
    return cell.strip() if value is None or value != value else value
