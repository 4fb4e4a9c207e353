"""When the rows of a table were taken: seconds, dates in a stated format, or their order only."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import ORDER_ONLY
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
