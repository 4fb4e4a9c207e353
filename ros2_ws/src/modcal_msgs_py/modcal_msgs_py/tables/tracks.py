"""The track of a handle in a text file: bare numbers, or a table whose labels say which columns they are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_msgs_py.tables.columns import Numbers
from modcal_msgs_py.tables.labels import COMMANDED, MEASURED, grouped
from modcal_msgs_py.tables.moments import find_time, in_seconds
from modcal_msgs_py.tables.readings import UNITS
from modcal_msgs_py.tables.sheet import number, sniff

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
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise BadTable(str(path), "is neither a bag nor text", f"give a bag, or lines of {_FORMS}") from error
    words = [(k, row) for k, line in enumerate(lines, 1) if (row := _words(line))]
    if not words:
        raise BadTable(str(path), "holds no numbers", f"give lines of {_FORMS}")
    if any(number(word) is None for word in words[0][1]):
        return _labelled(path, words[0][0])
    return _bare(path, words)


def _words(line: str) -> list[str]:
    return line.partition("#")[0].replace(",", " ").replace(";", " ").split()


def _bare(path: Path, words: list[tuple[int, list[str]]]) -> TextTrack:
    """Rows of 3 or 7 numbers, or of 4 or 8 that begin with a time."""
    width = len(words[0][1])
    for line, row in words:
        if any(number(word) is None for word in row):
            raise BadTable(f"{path}, line {line}", "is not numbers", f"give {_FORMS}")
        if len(row) != width or not {width, width - 1} & set(_WIDTHS):
            raise BadTable(f"{path}, line {line}", f"has {len(row)} numbers", f"give in every line {_FORMS}")
    values = np.array([list(map(number, row)) for _, row in words], float)
    if width in _WIDTHS:
        return TextTrack(values)
    stamps = values[:, 0]
    back = np.flatnonzero(~(np.diff(stamps) >= 0.0))
    if len(back):
        line = words[int(back[0]) + 1][0]
        said = f"has {width} numbers, and the first is no time: it goes back"
        raise BadTable(f"{path}, line {line}", said, f"give {_FORMS}")
    return TextTrack(values[:, 1:], stamps)


def _labelled(path: Path, line: int) -> TextTrack:
    """The one position, with the one quaternion and the time where there are such, that labels name."""
    try:
        numbers = Numbers.of(sniff(path))
    except BadTable as error:
        raise BadTable(f"{path}, line {line}", "is not numbers", f"give {_FORMS}, or labels above them") from error
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
