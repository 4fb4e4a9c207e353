"""Several files as one: the column by which their rows belong together is found out, as a mapping states it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_msgs_py.tables.candidates import Numbers
from modcal_msgs_py.tables.sheet import Form, Sheet
from modcal_msgs_py.tables.sniff import Sniffed, sniff
from modcal_msgs_py.tables.table import Faults, Table, join

_MIN_COLUMNS = 2  # of a further file: the shared one, and one more
_SHARED = 0.5  # of the rows must have a partner
_KEYS = {
    "station",
    "id",
    "pose",
    "index",
    "nr",
    "no",
    "number",
    "point",
    "frame",
    "time",
    "timestamp",
    "stamp",
    "t",
    "sample",
}
_STEP = 0.5  # of the usual step of the finer file, by which times may differ


@dataclass(frozen=True)
class Together:
    """A file with the columns of others beside its own. stated: the entries under joined. said: how."""

    sniffed: Sniffed
    stated: tuple[dict[str, Any], ...] = ()
    said: tuple[str, ...] = ()


def together(paths: Sequence[Path]) -> Together:
    """The first file with the others joined to it. Raises BadTable where no column tells which rows belong together."""
    first = sniff(paths[0])
    out = Together(first)
    for path in paths[1:]:
        out = _joined(out, path)
    return out


def _joined(known: Together, path: Path) -> Together:
    ours, theirs = Numbers.of(known.sniffed), Numbers.of(sniff(path, _MIN_COLUMNS))
    found = _keys(ours, theirs)
    if found is None:
        said = f"shares no column of station numbers or times with {known.sniffed.path.name}"
        raise BadTable(path.name, said, "state joined: {files, by} in a mapping, see docs/import.md")
    a, b, within = found
    form = {name: value for name, value in vars(theirs.sniffed.form).items() if value != getattr(Form(), name)}
    stated: dict[str, Any] = {"files": path.name, **form, "by": {ours.key(a): theirs.key(b)}}
    if within is not None:
        stated["within"] = within
    sniffed = known.sniffed
    form = {k: v for k, v in form.items() if k != "decimal"}
    sheet = Sheet(sniffed.path, sniffed.labels, sniffed.rows, list(range(len(sniffed.rows))), sniffed.form.decimal)
    table = Table(sheet, Faults(sniffed.path.name))
    # as the mapping will do it, so that names and rows are the same
    join(table, {**stated, "decimal": theirs.sniffed.form.decimal}, path.parent, sniffed.path.name)
    stated.setdefault("decimal", theirs.sniffed.form.decimal)
    width = sniffed.width
    new = list(table.joined.items())
    rows = [[*row, *[""] * (width - len(row)), *(cells[i] for _, cells in new)] for i, row in enumerate(sniffed.rows)]
    pad = [""] * (width - len(sniffed.full))
    full = {
        label: theirs.sniffed.full[k] for k, label in enumerate(theirs.sniffed.labels) if k < len(theirs.sniffed.full)
    }
    units = dict(zip(theirs.sniffed.labels, theirs.sniffed.units, strict=False))

    def plain(name: str) -> str:
        return name.removeprefix(f"{path.stem}.")

    whole = replace(
        sniffed,
        labels=(*sniffed.labels, *[""] * (width - len(sniffed.labels)), *(name for name, _ in new)),
        full=(*sniffed.full, *pad, *(full.get(plain(name), name) for name, _ in new)),
        units=(*sniffed.units, *[""] * (width - len(sniffed.units)), *(units.get(plain(name), "") for name, _ in new)),
        rows=rows,
    )
    how = f"{ours.shown(a)} of {sniffed.path.name} is {theirs.shown(b)} of {path.name}"
    how += f", the nearest within {within:g}" if within is not None else ""
    return Together(whole, (*known.stated, stated), (*known.said, how))


def _keys(ours: Numbers, theirs: Numbers) -> tuple[int, int, float | None] | None:
    """Columns by which rows belong together: same numbers, else times that are near; and how near."""
    best: tuple[float, int, int, float | None] | None = None
    for a in ours.usable():
        for b in theirs.usable():
            if not isinstance(ours.key(a), str) or not isinstance(theirs.key(b), str):
                continue
            named = bool(_KEYS & set(ours.labels[a].words)) and bool(_KEYS & set(theirs.labels[b].words))
            if not named:
                continue
            share, within = _share(ours.values[:, a], theirs.values[:, b])
            alike = ours.labels[a].words == theirs.labels[b].words
            score = share + 0.2 * alike + 0.1 * (within is None)
            if share >= _SHARED and (best is None or score > best[0]):
                best = (score, a, b, within)
    return None if best is None else best[1:]


def _share(a: Array, b: Array) -> tuple[float, float | None]:
    """Share of the rows with a partner, and how near partners are where their numbers are not the same."""
    a, b = a[np.isfinite(a)], np.sort(b[np.isfinite(b)])
    if len(a) < 3 or len(b) < 3:
        return 0.0, None
    if len(np.unique(b)) == len(b):
        same = float(np.isin(a, b).mean())
        if same >= _SHARED:
            return same, None
    if (np.diff(a) < 0.0).any():
        return 0.0, None
    step = min(float(np.median(np.diff(x))) for x in (np.unique(a), np.unique(b)))
    within = float(f"{_STEP * step:.2g}")
    gap = np.abs(a[:, None] - b[np.clip(np.searchsorted(b, a)[:, None] + np.array([-1, 0]), 0, len(b) - 1)]).min(axis=1)
    return (float((gap <= within).mean()), within) if within > 0.0 else (0.0, None)
