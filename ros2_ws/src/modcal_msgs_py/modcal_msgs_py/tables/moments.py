"""The columns of a table that say when a row was taken: dates, seconds, or nothing but the order of the rows."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements import ORDER_ONLY
from modcal_msgs_py.tables.candidates import Numbers
from modcal_msgs_py.tables.table import Table

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LAST = 2.0**31  # s; stamps of messages end in 2038
_ORDER_STEP = 1e-3  # s between rows that a table stamps alike


def stamps_of(table: Table, time: Mapping[str, Any], clock: float) -> tuple[Array, str | None]:
    """Stamps (N,) [s], no two alike, and what has to be said of them. NaN for rows that have none.

    clock: where the stamps of a table by order begin [s].
    """
    if "order" in time:
        return clock + float(time["order"]["period_s"]) * np.arange(1.0, len(table) + 1), ORDER_ONLY
    if "format" in time:
        column = time["column"]
        out = _dates(table, column, time["format"])
    else:
        column = time["seconds"]
        out = SECONDS[time.get("unit", "s")] * table.numbers(column)
    for i in np.flatnonzero(np.isfinite(out) & ~((out >= 0.0) & (out < LAST))):
        table.bad(int(i), column, f"{out[i]:g} s is not a plausible time", "is not a plausible time")
        out[i] = np.nan
    if "format" in time:
        table.lack(np.flatnonzero([not cell for cell in table.text(column)]), f"column {column}")
    else:
        table.present(column)
    there = np.flatnonzero(np.isfinite(out))
    falls = int((np.diff(out[there]) < 0.0).sum())
    warning = f"{table.path.name}: {falls} rows are stamped before the row above them." if falls else None
    # rows within the clock's resolution are still rows of their own
    order = there[np.argsort(out[there], kind="stable")]
    rising = out[order]
    out[order] = rising + _ORDER_STEP * (np.arange(len(rising)) - np.searchsorted(rising, rising))
    return out, warning


def _dates(table: Table, column: Any, form: str) -> Array:
    out = np.full(len(table), np.nan)
    for i, cell in enumerate(table.text(column)):
        if not cell:
            continue
        try:
            moment = datetime.strptime(cell, form)
            if moment.year == 1900:  # a time of day without a date
                moment = moment.replace(year=1970)
            out[i] = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
        except (ValueError, IndexError, KeyError, OverflowError, re.error):
            table.bad(i, column, f"'{cell[:40]}' is not {form}", form)
    return out


_NAMES = {
    "time",
    "timestamp",
    "stamp",
    "t",
    "zeit",
    "seconds",
    "sec",
    "secs",
    "epoch",
    "datetime",
    "date",
    "uhrzeit",
    "temps",
}
_FORMATS = (
    "%Y-%m-%d %H:%M:%S", "%Y-%m-%d %H:%M:%S.%f", "%Y-%m-%dT%H:%M:%S", "%Y-%m-%dT%H:%M:%S.%f", "%Y-%m-%dT%H:%M:%SZ",
    "%Y-%m-%dT%H:%M:%S.%fZ", "%Y-%m-%dT%H:%M:%S%z", "%Y/%m/%d %H:%M:%S", "%Y/%m/%d %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S",
    "%d.%m.%Y %H:%M:%S.%f", "%m/%d/%Y %H:%M:%S", "%m/%d/%Y %I:%M:%S %p", "%d/%m/%Y %H:%M:%S", "%Y%m%d%H%M%S",
    "%d.%m.%Y %H:%M", "%H:%M:%S", "%H:%M:%S.%f",
)  # fmt: skip
_ORDER_S = 10.0  # s between rows of which only the order is known
_EPOCH = 1e9  # s since 1970 are more than this, from 2001 on
_ROWS = 200  # that are tried with a format


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
    return RowTimes({"order": {"period_s": _ORDER_S}}, (), said)


def _dates_of_rows(numbers: Numbers, columns: tuple[int, ...]) -> RowTimes | None:
    rows = numbers.sniffed.rows[:_ROWS]
    cells = [" ".join(row[k].strip() for k in columns if k < len(row)).strip() for row in rows]
    cells = [cell for cell in cells if cell]
    if not cells or (not any(sign in cells[0] for sign in ":-/.") and len(cells[0]) != 14):
        return None
    fits = [form for form in _FORMATS if all(_reads(cell, form) for cell in cells)]
    if not fits:
        return None
    keys = [numbers.key(k) for k in columns]
    names = " and ".join(numbers.shown(k) for k in columns)
    also = f" ({fits[1]} would read them, too)" if len(fits) > 1 and "%m" in fits[1] else ""
    said = f"{names} holds the time, as {fits[0]}{also}, in UTC"
    return RowTimes({"column": keys[0] if len(keys) == 1 else keys, "format": fits[0]}, columns, said)


def _reads(cell: str, form: str) -> bool:
    try:
        datetime.strptime(cell, form)
    except ValueError:
        return False
    return True


def _seconds(numbers: Numbers, k: int) -> RowTimes | None:
    column = numbers.values[:, k]
    column = column[np.isfinite(column)]
    if len(column) < 2 or column.min() < 0.0 or (np.diff(column) < 0.0).mean() > 0.01 or np.ptp(column) == 0.0:
        return None
    label = numbers.labels[k]
    told = label.unit if label.unit in SECONDS else next((w for w in label.words if w in SECONDS), None)
    powers = {"s": _EPOCH, "ms": 1e3 * _EPOCH, "us": 1e6 * _EPOCH, "ns": 1e9 * _EPOCH}
    since_1970 = [u for u, low in powers.items() if low < column.min() and SECONDS[u] * column.max() < LAST]
    unit = since_1970[0] if len(since_1970) == 1 else told or "s"
    how = "since 1970, by its size" if len(since_1970) == 1 else "by its label" if told else "assumed: no unit is told"
    if SECONDS[unit] * column.max() >= LAST:
        return None
    stated: dict[str, Any] = {"seconds": numbers.key(k)}
    if unit != "s":
        stated["unit"] = unit
    return RowTimes(stated, (k,), f"{numbers.shown(k)} holds the time in {unit} ({how})")
