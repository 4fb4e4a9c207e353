"""Columns of another file beside those of a table: rows belong together by a station's number, a name, or a time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_msgs_py.tables.faults import Faults
from modcal_msgs_py.tables.sheet import Form, read_sheet
from modcal_msgs_py.tables.table import Table, number


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
