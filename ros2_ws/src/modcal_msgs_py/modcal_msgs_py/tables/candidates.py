"""Which columns may be joints, positions and orientations: by their labels, and by their numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from modcal_core.geometry import Array
from modcal_core.hypotheses import turnings
from modcal_msgs_py.tables import labels as words
from modcal_msgs_py.tables.labels import COMMANDED, EFFORT, MEASURED, OTHER, VELOCITY, Label
from modcal_msgs_py.tables.sniff import Sniffed
from modcal_msgs_py.tables.table import number

_MIN_FILLED = 0.3  # share of the rows in which a column must have a number
_NUMBER = re.compile(r"\d{1,4}(?=\D*$)")  # the last one in a label
_NINES = re.compile(r"-?9{3,}([.,][09]*)?")  # what exports write for "no reading"
_FAR = 5.0  # times the largest other number of a column, that such a number is away
_MAX_BODIES = 48  # places of columns that are tried without labels


@dataclass(frozen=True)
class Numbers:
    """The columns of a file as numbers. values: (N, width), NaN where there is none. labels: of each column.

    odd: texts in a column that stand where a number is missing, besides those that are known to.
    """

    sniffed: Sniffed
    values: Array
    labels: dict[int, Label]
    odd: dict[int, set[str]] = field(default_factory=dict)

    @classmethod
    def of(cls, sniffed: Sniffed) -> Numbers:
        """All columns of a file; 9999 and the like are no number where they stand far from all others."""
        values = np.full((len(sniffed.rows), sniffed.width), np.nan)
        odd: dict[int, set[str]] = {}
        for i, row in enumerate(sniffed.rows):
            for k, cell in enumerate(row):
                found = number(cell, sniffed.form.decimal)
                values[i, k] = np.nan if found is None else found
                if found is None or _NINES.fullmatch(cell.strip()):
                    odd.setdefault(k, set()).add(cell.strip())
        for k, texts in odd.items():
            for text in tuple(texts):
                value = number(text, sniffed.form.decimal)
                if value is None:
                    continue
                rest = values[:, k][np.isfinite(values[:, k]) & (values[:, k] != value)]
                if len(rest) and abs(value) > _FAR * float(np.abs(rest).max()):
                    values[values[:, k] == value, k] = np.nan
                else:
                    texts.discard(text)
        full = [*sniffed.full, *[""] * (sniffed.width - len(sniffed.full))]
        units = [*sniffed.units, *[""] * (sniffed.width - len(sniffed.units))]
        return cls(sniffed, values, {k: Label.of(full[k], units[k]) for k in range(sniffed.width)}, odd)

    def usable(self) -> list[int]:
        """Columns that hold numbers that change."""
        out = []
        for k in range(self.values.shape[1]):
            column = self.values[:, k]
            column = column[np.isfinite(column)]
            if len(column) >= max(3, _MIN_FILLED * len(self.values)) and float(np.ptp(column)) > 1e-9:
                out.append(k)
        return out

    def key(self, column: int) -> str | int:
        """How a mapping names a column: by its label where it is the only one of that name, else by its number."""
        named = self.sniffed.labels
        label = named[column] if column < len(named) else ""
        return label if label and named.count(label) == 1 else column

    def shown(self, column: int) -> str:
        """A column's name for a person."""
        return self.labels[column].text or f"column {column}"


@dataclass(frozen=True)
class Body:
    """Columns that may be a pose, or a point where turned is None. computed: its labels sound like a controller's.

    points: names and columns of the targets of one body, whose pose they are together; position is the first then.
    away: columns of a deviation that is added to the position times sign, 1 or -1; none of most.
    """

    position: tuple[int, int, int]
    turned: tuple[int, ...] | None
    named: bool
    computed: bool = False
    points: tuple[tuple[str, tuple[int, int, int]], ...] = ()
    away: tuple[int, ...] = ()
    sign: float = 1.0

    @property
    def posed(self) -> bool:
        """Whether the body has an orientation."""
        return self.turned is not None or bool(self.points)

    @property
    def columns(self) -> tuple[int, ...]:
        """All columns of the readings."""
        of_points = tuple(k for _, triple in self.points for k in triple)
        return of_points or (*self.position, *(self.turned or ()), *self.away)

    @property
    def zeros(self) -> tuple[int, ...]:
        """Columns that are all zero where an instrument read nothing: no orientation is written so but as angles."""
        return self.turned if self.turned is not None and len(self.turned) > 3 else self.columns


@dataclass(frozen=True)
class JointColumns:
    """A choice of the joints' columns, in the chain's order. how: what it was chosen by."""

    columns: tuple[int, ...]
    how: str
    role: str = MEASURED


def bodies(numbers: Numbers, joints: set[int], time: set[int]) -> list[Body]:
    """Places of columns that may hold the readings, the likeliest first."""
    free = [k for k in numbers.usable() if k not in time]
    # constants may be part of a pose, too: a matrix's last row, an angle that never changed
    filled = [k for k in range(numbers.values.shape[1]) if np.isfinite(numbers.values[:, k]).mean() >= _MIN_FILLED]
    labelled = {k: numbers.labels[k] for k in filled if k not in time and k not in joints}
    turning = {k: label for k, label in labelled.items() if label.role != OTHER}
    positions: dict[str, dict[str, int]] = {}
    for k, label in labelled.items():
        if label.axis is not None and label.role in (MEASURED, COMMANDED):
            positions.setdefault(label.axis[1], {}).setdefault(label.axis[0], k)
    named = [(f["x"], f["y"], f["z"]) for f in positions.values() if len(f) == 3]
    turns: list[tuple[int, ...]] = [
        *words.matrices(labelled), *words.quaternions(labelled), *words.angle_triples(turning)
    ]  # fmt: skip
    turns += [
        t
        for t in _windows(numbers, [k for k in filled if k not in joints and k not in time])
        if set(t) not in map(set, turns)
    ]
    turns = [t for t in turns if _is_turned(numbers, t)]
    out: list[Body] = []
    for p in named:
        computed = any(numbers.labels[k].computed for k in p)
        own = [t for t in turns if not set(t) & set(p)]
        own.sort(key=lambda t, p=p: (_apart(numbers, p, t), -len(t)))  # type: ignore[misc]
        if not own:  # columns beside it, whatever they are called
            beside = [tuple(range(max(p) + 1, max(p) + 4)), tuple(range(min(p) - 3, min(p)))]
            own = [t for t in beside if set(t) <= set(free) & set(turning) and _is_turned(numbers, t)]
        out += [Body(p, t, True, computed) for t in own[:4]]
        out.append(Body(p, None, True, computed))
    out += [Body(p, t, True) for p, t in words.homogeneous(labelled) if _is_turned(numbers, t)]
    out.sort(key=lambda body: (body.computed, body.turned is None))
    return out + _unnamed(numbers, [k for k in free if k not in joints], turns, {b.position for b in out})


def _apart(numbers: Numbers, position: Sequence[int], turned: Sequence[int]) -> int:
    """How far an orientation's columns are from a position's, 0 where their labels name the same body."""
    stem = set(numbers.labels[position[0]].words) - {"x", "y", "z", "t", "position", "pos"}
    other = set(numbers.labels[turned[0]].words)
    gap = min(abs(a - b) for a in position for b in turned)
    return gap if not stem or stem & other else 1000 + gap


def _unnamed(
    numbers: Numbers, free: list[int], turns: list[tuple[int, ...]], known: set[tuple[int, int, int]]
) -> list[Body]:
    """Neighbouring columns, three of a position and an orientation before or behind them; homogeneous matrices."""
    out = []
    for first in range(numbers.values.shape[1] - 11):
        for step in (4, 3):
            rows = [range(first + step * r, first + step * r + 3) for r in range(3)]
            if step == 4:  # row by row with the place as the fourth column
                turned, p = tuple(k for row in rows for k in row), tuple(first + 4 * r + 3 for r in range(3))
                if p[2] < numbers.values.shape[1] and _is_turned(numbers, turned):
                    out.append(Body((p[0], p[1], p[2]), turned, False))
    runs = [(a, b, c) for a, b, c in zip(free, free[1:], free[2:], strict=False) if c == a + 2]
    elements = {k for t in turns if len(t) > 3 for k in t}  # these are linear in the arm's turns, too, and no place
    runs = [p for p in runs if p not in known and not elements & set(p)]
    for p in runs:
        beside = [t for t in turns if min(t) == max(p) + 1 or max(t) == min(p) - 1]
        after = (p[2] + 1, p[2] + 2, p[2] + 3)
        before = (p[0] - 3, p[0] - 2, p[0] - 1)
        beside += [t for t in (after, before) if set(t) <= set(free) and t not in beside]
        out += [Body(p, t, False) for t in beside if _is_turned(numbers, t)]
    if not turns:
        out += [Body(p, None, False) for p in runs]
    return out[:_MAX_BODIES]


def _windows(numbers: Numbers, filled: list[int]) -> list[tuple[int, ...]]:
    """Neighbouring columns that are quaternions or matrices by their numbers."""
    out = []
    for count in (9, 4):
        for first in range(numbers.values.shape[1] - count + 1):
            window = tuple(range(first, first + count))
            if set(window) <= set(filled) and _is_turned(numbers, window):
                out.append(window)
    return out


def orthonormal(numbers: Numbers) -> set[int]:
    """Columns that are orientations by their numbers alone: quaternions and matrices, with labels or without."""
    filled = {k: label for k, label in numbers.labels.items() if np.isfinite(numbers.values[:, k]).any()}
    labelled = [*words.matrices(filled), *words.quaternions(filled)]
    found = {k for t in labelled if _is_turned(numbers, t) for k in t}
    for window in _windows(numbers, list(filled)):  # a matrix's row with noise beside it is no quaternion
        if not found & set(window):
            found |= set(window)
    return found


def _is_turned(numbers: Numbers, columns: tuple[int, ...]) -> bool:
    values = numbers.values[:, list(columns)]
    values = values[np.isfinite(values).all(axis=1)]
    return len(values) >= 3 and next(iter(turnings(values)), None) is not None


def joints(numbers: Numbers, names: Sequence[str]) -> list[JointColumns]:
    """Choices of the joints' columns by their labels, measured ones first; commanded, velocities and efforts too."""
    out = _by_name(numbers, names)
    families: dict[str, dict[int, int]] = {}
    for k, label in numbers.labels.items():
        if (number := _NUMBER.search(label.text)) is not None:
            stem = f"{label.text[: number.start()]}#{label.text[number.end() :]}"
            families.setdefault(stem, {}).setdefault(int(number[0]), k)
    known = {choice.columns for choice in out}
    for stem, found in families.items():
        for first in (1, 0):
            columns = tuple(found[n] for n in range(first, first + len(names)) if n in found)
            if len(columns) == len(names) and columns not in known:
                shown = stem.replace("#", f"{first}…{first + len(names) - 1}")
                out.append(JointColumns(columns, f"numbered labels {shown}", Label.of(stem).role))
                break
    return sorted(out, key=lambda choice: choice.role != MEASURED)


def _by_name(numbers: Numbers, names: Sequence[str]) -> list[JointColumns]:
    wanted = [Label.of(name).words for name in names]
    common = set(wanted[0]).intersection(*map(set, wanted)) if len(wanted) > 1 else set()
    out = []
    for role in (MEASURED, COMMANDED, VELOCITY, EFFORT):
        chosen: list[int] = []
        for own in wanted:
            core = [w for w in own if w not in common and w != "joint"]
            if not [w for w in core if not w.isdigit()] and not common:
                break
            fits = [
                k
                for k, label in numbers.labels.items()
                if label.role == role
                and core
                and set(core) <= set(label.words)
                and (_exact(own, label) or _wordy(core))
            ]
            fits.sort(key=lambda k: len(numbers.labels[k].words))
            fits = [k for k in fits if k not in chosen]
            if not fits:
                break
            chosen.append(fits[0])
        if len(chosen) == len(names):
            out.append(JointColumns(tuple(chosen), "the joints' names", role))
    return out


def _exact(own: tuple[str, ...], label: Label) -> bool:
    return any(label.words[i : i + len(own)] == own for i in range(len(label.words) - len(own) + 1))


def _wordy(core: list[str]) -> bool:
    """Whether what tells a joint from the others is a word, not a number alone."""
    return any(len(w) > 2 and not w.isdigit() for w in core)


def pool(numbers: Numbers, taken: set[int]) -> list[int]:
    """Columns that could be joints by their numbers: angles that change, and are not taken."""
    out = []
    for k in numbers.usable():
        column = numbers.values[:, k]
        if k in taken or numbers.labels[k].role != MEASURED or float(np.nanmax(np.abs(column))) > 400.0:
            continue
        if is_counter(column):
            continue
        out.append(k)
    return out


def is_counter(column: Array) -> bool:
    """Whether numbers only rise, or only fall."""
    steps = np.diff(column[np.isfinite(column)])
    return bool(len(steps)) and bool((steps >= 0.0).all() or (steps <= 0.0).all())
