"""How a file of numbers is written, found out from the text: encoding, separator, decimal sign, labels, units."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from modcal_core.errors import BadTable
from modcal_msgs_py.tables.table import BLANKS, MISSING, Form, cells_of, labels

_SEPARATORS = (";", "\t", ",", "|", BLANKS)  # where two read as much, the first: blanks also stand inside cells
_LINES = 300  # that are looked at to find out how a file is written
_MIN_COLUMNS = 3
_NUMBERS = 0.5  # share of the cells of a row of numbers
_MAX_BYTES = 1 << 29
_PATTERN = {
    sign: re.compile(rf"\s*[+-]?(\d+({re.escape(sign)}\d*)?|{re.escape(sign)}\d+)([eE][+-]?\d+)?\s*") for sign in ".,"
}
_UNIT = re.compile(
    r"[\[(<]?\s*(|-|–|1|mm|cm|m|in|inch|inches|µm|um|deg|degree|degrees|°|grad|rad|radian|radians|mrad|s|sec|seconds|ms|"
    r"us|µs|ns|°c|degc|c|k|k?nm{1,2}|n\s?m|n·m|n|a|v|%|gon|kg|g|bar|hpa|pa|°f|rad/s|deg/s|°/s|mm/s|m/s|hz|bool|int|unitless|none|text|date|datetime)\s*[\])>]?",
    re.IGNORECASE,
)
_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))


@dataclass(frozen=True)
class Sniffed:
    """What was found out of a file. form: how it is written. labels: of the columns, as the mapping names them, empty
    without a header. full: the same with what stands above and below them (names of bodies, units), for whoever reads
    meaning from them. rows, lines: cells of the rows, and their numbers in the file. sure: False where the encoding
    was not told by the text.
    """

    path: Path
    form: Form
    labels: tuple[str, ...]
    full: tuple[str, ...]
    units: tuple[str, ...]
    rows: list[list[str]]
    sure: bool = True

    @property
    def width(self) -> int:
        """Number of columns."""
        return max(len(row) for row in self.rows)


def sniff(path: Path, least: int = _MIN_COLUMNS) -> Sniffed:
    """How a file is written. least: columns with numbers. Raises BadTable where no block of such rows is found."""
    text, encoding, sure = _text(path)
    lines = text.split("\n")
    head = "\n".join(lines[:_LINES])
    best: tuple[int, str, str] = (0, ",", ".")
    for separator in _SEPARATORS:
        try:
            cells = [row for _, row in cells_of(head, separator)]
        except csv.Error:
            continue
        for sign in ".,":
            if sign == separator:
                continue
            count = _block(cells, sign, least)
            if count > best[0]:
                best = (count, separator, sign)
    if not best[0]:
        said = f"holds no block of rows with numbers in {least} columns or more"
        raise BadTable(str(path), said, "give a text table (CSV, TSV), or write a mapping for it")
    return _laid_out(path, text, best[1], best[2], encoding, sure, least)


def _text(path: Path) -> tuple[str, str, bool]:
    """(text, encoding, whether that is certain) of a file."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise BadTable(str(path), f"is larger than {_MAX_BYTES >> 20} MiB", "cut it into files")
        raw = path.read_bytes()
    except OSError as error:
        raise BadTable(str(path), f"cannot be read ({error.strerror})", "check the file") from error
    encoding, sure = next((name for mark, name in _MARKS if raw.startswith(mark)), ""), True
    if not encoding:
        zeros = [raw[k:4096:2].count(0) for k in (0, 1)]
        if max(zeros) > len(raw[:4096]) // 8:
            encoding = "utf-16-le" if zeros[1] > zeros[0] else "utf-16-be"
        else:
            encoding = "utf-8"
    for name in (encoding, "latin-1"):
        try:
            text = raw.decode(name)
        except UnicodeDecodeError:
            sure = False
            continue
        return text.replace("\r\n", "\n").replace("\r", "\n"), name, sure
    raise BadTable(str(path), "is not text", "give a text table")


def is_number(cell: str, sign: str) -> bool:
    """Whether a cell holds a number with this decimal sign."""
    return _PATTERN[sign].fullmatch(cell) is not None


def _is_row(cells: list[str], sign: str, least: int) -> bool:
    """Whether cells are a row of numbers: most of those that hold something, and so many at least."""
    numbers = sum(is_number(cell, sign) for cell in cells)
    missing = sum(cell.strip().lower() in MISSING for cell in cells)
    return numbers >= least and numbers >= _NUMBERS * (len(cells) - missing)


def _width(rows: list[list[str]], sign: str, least: int) -> int:
    """The usual number of columns of rows of numbers; 0 where there are none."""
    widths = Counter(len(cells) for cells in rows if _is_row(cells, sign, least))
    return widths.most_common(1)[0][0] if widths else 0


def _block(rows: list[list[str]], sign: str, least: int) -> int:
    width = _width(rows, sign, least)
    return sum(
        sum(is_number(cell, sign) for cell in cells)
        for cells in rows
        if len(cells) == width and _is_row(cells, sign, least)
    )


def _laid_out(path: Path, text: str, separator: str, sign: str, encoding: str, sure: bool, least: int) -> Sniffed:
    table = [(line, cells) for line, cells in cells_of(text, separator) if any(cell.strip() for cell in cells)]
    every = [cells for _, cells in table]
    width = _width(every, sign, least)
    first = next(i for i, cells in enumerate(every) if len(cells) == width and _is_row(cells, sign, least))
    rows = every[first:]
    above = first
    while above and abs(len(every[above - 1]) - width) <= 1 and not _is_row(every[above - 1], sign, least):
        above -= 1
    stacked = [labels(cells, width) for cells in every[above:first]]
    units_rows = 0
    while units_rows < len(stacked) - 1 and _are_units(stacked[-1 - units_rows]):
        units_rows += 1
    header = bool(stacked)
    named = stacked[len(stacked) - 1 - units_rows] if header else ()
    if header and len(named) not in (width, width - 1):
        named = tuple(named[:width])
    upper = stacked[: max(len(stacked) - 1 - units_rows, 0)]
    units = tuple(_joined([row[i] if i < len(row) else "" for row in stacked[len(upper) + 1 :]]) for i in range(width))
    full = tuple(
        _joined([*(row[i] if i < len(row) else "" for row in upper), named[i] if i < len(named) else ""])
        for i in range(width)
    )
    preamble = table[first - units_rows - 1][0] - 1 if header else table[first][0] - 1
    form = Form(
        separator, sign, "utf-8-sig" if encoding == "utf-8" else encoding, header, preamble, units_rows if header else 0
    )
    return Sniffed(path, form, named, full, units, rows, sure)


def _are_units(cells: tuple[str, ...]) -> bool:
    filled = [cell for cell in cells if cell]
    return bool(filled) and all(_UNIT.fullmatch(cell) for cell in cells)


def _joined(parts: list[str]) -> str:
    return " ".join(part for part in parts if part)
