"""The columns of a table that say when a row was taken: dates, seconds, or nothing but the order of the rows."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from itertools import pairwise, product
from typing import Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements import ORDER_ONLY, Schema
from modcal_msgs_py.tables.columns import Numbers
from modcal_msgs_py.tables.labels import words
from modcal_msgs_py.tables.readings import COLUMN, mapping, one_of
from modcal_msgs_py.tables.table import Table

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
