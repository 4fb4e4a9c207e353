"""Several files as one table: rows belong together by a column that the files share, or by their order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_msgs_py.tables.columns import Numbers
from modcal_msgs_py.tables.labels import words
from modcal_msgs_py.tables.sheet import Sheet, joined, sniff

_SHARED = 0.5  # of the rows must have a partner
_KEYS = words("station id pose index nr no number point frame time timestamp stamp t sample")
_STEP = 0.5  # of the usual step of the finer file, by which times may differ
_MIN_SHARED, _MIN_COLUMNS = 3, 2


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
    if (found := _shared(ours, theirs)) is not None:
        a, b, within = found
        how = f"{ours.shown(a)} of {known.sheet.path.name} is {theirs.shown(b)} of {path.name}"
        near = {} if within is None else {"within": within}
        how += "" if within is None else f", the nearest within {within:g}"
        options.append(({"by": {ours.key(a): theirs.key(b)}, **near}, how))
    if len(known.sheet.rows) == len(other.rows):
        how = f"rows of {path.name} belong to those of {known.sheet.path.name} in their order, as the fit bears out"
        options.append(({"by": "row"}, how))
    for by, how in options:
        stated = {"files": path.name, **form, **by}
        sheet = joined(known.sheet, stated, path.parent, known.sheet.path.name, other)
        yield Together(sheet, (*known.stated, stated), (*known.said, how))


def _shared(ours: Numbers, theirs: Numbers) -> tuple[int, int, float | None] | None:
    """Columns by which rows belong together: same numbers, else times that are near; and how near."""
    sides = [
        [k for k in n.usable if isinstance(n.key(k), str) and _KEYS & set(n.labels[k].words)] for n in (ours, theirs)
    ]
    found = [
        (share + 0.2 * (ours.labels[a].words == theirs.labels[b].words) + 0.1 * (within is None), (a, b, within))
        for a, b in product(*sides)
        for share, within in [_share(ours.values[:, a], theirs.values[:, b])]
        if share >= _SHARED
    ]
    return max(found, key=lambda pair: pair[0])[1] if found else None


def _share(a: Array, b: Array) -> tuple[float, float | None]:
    """Share of the rows with a partner, and how near partners are where their numbers are not the same."""
    a, b = a[np.isfinite(a)], np.sort(b[np.isfinite(b)])
    if len(a) < _MIN_SHARED or len(b) < _MIN_SHARED:
        return 0.0, None
    if len(np.unique(b)) == len(b) and (same := float(np.isin(a, b).mean())) >= _SHARED:
        return same, None
    if (np.diff(a) < 0.0).any():
        return 0.0, None
    within = float(f"{_STEP * min(float(np.median(np.diff(np.unique(x)))) for x in (a, b)):.2g}")
    at = np.clip(np.searchsorted(b, a)[:, None] + np.array([-1, 0]), 0, len(b) - 1)
    gap = np.abs(a[:, None] - b[at]).min(axis=1)
    return (float((gap <= within).mean()), within) if within > 0.0 else (0.0, None)
