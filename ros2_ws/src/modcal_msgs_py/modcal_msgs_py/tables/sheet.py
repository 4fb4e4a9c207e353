"""The text of a table as cells: its encoding, what separates columns, and which lines are no rows of numbers."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from modcal_core.errors import BadTable

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
