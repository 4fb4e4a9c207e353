"""Rows of tables: when each was taken, several files as one table, and the track of a handle."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from io import StringIO
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.measurements import ORDER_ONLY, Schema
from modcal_msgs_py.tables.columns import Numbers
from modcal_msgs_py.tables.labels import COMMANDED, MEASURED, grouped, words
from modcal_msgs_py.tables.readings import COLUMN, UNITS, mapping, one_of
from modcal_msgs_py.tables.sheet import Sheet, joined, number, partners, sniff
from modcal_msgs_py.tables.table import Table

_SHARED = 0.5  # of the rows must have a partner
_KEYS = words("station id pose index nr no number point frame time timestamp stamp t sample")
_STEP = 0.5  # of the usual step of the finer file, by which times may differ
_MIN_COLUMNS = 2


@dataclass(frozen=True)
class Together:
    """A file with the columns of others beside its own. stated: the entries under joined. said: how."""

    sheet: Sheet
    stated: tuple[dict[str, Any], ...] = ()
    said: tuple[str, ...] = ()


def together(paths: Sequence[Path]) -> list[Together]:
    """The first file with the others joined to it, in every likely way. Raises BadTable where there is none."""
    ways = [Together(sniff(paths[0]))]
    for path in paths[1:]:
        other = sniff(path, _MIN_COLUMNS)
        first = ways[0].sheet
        ways = [way for known in ways for way in _joined(known, other, path)]
        if not ways:
            said = f"shares no column of station numbers or times with {first.path.name}, and has other rows"
            raise BadTable(path.name, said, "state joined: {files, by} in a mapping, see docs/import.md")
    return ways


def _joined(known: Together, other: Sheet, path: Path) -> Iterator[Together]:
    ours, theirs = Numbers.of(known.sheet), Numbers.of(other)
    form = {**other.form.entry(), "decimal": other.form.decimal}
    options: list[tuple[dict[str, Any], str]] = []
    if (found := _shared(ours, theirs, path)) is not None:
        a, b, near = found
        how = f"{ours.shown(a)} of {known.sheet.path.name} is {theirs.shown(b)} of {path.name}"
        how += f", the nearest within {near['within']:g}" if near else ""
        options.append(({"by": {ours.key(a): theirs.key(b)}, **near}, how))
    if len(known.sheet.rows) == len(other.rows):
        how = f"rows of {path.name} belong to those of {known.sheet.path.name} in their order, as the fit bears out"
        options.append(({"by": "row"}, how))
    for by, how in options:
        stated = {"files": path.name, **form, **by}
        sheet = joined(known.sheet, stated, path.parent, known.sheet.path.name, other)
        yield Together(sheet, (*known.stated, stated), (*known.said, how))


def _shared(ours: Numbers, theirs: Numbers, path: Path) -> tuple[int, int, dict[str, float]] | None:
    """Columns by which most rows belong together: same numbers, else times that are near; and how near, as stated."""
    sides = [
        [k for k in n.usable if isinstance(n.key(k), str) and _KEYS & set(n.labels[k].words)] for n in (ours, theirs)
    ]
    found: list[tuple[float, tuple[int, int, dict[str, float]]]] = []
    for a, b in product(*sides):
        times, others = (n.whole([k])[:, 0] for n, k in ((ours, a), (theirs, b)))
        step = float(f"{_STEP * min(float(np.median(np.diff(np.unique(x)))) for x in (times, others)):.2g}")
        rising = step > 0.0 and bool((np.diff(times) >= 0.0).all())
        for near in ({}, {"within": step}) if rising else ({},):
            try:
                partner = partners(ours.sheet, theirs.sheet, {"by": {ours.key(a): theirs.key(b)}, **near}, path.name)
            except BadTable:  # no row has a partner, or one has several
                continue
            share = float((partner[np.isfinite(ours.values[:, a])] >= 0).mean())
            score = share + 0.2 * (ours.labels[a].words == theirs.labels[b].words) + 0.1 * (not near)
            if share >= _SHARED:
                found.append((score, (a, b, near)))
                break
    return max(found, key=lambda pair: pair[0])[1] if found else None


SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "excel": 86400.0}  # excel: days since 1899-12-30
_EXCEL_1970 = 25569.0  # days
_LAST = 2.0**31  # s; stamps of messages end in 2038
_ORDER_STEP = 1e-3  # s between rows that a table stamps alike
_COLUMNS: Schema = {"type": ["string", "integer", "array"], "items": COLUMN, "minItems": 1, "maxItems": 2}
_FORMAT: Schema = {"type": "string", "minLength": 1, "description": "as strptime has it: %Y-%m-%d %H:%M:%S"}
_PERIOD: Schema = {"type": "number", "exclusiveMinimum": 0, "maximum": 1e6}
TIME: Schema = {
    "type": "object",
    "oneOf": [
        mapping({"column": _COLUMNS, "format": _FORMAT}, "column", "format"),
        mapping({"seconds": COLUMN, "unit": one_of(*SECONDS)}, "seconds"),
        mapping({"order": mapping({"period_s": _PERIOD}, "period_s")}, "order"),
    ],
    "description": "when a row was taken: a date, a number of seconds, or its order only",
}


def in_seconds(values: Array, unit: str) -> Array:
    """Times [s] of numbers in a unit."""
    return np.asarray(SECONDS[unit] * (values - (_EXCEL_1970 if unit == "excel" else 0.0)))


def stamps_of(table: Table, time: Mapping[str, Any], clock: float) -> tuple[Array, str | None]:
    """Stamps (N,) [s], no two alike, and what has to be said of them. NaN for rows that have none.

    clock: where the stamps of a table by order begin [s].
    """
    if "order" in time:
        return clock + float(time["order"]["period_s"]) * np.arange(1.0, len(table) + 1), ORDER_ONLY
    if "format" in time:
        column = time["column"]
        out = _dates(table, column, time["format"])
        table.lack(np.flatnonzero([not cell for cell in table.text(column)]), f"column {column}")
    else:
        column = time["seconds"]
        out = in_seconds(table.numbers(column), time.get("unit", "s"))
    for i in np.flatnonzero(np.isfinite(out) & ~((out >= 0.0) & (out < _LAST))):
        table.bad(int(i), column, f"{out[i]:g} s is not a plausible time", "is not a plausible time")
        out[i] = np.nan
    if "format" not in time:
        table.present(column)
    there = np.flatnonzero(np.isfinite(out))
    falls = int((np.diff(out[there]) < 0.0).sum())
    warning = f"{table.path.name}: {falls} rows are stamped before the row above them." if falls else None
    # rows within the clock's resolution are still rows of their own
    order = there[np.argsort(out[there], kind="stable")]
    rising = out[order]
    out[order] = rising + _ORDER_STEP * (np.arange(len(rising)) - np.searchsorted(rising, rising))
    return out, warning


_FINER = re.compile(r"([.,]\d{6})\d+")  # nanoseconds


def _moment(cell: str, form: str) -> float | None:
    """Seconds since 1970; None for what is not in this format."""
    try:
        moment = datetime.strptime(_FINER.sub(r"\1", cell), form)
        if moment.year == 1900:  # a time of day without a date
            moment = moment.replace(year=1970)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    except (ValueError, IndexError, KeyError, OverflowError, re.error):
        return None


def _dates(table: Table, column: Any, form: str) -> Array:
    out = np.full(len(table), np.nan)
    for i, cell in enumerate(table.text(column)):
        if (moment := _moment(cell, form)) is not None:
            out[i] = moment
        elif cell:
            table.bad(i, column, f"'{cell[:40]}' is not {form}", form)
    return out


_NAMES = words("time timestamp stamp t zeit seconds sec secs epoch datetime date datum uhrzeit temps clock utc")
# Every date with every time of day and zone; where two read all cells, the first counts
_DATES = "%Y-%m-%d|%Y/%m/%d|%d.%m.%Y|%m/%d/%Y|%d/%m/%Y|%Y.%m.%d|%d-%m-%Y|%Y%m%d|%d-%b-%Y|%d %b %Y|%b %d %Y"
_DATES += "|%d.%m.%y|%m/%d/%y|%Y:%m:%d"
_TIMES = ("%H:%M:%S", "%H:%M:%S.%f", "%H:%M:%S,%f", "%I:%M:%S %p", "%H:%M", "%H%M%S", "%H-%M-%S", "%I:%M %p")
_BETWEEN, _ZONES = (" ", "T", "_", ", ", ",", "-", ""), ("", "Z", "%z", " %z", " UTC")
_ORDER_S = 10.0  # s between rows of which only the order is known
_EPOCH = 1e9  # s since 1970 are more than this, from 2001 on
_DAYS = words("date datum datetime")
_ROWS = 200  # that are tried with a format


@cache
def _formats() -> tuple[tuple[str, str], ...]:
    """(format, the signs that it must find) of every date and time, and of times alone."""
    times = [f"{time}{zone}" for zone, time in product(_ZONES, _TIMES)]
    forms = [f"{date}{between}{time}" for between, time, date in product(_BETWEEN, times, _DATES.split("|"))]
    return tuple((form, re.sub("%.", "", form)) for form in (*forms, *times))


@dataclass(frozen=True)
class RowTimes:
    """What a mapping states of the time, which columns it is in, and what had to be assumed."""

    stated: dict[str, Any]
    columns: tuple[int, ...]
    said: str


def find_time(numbers: Numbers, taken: set[int]) -> RowTimes:
    """When the rows were taken, as far as labels and cells say."""
    named = [k for k, label in numbers.labels.items() if k not in taken and _NAMES & set(label.words)]
    for columns in (*pairwise(named), *((k,) for k in named)):
        if (found := _dates_of_rows(numbers, columns)) is not None:
            return found
    for k in named:
        if (found := _seconds(numbers, k)) is not None:
            return found
    said = f"no column says when a row was taken: rows count as {_ORDER_S:g} s apart, and nothing is told of drift"
    for k in named[:1]:
        cell = next((cell for cell in numbers.sheet.column(k) if cell), "")
        said += f"; {numbers.shown(k)} is called a time, and '{cell[:40]}' is in no format that is known: state time"
    return RowTimes({"order": {"period_s": _ORDER_S}}, (), said)


def _dates_of_rows(numbers: Numbers, columns: tuple[int, ...]) -> RowTimes | None:
    rows = zip(*(numbers.sheet.column(k)[:_ROWS] for k in columns), strict=True)
    cells = [cell for cell in (" ".join(row).strip() for row in rows) if cell]
    if not cells or (not any(sign in cells[0] for sign in ":-/.") and len(cells[0]) != 14):
        return None
    likely = [form for form, signs in _formats() if set(signs) <= set(cells[0])]
    fits = [form for form in likely if all((_moment(cell, form) or 0.0) > 0.0 for cell in cells)]
    if not fits:
        return None
    keys = [numbers.key(k) for k in columns]
    names = " and ".join(numbers.shown(k) for k in columns)
    other = next((form for form in fits[1:] if "%m" in form and form.index("%m") != fits[0].find("%m")), "")
    also = f" ({other} would read them, too)" if other else ""
    said = f"{names} holds the time, as {fits[0]}{also}, in UTC"
    return RowTimes({"column": keys[0] if len(keys) == 1 else keys, "format": fits[0]}, columns, said)


def _seconds(numbers: Numbers, k: int) -> RowTimes | None:
    column = numbers.values[:, k]
    column = column[np.isfinite(column)]
    if len(column) < 2 or column.min() < 0.0 or (np.diff(column) < 0.0).mean() > 0.01 or np.ptp(column) == 0.0:
        return None
    label = numbers.labels[k]
    told = label.unit if label.unit in SECONDS else next((w for w in label.words if w in SECONDS), None)
    dated = told is None and (bool(_DAYS & set(label.words)) or float(np.median(np.diff(column))) < _ORDER_STEP)
    dates = {u: in_seconds(column, u) for u in SECONDS if u != "excel" or dated}
    units = [u for u, t in dates.items() if t.min() > _EPOCH and t.max() < _LAST]
    unit = units[0] if len(units) == 1 else told or "s"
    how = "a date, by its size" if len(units) == 1 else "by its label" if told else "assumed: no unit is told"
    if in_seconds(column, unit).max() >= _LAST:
        return None
    stated = {"seconds": numbers.key(k), **({"unit": unit} if unit != "s" else {})}
    return RowTimes(stated, (k,), f"{numbers.shown(k)} holds the time in {unit} ({how})")


_FORMS = "x y z, or x y z qx qy qz qw, a time before them or not"
_WIDTHS = (3, 7)  # of a bare row without its time
_MISSING = 0.5  # share of the rows that may lack a number


@dataclass(frozen=True)
class TextTrack:
    """Positions (m, 3) [m], or poses x y z qx qy qz qw (m, 7); stamps (m,) [s] or None; how many rows were left out.

    unread: columns of angles, whose convention no track tells.
    """

    values: Array
    stamps: Array | None = None
    left_out: int = 0
    unread: str = ""


def read_track(path: Path) -> TextTrack:
    """The track in a text file, from rows of numbers alone or by the labels above them. Raises BadTable.

    Separators of bare rows are blanks, commas or semicolons, and # begins a comment; of four or eight numbers, the
    first is the time. A table may have any separator, unit of length and further columns; rows of it in which a
    tracker wrote no number are left out.
    """
    try:
        text = path.read_text(encoding="utf-8-sig").translate({ord(","): " ", ord(";"): " "})
    except UnicodeDecodeError as error:
        raise BadTable(str(path), "is neither a bag nor text", f"give a bag, or lines of {_FORMS}") from error
    words = next((words for line in text.splitlines() if (words := line.partition("#")[0].split())), None)
    if words is None:
        raise BadTable(str(path), "holds no numbers", f"give lines of {_FORMS}")
    return _bare(path, text) if all(number(word) is not None for word in words) else _labelled(path)


def _bare(path: Path, text: str) -> TextTrack:
    """Rows of 3 or 7 numbers, or of 4 or 8 that begin with a time."""
    remedy = f"give in every line {_FORMS}"
    try:
        values = np.loadtxt(StringIO(text), ndmin=2)
    except ValueError as error:
        said = f"is not rows of as many numbers ({str(error).partition(';')[0]})"
        raise BadTable(str(path), said, remedy) from error
    width, timed = values.shape[1], values.shape[1] - 1 in _WIDTHS
    if not timed and width not in _WIDTHS:
        raise BadTable(str(path), f"has {width} numbers in a row", remedy)
    if timed and not (np.diff(values[:, 0]) >= 0.0).all():
        said = f"has {width} numbers in a row, and the first is no time: it goes back"
        raise BadTable(str(path), said, remedy)
    return TextTrack(values[:, 1:], values[:, 0]) if timed else TextTrack(values)


def _labelled(path: Path) -> TextTrack:
    """The one position, with the one quaternion and the time where there are such, that labels name."""
    try:
        numbers = Numbers.of(sniff(path))
    except BadTable as error:
        raise BadTable(str(path), "is not numbers", f"give {_FORMS}, or labels above them") from error
    time = find_time(numbers, set())
    free = {k: label for k, label in numbers.labels.items() if k not in time.columns}
    read = {k: label for k, label in free.items() if label.role in (MEASURED, COMMANDED) and not label.computed}
    axes = {k: axis for k, label in read.items() if (axis := label.axis("position")) is not None}
    if twice := [k for k, axis in axes.items() if list(axes.values()).count(axis) > 1]:
        said = f"has two columns labelled {numbers.shown(twice[0])}"
        raise BadTable(str(path), said, "give each a label of its own")
    named = grouped(read, "position")
    if len(named) != 1:
        shown = ", ".join(numbers.shown(place[0]) for place in named)
        said = f"{len(named)} positions by its labels ({shown})" if named else "no columns x, y and z by its labels"
        raise BadTable(str(path), f"has {said}", "give one: columns x, y, z, and qx, qy, qz, qw for rotations")
    units = {free[k].unit for k in named[0]}
    unit = units.pop() or "m" if len(units) == 1 else ""
    if unit not in ("m", "cm", "mm", "in"):
        raise BadTable(str(path), "has columns of the position in several units, or none of length", "give metres")
    turns = grouped(free, "quaternion")
    if len(turns) > 1:
        raise BadTable(str(path), f"has {len(turns)} quaternions by its labels", "give one: qx, qy, qz, qw")
    values = UNITS[unit] * numbers.values[:, list(named[0])]
    if turns:
        values = np.hstack([values, numbers.values[:, list(turns[0])]])
    kept: np.ndarray = np.asarray(np.isfinite(values).all(axis=1))
    stamps = None
    if "seconds" in time.stated:
        stamps = in_seconds(numbers.values[:, time.columns[0]], time.stated.get("unit", "s"))
        kept &= np.isfinite(stamps)
        stamps = stamps[kept]
    if kept.mean() < _MISSING:
        said = f"has {int((~kept).sum())} of {len(kept)} rows without all numbers of the handle, half is allowed"
        raise BadTable(str(path), said, "record while the handle is seen")
    angles = [] if turns else grouped(free, "angles")
    unread = numbers.shown(*angles[0]) if angles else ""
    return TextTrack(values[kept], stamps, int((~kept).sum()), unread)
