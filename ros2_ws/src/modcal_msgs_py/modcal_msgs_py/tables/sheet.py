"""Files of cells: how one is written, read as stated or found out of its text, and files whose rows belong together."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.measurements import shown
from modcal_msgs_py.tables.labels import words

BLANKS = " "  # as a delimiter: any run of blanks and tabs
# What exports write for a missing number, in small letters
MISSING = words(
    "nan na n/a #n/a #na null none nil - -- --- missing inf -inf -nan 1.#qnan -1.#ind -nan(ind) nan(ind) #value! #num!"
) | {""}
_NO_READING = -1e28  # NDI writes -3.697314e28 where a tool was not seen
_NAMED = re.compile(r"\s*([A-Za-z]\w*)\s*[=:]\s*(?=[-+.,\d])")  # X=12.5
_CELL_UNIT = r"°|deg|rad|gon|mm|cm|m|in"  # 12.5 mm
# Groups of thousands; only a decimal sign behind them tells them from decimals: 1,234 may be either
_GROUPED = {sign: rf"\d{{1,3}}(?:[{other}'’]\d{{3}})+{re.escape(sign)}\d+" for sign, other in ((".", ","), (",", "."))}
_SPACED = re.compile(r"(?<=\w)[ \t]*=[ \t]*(?=[-+.,\d])")
_MAX_BYTES = 1 << 29
_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_OTHERS = (
    (b"\xd0\xcf\x11\xe0", "an old Excel workbook (.xls)"), (b"%PDF", "a PDF"), (b"MATLAB", "a MATLAB file"),
    (b"\x93NUMPY", "a NumPy array"), (b"\x89HDF", "an HDF5 file"), (b"PAR1", "a Parquet file"),
)  # fmt: skip


@dataclass(frozen=True)
class Form:
    """How a file is written. preamble_rows: lines above the header. units_rows: lines between header and numbers.
    sheet: of a workbook, "" for the first one.
    """

    delimiter: str = ","
    decimal: str = "."
    encoding: str = "utf-8-sig"
    header: bool = True
    preamble_rows: int = 0
    units_rows: int = 0
    sheet: str = ""

    @classmethod
    def stated(cls, entry: Mapping[str, Any]) -> Form:
        """The form that an entry of a mapping states."""
        return cls(**{name: entry[name] for name in cls.__dataclass_fields__ if name in entry})

    def entry(self) -> dict[str, Any]:
        """What an entry of a mapping states of it: what is not as by default."""
        return {name: value for name, value in vars(self).items() if value != getattr(Form, name)}


@dataclass(frozen=True)
class Sheet:
    """Cells of one file, with the columns of others that were joined to it.

    header: labels of the columns, as a mapping names them, empty where there are none. rows, lines: cells, and their
    numbers in the file, from 1. full: labels with what stands above them (names of bodies), units: what stands below
    them, for whoever reads meaning from them. sure: False where the text does not tell its encoding.
    """

    path: Path
    form: Form
    header: tuple[str, ...]
    rows: list[list[str]]
    lines: list[int]
    full: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    sure: bool = True

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.rows[0])

    def column(self, k: int) -> list[str]:
        """Cells of a column."""
        return [row[k].strip() for row in self.rows]


def texts(path: Path, encoding: str | None = None) -> tuple[dict[str, str], str, bool]:
    """(texts by the sheet's name, encoding, whether that is certain) of a file; one without a name but of a workbook.

    encoding: that is stated. Raises BadTable.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise BadTable(str(path), f"is larger than {_MAX_BYTES >> 20} MiB", "cut it into files")
        raw = path.read_bytes()
    except OSError as error:
        raise BadTable(str(path), f"cannot be read ({error.strerror})", "check the file") from error
    if raw.startswith(b"PK\x03\x04"):
        return _workbook(path), "utf-8-sig", True
    if (other := next((name for mark, name in _OTHERS if raw.startswith(mark)), "")) != "":
        raise BadTable(str(path), f"is {other}, which is not read", "save it as CSV or XLSX")
    guessed = next((name for mark, name in _MARKS if raw.startswith(mark)), "")
    if not guessed:
        zeros = [raw[k:4096:2].count(0) for k in (0, 1)]
        wide = max(zeros) > len(raw[:4096]) // 8
        guessed = ("utf-16-le" if zeros[1] > zeros[0] else "utf-16-be") if wide else "utf-8"
    for name in (encoding,) if encoding else (guessed, "latin-1"):
        try:
            text = raw.decode(name).replace("\r\n", "\n").replace("\r", "\n")
        except (LookupError, ValueError):  # no such encoding, or not of text, or the text is in another one
            continue
        return {"": _SPACED.sub("=", text) if "=" in text else text}, name, name != "latin-1" or bool(encoding)
    raise BadTable(str(path), f"is not text in the encoding {encoding}", "state the one that it is in, e.g. utf-8")


def _workbook(path: Path) -> dict[str, str]:
    """The sheets of an Excel workbook as tables with tabs."""
    try:
        from openpyxl import load_workbook  # type: ignore[import-untyped]  # an optional library, and a large one
    except ImportError as error:
        remedy = "install openpyxl (pip install modcal[xlsx]), or save the sheet as CSV"
        raise BadTable(str(path), "is a workbook, and openpyxl is not installed", remedy) from error
    try:
        book = load_workbook(path, read_only=True, data_only=True)
        rows = {sheet.title: list(sheet.iter_rows(values_only=True)) for sheet in book.worksheets}
        book.close()
    except Exception as error:  # whatever a damaged archive leads it to
        said = f"cannot be read as an Excel workbook ({type(error).__name__})"
        raise BadTable(str(path), said, "save the sheet as CSV") from error
    return {name: "\n".join("\t".join(map(_cell, row)).rstrip("\t") for row in some) for name, some in rows.items()}


def _cell(value: Any) -> str:
    text = "" if value is None else value.isoformat(" ") if hasattr(value, "hour") and hasattr(value, "year") else value
    return " ".join(str(text).split())


def number(cell: str, decimal: str = ".") -> float | None:
    """The number in a cell; NaN where it says that there is none, None where it says anything else."""
    text = cell.strip()
    if text.lower() in MISSING:
        return float("nan")
    try:
        value = float(text.replace(decimal, "."))
    except ValueError:
        if (found := _PATTERN[decimal].fullmatch(text)) is None:
            return None
        value = float("".join(c for c in found["number"] if c.isalnum() or c in f"+-{decimal}").replace(decimal, "."))
    return float("nan") if value != value or value < _NO_READING else value


def _labels(cells: Sequence[str], width: int) -> tuple[str, ...]:
    """Labels of so many columns; a mark of a comment (#, %) before the first is left out."""
    out = [cell.strip() for cell in cells]
    if out and out[0][:1] in ("#", "%"):
        first = out[0].lstrip("#% ")
        out = [first, *out[1:]] if first or len(out) <= width else out[1:]
    return tuple(out)


def _names(cells: Sequence[str]) -> tuple[str, ...]:
    """Labels that stand in the cells themselves, as X=12.5 has one; none where no cell has one."""
    found = [_NAMED.match(cell) for cell in cells]
    return tuple(name[1] if name else "" for name in found) if any(found) else ()


def _cells(text: str, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """(number of the line from 1, cells) of every filled line of a text. Raises csv.Error."""
    lines = [f"{line}\n" for line in text.split("\n")]
    if delimiter == BLANKS:
        reader = csv.reader((line.strip().replace("\t", " ") for line in lines), delimiter=" ", skipinitialspace=True)
    else:
        reader = csv.reader(lines, delimiter=delimiter)
    before = 0
    for cells in reader:
        if any(cell.strip() for cell in cells):
            yield before + 1, cells
        before = reader.line_num


def _filled(cells: Sequence[str], width: int) -> list[str]:
    """So many cells, empty ones behind those that there are."""
    return [*cells[:width], *[""] * (width - len(cells))]


def read_sheet(path: Path, form: Form) -> Sheet:
    """The cells of a file in a stated form; empty lines are left out. Raises BadTable."""
    found, _, _ = texts(path, form.encoding)
    if form.sheet and form.sheet not in found:
        raise BadTable(str(path), f"has no sheet {form.sheet}", f"sheets are {', '.join(found)}")
    return _in_form(path, found[form.sheet] if form.sheet else next(iter(found.values())), form)


def _in_form(path: Path, text: str, form: Form) -> Sheet:
    """The cells of a text in a form."""
    above = text.split("\n", form.preamble_rows)
    body = above[form.preamble_rows] if len(above) > form.preamble_rows else ""
    try:
        filled = list(_cells(body, form.delimiter))
    except (csv.Error, TypeError, ValueError) as error:
        raise BadTable(str(path), f"is not a table ({error})", "state its delimiter, or give a CSV file") from error
    below = filled[int(form.header) + form.units_rows :]
    rows = [cells for _, cells in below]
    if not rows:
        raise BadTable(str(path), "has no row", "leave the file out")
    header = _labels(filled[0][1], len(rows[0])) if form.header else _names(rows[0])
    width = max(len(header), *map(len, rows))
    rows = [_filled(row, width) for row in rows]
    units = _units_of_cells(path, rows, form.decimal)
    return Sheet(path, form, header, rows, [form.preamble_rows + line for line, _ in below], units=units)


def _units_of_cells(path: Path, rows: Sequence[Sequence[str]], sign: str) -> tuple[str, ...]:
    """The units that stand in the cells of each column. Raises BadTable where a column has several."""
    out = []
    for k, column in enumerate(zip(*rows, strict=True)):
        ended = {cell.strip() for cell in column if not cell[-1:].isdigit()}
        units = {one["unit"].lower() for cell in ended if (one := _PATTERN[sign].fullmatch(cell)) and one["unit"]}
        if len(units) > 1:
            said = f"column {k} holds numbers in {' and in '.join(sorted(units))}"
            raise BadTable(path.name, said, "write one unit in all of them")
        out.append("".join(units))
    return tuple(out)


# --- How a file is written, found out from its text: encoding, separator, decimal sign, labels, units

_SEPARATORS = (";", "\t", ",", "|", BLANKS)  # where two read as much, the first: blanks also stand inside cells
_LINES = 300  # that are looked at to find out how a file is written
_MIN_COLUMNS = 3
_NUMBERS = 0.5  # share of the cells of a row of numbers
_PATTERN = {
    sign: re.compile(
        rf"(?:{_NAMED.pattern})?\s*"
        rf"(?P<number>[+-]?({_GROUPED[sign]}|\d+({re.escape(sign)}\d*)?|{re.escape(sign)}\d+)(e[+-]?\d+)?)"
        rf"\s*(?P<unit>{_CELL_UNIT})?\s*",
        re.IGNORECASE,
    )
    for sign in ".,"
}
_UNIT = re.compile(
    r"[\[(<]?\s*(|-|–|1|mm|cm|m|in|inch|inches|µm|um|deg|degree|degrees|°|grad|rad|radian|radians|mrad|s|sec|seconds|ms|"
    r"us|µs|ns|°c|degc|c|k|k?nm{1,2}|n\s?m|n·m|n|a|v|%|gon|kg|g|bar|hpa|pa|°f|rad/s|deg/s|°/s|mm/s|m/s|hz|bool|int|unitless|none|text|date|datetime)\s*[\])>]?",
    re.IGNORECASE,
)


def sniff(path: Path, least: int = _MIN_COLUMNS) -> Sheet:
    """A file with how it is written. least: columns with numbers. Raises BadTable where no such rows are found."""
    found, encoding, sure = texts(path)
    best: tuple[int, str, Form] = (0, "", Form())
    for name, text in found.items():
        head = "\n".join(text.split("\n", _LINES)[:_LINES])
        for separator, sign in ((a, b) for a in _SEPARATORS for b in ".," if a != b):
            try:
                count, _ = _block([row for _, row in _cells(head, separator)], sign, least)
            except csv.Error:
                continue
            if count > best[0]:
                best = (count, text, Form(separator, sign, sheet=name if len(found) > 1 else ""))
    if not best[0]:
        said = f"holds no block of rows with numbers in {least} columns or more"
        raise BadTable(str(path), said, "give a text table (CSV, TSV), or write a mapping for it")
    form = replace(best[2], encoding="utf-8-sig" if encoding == "utf-8" else encoding)
    return replace(_laid_out(path, best[1], form, least), sure=sure)


def _is_row(cells: list[str], sign: str, least: int) -> int:
    """How many numbers cells hold if they are a row: most of those that hold something, and so many at least."""
    numbers = sum(_PATTERN[sign].fullmatch(cell) is not None for cell in cells)
    missing = sum(cell.strip().lower() in MISSING for cell in cells)
    return numbers if numbers >= least and numbers >= _NUMBERS * (len(cells) - missing) else 0


def _block(rows: list[list[str]], sign: str, least: int) -> tuple[int, int]:
    """(how many numbers there are in rows of the usual width, this width); zeros where there are none."""
    counts = Counter[int]()
    widths = Counter[int]()
    for cells in rows:
        if count := _is_row(cells, sign, least):
            counts[len(cells)] += count
            widths[len(cells)] += 1
    width = widths.most_common(1)[0][0] if widths else 0
    return counts[width], width


def _laid_out(path: Path, text: str, form: Form, least: int) -> Sheet:
    table, sign = list(_cells(text, form.delimiter)), form.decimal
    every = [cells for _, cells in table]
    _, width = _block(every, sign, least)
    first = next(i for i, cells in enumerate(every) if len(cells) == width and _is_row(cells, sign, least))
    above = first
    while above and abs(len(every[above - 1]) - width) <= 1 and not _is_row(every[above - 1], sign, least):
        above -= 1
    stacked = [_labels(cells, width) for cells in every[above:first]]
    units_rows = 0
    for cells in stacked[:0:-1]:
        if not any(cells) or not all(_UNIT.fullmatch(cell) for cell in cells):
            break
        units_rows += 1
    upper = stacked[: max(len(stacked) - 1 - units_rows, 0)]
    preamble = table[first - units_rows - bool(stacked)][0] - 1
    form = replace(form, header=bool(stacked), preamble_rows=preamble, units_rows=units_rows if stacked else 0)
    sheet = _in_form(path, text, form)
    full = _stacked([*upper, sheet.header], sheet.width)
    return replace(sheet, full=full, units=_stacked([*stacked[len(upper) + 1 :], sheet.units], sheet.width))


def _stacked(rows: Sequence[Sequence[str]], width: int) -> tuple[str, ...]:
    """What stands in each column of rows, one below the other."""
    return tuple(" ".join(row[k] for row in rows if k < len(row) and row[k]) for k in range(width))


# --- Columns of another file beside those of a table: rows belong together by number, a station, a name, or a time


def joined(sheet: Sheet, stated: Mapping[str, Any], folder: Path, source: str, other: Sheet | None = None) -> Sheet:
    """A sheet with the columns of another file, each under its own name, or FILE.NAME where that is taken.

    Rows without a partner have empty cells there. other: the file, where it has been read. Raises BadTable where no
    row has a partner, or one has several.
    """
    name = str(stated["files"]).replace("{stem}", sheet.path.stem).replace("{folder}", sheet.path.parent.name)
    path = folder / name
    if other is None:
        if not path.is_file():
            remedy = "give its name relative to the folder of the tables"
            raise BadTable(f"{source}: joined {name}", "is not a file", remedy)
        other = read_sheet(path, Form.stated({"decimal": sheet.form.decimal, **stated}))
    partner = partners(sheet, other, stated, source)
    names = other.header or tuple(f"{path.stem}.{k}" for k in range(other.width))
    names = tuple(f"{path.stem}.{label}" if label in sheet.header else label for label in names)
    cells = [other.column(k) for k in range(other.width)]
    if other.form.decimal != sheet.form.decimal:
        cells = [[cell.replace(other.form.decimal, sheet.form.decimal) for cell in column] for column in cells]
    rows = [
        [*row, *(column[k] if k >= 0 else "" for column in cells)] for row, k in zip(sheet.rows, partner, strict=True)
    ]
    labels = ((sheet.header, names), (sheet.full, other.full or names), (sheet.units, other.units))
    header, full, units = ((*_filled(ours, sheet.width), *_filled(theirs, other.width)) for ours, theirs in labels)
    return Sheet(sheet.path, sheet.form, header, rows, sheet.lines, full, units, sheet.sure)


def partners(sheet: Sheet, other: Sheet, stated: Mapping[str, Any], source: str) -> np.ndarray:
    """The row of the other sheet that belongs to each row (N,), −1 for none."""
    if isinstance(stated["by"], str):
        if stated["by"] != "row":
            said = f"{shown(stated['by'])} is neither columns nor row"
            raise BadTable(f"{source}: joined: by", said, "state {column here: column there}, or row")
        if len(sheet.rows) != len(other.rows):
            said = f"{sheet.path.name} has {len(sheet.rows)} rows, {other.path.name} has {len(other.rows)}"
            raise BadTable(f"{source}: joined", said, "name columns in by")
        return np.arange(len(sheet.rows))
    (ours, theirs), *_ = stated["by"].items()
    wanted = [cell_value(cell, sheet.form.decimal) for cell in sheet.column(index(sheet, ours))]
    known = [cell_value(cell, other.form.decimal) for cell in other.column(index(other, theirs))]
    if "within" in stated:
        numbers = [np.array([k if isinstance(k, float) else np.nan for k in side]) for side in (wanted, known)]
        partner = _nearest(numbers[0], numbers[1], float(stated["within"]))
    else:
        rows: dict[object, int] = {}
        for k, key in enumerate(known):
            if key in rows and key != "":
                said = f"lines {other.lines[rows[key]]} and {other.lines[k]} both have {theirs} {key}"
                raise BadTable(other.path.name, said, "state within: for times, or leave one of them out")
            rows[key] = k
        partner = np.array([rows.get(key, -1) if key != "" else -1 for key in wanted])
    if not (partner >= 0).any():
        said = f"no row of {other.path.name} has a {theirs} that is a {ours} of {sheet.path.name}"
        raise BadTable(f"{source}: joined", said, "check the columns in by, or state within")
    return partner


def _nearest(wanted: Array, known: Array, within: float) -> np.ndarray:
    """The row of the nearest known number to each wanted one, −1 where none is near enough."""
    order = np.argsort(known)[: int(np.isfinite(known).sum())]
    if not len(order):
        return np.full(len(wanted), -1)
    right = np.clip(np.searchsorted(known[order], wanted), 0, len(order) - 1)
    both = order[np.stack([np.maximum(right - 1, 0), right])]
    gap = np.abs(known[both] - wanted)
    return np.where(gap.min(axis=0) <= within, np.take_along_axis(both, gap.argmin(axis=0)[None], 0)[0], -1)


def cell_value(cell: str, decimal: str = ".") -> float | str:
    """The number in a cell, else its text."""
    value = number(cell, decimal)
    return cell.strip() if value is None or value != value else value


def index(sheet: Sheet, key: Any) -> int:
    """The number of a column that is given by its label or by its number. Raises BadTable."""
    if isinstance(key, int) and not isinstance(key, bool) and 0 <= key < sheet.width:
        return key
    if key in sheet.header:
        if sheet.header.count(key) > 1:
            places = ", ".join(str(i) for i, label in enumerate(sheet.header) if label == key)
            said = f"has {sheet.header.count(key)} columns {key}"
            raise BadTable(sheet.path.name, said, f"give the number of the one that is meant: {places}")
        return sheet.header.index(key)
    known = ", ".join(label for label in sheet.header if label) or f"0 to {sheet.width - 1}"
    raise BadTable(sheet.path.name, f"has no column {key}", f"columns are {known}")
