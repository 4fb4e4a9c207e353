"""Which columns may be joints, positions and orientations: by their labels, and by their numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np

from modcal_core.geometry import Array, se3
from modcal_msgs_py.tables.labels import COMMANDED, EFFORT, MEASURED, OTHER, VELOCITY, Label, families, grouped
from modcal_msgs_py.tables.readings import READINGS, orientations, rigid_poses
from modcal_msgs_py.tables.sheet import Sheet, number
from modcal_msgs_py.tables.table import Table

_MIN_FILLED = 0.3  # share of the rows in which a column must have a number
_NINES = re.compile(r"-?9{3,}([.,][09]*)?")  # what exports write for "no reading"
_FAR = 5.0  # times the largest other number of a column, that such a number is away
_MAX_BODIES = 48  # places of columns that are tried without labels
_LARGEST = 400.0  # of an angle of a joint


@dataclass(frozen=True)
class Numbers:
    """The columns of a file as numbers. values: (N, width), NaN where there is none. labels: of each column.

    odd: texts in a column that stand where a number is missing, besides those that are known to.
    """

    sheet: Sheet
    values: Array
    labels: dict[int, Label]
    odd: dict[int, set[str]] = field(default_factory=dict)

    @classmethod
    def of(cls, sheet: Sheet) -> Numbers:
        """All columns of a file; 9999 and the like are no number where they stand far from all others."""
        values = np.full((len(sheet.rows), sheet.width), np.nan)
        odd: dict[int, set[str]] = {}
        for i, row in enumerate(sheet.rows):
            for k, cell in enumerate(row):
                found = number(cell, sheet.form.decimal)
                values[i, k] = np.nan if found is None else found
                if found is None or _NINES.fullmatch(cell.strip()):
                    odd.setdefault(k, set()).add(cell.strip())
        for k, texts in odd.items():
            for text in tuple(texts):
                value = number(text, sheet.form.decimal)
                if value is None:
                    continue
                rest = values[:, k][np.isfinite(values[:, k]) & (values[:, k] != value)]
                if len(rest) and abs(value) > _FAR * float(np.abs(rest).max()):
                    values[values[:, k] == value, k] = np.nan
                else:
                    texts.discard(text)
        pad = [""] * sheet.width
        texts_of = zip([*sheet.full, *pad], [*sheet.units, *pad], range(sheet.width), strict=False)
        return cls(sheet, values, {k: Label.of(label, unit) for label, unit, k in texts_of}, odd)

    @cached_property
    def table(self) -> Table:
        """The same as a mapping reads it, whose columns go by number or label."""
        keys = {key: k for k in range(self.sheet.width) for key in (k, self.key(k))}
        return Table(self.sheet, _read={key: self.values[:, k] for key, k in keys.items()})

    @cached_property
    def usable(self) -> list[int]:
        """Columns that hold numbers that change."""
        return [k for k in self.filled if k in self.seldom]

    @cached_property
    def seldom(self) -> list[int]:
        """Columns with some numbers, that change."""
        several = np.flatnonzero(np.isfinite(self.values).sum(axis=0) >= 3).tolist()
        return [k for k in several if np.nanmax(self.values[:, k]) - np.nanmin(self.values[:, k]) > 1e-9]

    @cached_property
    def filled(self) -> list[int]:
        """Columns that hold numbers; constants may be part of a pose, too: an angle that never changed."""
        there = np.isfinite(self.values).sum(axis=0)
        return [k for k, count in enumerate(there) if count >= max(3, _MIN_FILLED * len(self.values))]

    def free(self, taken: set[int]) -> dict[int, Label]:
        """Labels of the filled columns that are not taken."""
        return {k: self.labels[k] for k in self.filled if k not in taken}

    def whole(self, columns: Sequence[int]) -> Array:
        """Rows of these columns that have no gap, (m, k)."""
        values = self.values[:, list(columns)]
        return values[np.isfinite(values).all(axis=1)]

    def key(self, column: int) -> str | int:
        """How a mapping names a column: by its label where it is the only one of that name, else by its number."""
        named = self.sheet.header
        label = named[column] if column < len(named) else ""
        return label if label and named.count(label) == 1 else column

    def keys(self, columns: Sequence[int]) -> list[str | int]:
        """The same of several."""
        return [self.key(k) for k in columns]

    def shown(self, *columns: int) -> str:
        """Names of columns for a person."""
        return ", ".join(self.labels[k].text or f"column {k}" for k in columns)


@dataclass(frozen=True)
class Body:
    """Columns that may be a pose, or a point where turned is None. computed: its labels sound like a controller's.

    points: names and columns of the targets of one body, whose pose they are together; position is the first then.
    away: columns of a deviation that is taken from the position; none of most.
    """

    position: tuple[int, ...]
    turned: tuple[int, ...] | None
    named: bool
    computed: bool = False
    points: tuple[tuple[str, tuple[int, ...]], ...] = ()
    away: tuple[int, ...] = ()

    @property
    def posed(self) -> bool:
        """Whether the body has an orientation."""
        return self.turned is not None or bool(self.points)

    @property
    def columns(self) -> tuple[int, ...]:
        """All columns of the readings."""
        of_points = tuple(k for _, triple in self.points for k in triple)
        return of_points or (*self.position, *(self.turned or ()), *self.away)

    def stated(self, numbers: Numbers) -> dict[str, Any]:
        """Its positions as a mapping states them, without a unit."""
        if self.points:
            return {"points": {name: numbers.keys(triple) for name, triple in self.points}}
        away = {"minus": numbers.keys(self.away)} if self.away else {}
        return {"position": numbers.keys(self.position), **away}

    def read(self, numbers: Numbers, rows: np.ndarray) -> tuple[Array, Array | None]:
        """Positions (m, 3) in the table's unit, and columns of orientations (m, k), of these rows as a mapping reads
        them; of targets the pose of their body.
        """
        kind = READINGS["targets" if self.points else "point"]
        values = kind.read(numbers.table, {"unit": "m", **self.stated(numbers)}, numbers.sheet.path.name)[0][rows]
        if self.points:
            return values[:, :3], se3.from_pose(values)[:, :3, :3].reshape(-1, 9)
        return values, None if self.turned is None else numbers.values[np.ix_(rows, np.array(self.turned))]

    @property
    def zeros(self) -> tuple[int, ...]:
        """Columns that are all zero where an instrument read nothing: no orientation is written so but as angles."""
        return self.turned if self.turned is not None and len(self.turned) > 3 else self.columns

    def shares(self, columns: set[int]) -> bool:
        """Whether it has any of these columns."""
        return bool(columns & {*self.position, *(self.turned or ())})


@dataclass(frozen=True)
class LabelledJoints:
    """A choice of the joints' columns, in the chain's order. how: what it was chosen by."""

    columns: tuple[int, ...]
    how: str
    role: str = MEASURED


def bodies(numbers: Numbers, taken: set[int], time: set[int]) -> list[Body]:
    """Places of columns that may hold the readings, the likeliest first."""
    labelled = numbers.free(taken | time)
    turning = {k: label for k, label in labelled.items() if label.role != OTHER}
    read = {k: label for k, label in labelled.items() if label.role in (MEASURED, COMMANDED)}
    turns = [*grouped(labelled, "matrix"), *grouped(labelled, "quaternion"), *grouped(turning, "angles")]
    turns += [t for t in _windows(numbers, labelled) if set(t) not in [set(known) for known in turns]]
    turns = [t for t in turns if is_turned(numbers.whole(t))]
    out: list[Body] = []
    for p in grouped(read, "position"):
        computed = any(numbers.labels[k].computed for k in p)
        own = sorted((t for t in turns if not set(t) & set(p)), key=lambda t, p=p: (_apart(numbers, p, t), -len(t)))  # type: ignore[misc]
        if not own:  # columns beside it, whatever they are called
            beside = [tuple(range(max(p) + 1, max(p) + 4)), tuple(range(min(p) - 3, min(p)))]
            plain = {k for k in turning if k in numbers.usable and not numbers.labels[k].of_instrument}
            own = [t for t in beside if set(t) <= plain and is_turned(numbers.whole(t))]
        out += [Body(p, t, True, computed) for t in (*own[:4], None)]
    out += [Body(t[:3], t[3:], True) for t in grouped(labelled, "homogeneous") if is_turned(numbers.whole(t[3:]))]
    out.sort(key=lambda body: (body.computed, body.turned is None))
    free = [k for k in numbers.usable if k not in taken | time]
    return [*out, *_unnamed(numbers, free, turns, {b.position for b in out})][: len(out) + _MAX_BODIES]


def is_turned(values: Array) -> bool:
    """Whether columns (N, k) can be read as orientations."""
    return len(values) >= 3 and bool(orientations(values))


def _apart(numbers: Numbers, position: Sequence[int], turned: Sequence[int]) -> int:
    """How far an orientation's columns are from a position's, 0 where their labels name the same body."""
    stem = set(numbers.labels[position[0]].words) - {"x", "y", "z", "t", "position", "pos"}
    gap = min(abs(a - b) for a in position for b in turned)
    return gap if not stem or stem & set(numbers.labels[turned[0]].words) else 1000 + gap


def _unnamed(
    numbers: Numbers, free: Sequence[int], turns: Sequence[tuple[int, ...]], known: set[tuple[int, ...]]
) -> Iterator[Body]:
    """Neighbouring columns, three of a position and an orientation before or behind them; homogeneous matrices."""
    width = numbers.values.shape[1]
    for first in range(width - 11):  # row by row with the place as the fourth column
        p, rows = tuple(range(first + 3, first + 12, 4)), range(first, first + 12)
        if is_turned(numbers.whole(turned := tuple(k for k in rows if k not in p))):
            yield Body(p, turned, False)
    elements = {k for t in turns if len(t) > 3 for k in t}  # these are linear in the arm's turns, too, and no place
    for p in zip(free, free[1:], free[2:], strict=False):
        if p[2] != p[0] + 2 or p in known or elements & set(p):
            continue
        near = [tuple(range(p[2] + 1, p[2] + 4)), tuple(range(p[0] - 3, p[0]))]
        near = [t for t in near if set(t) <= set(free) and is_turned(numbers.whole(t))]
        beside = [t for t in turns if min(t) == p[2] + 1 or max(t) == p[0] - 1]
        yield from (Body(p, t, False) for t in dict.fromkeys((*beside, *near)))
        if not turns:
            yield Body(p, None, False)


def _windows(numbers: Numbers, among: dict[int, Label]) -> list[tuple[int, ...]]:
    """Neighbouring columns that are quaternions or matrices by their numbers."""
    windows = [tuple(range(k, k + n)) for n in (9, 4) for k in range(numbers.values.shape[1] - n + 1)]
    return [w for w in windows if set(w) <= set(among) and is_turned(numbers.whole(w))]


def orthonormal(numbers: Numbers) -> set[int]:
    """Columns that are orientations by their numbers alone: quaternions and matrices, with labels or without."""
    labels = numbers.free(set())
    groups = [*grouped(labels, "matrix"), *grouped(labels, "quaternion")]
    found = {k for t in groups if is_turned(numbers.whole(t)) for k in t}
    for window in _windows(numbers, labels):  # a matrix's row with noise beside it is no quaternion
        if not found & set(window):
            found |= set(window)
    return found


def joint_columns(numbers: Numbers, names: Sequence[str]) -> list[LabelledJoints]:
    """Choices of the joints' columns by their labels, measured ones first; commanded, velocities and efforts too. Those
    of an instrument are none.
    """
    out = _by_name(numbers, names)
    for columns, stem in families(numbers.labels, len(names)):
        if columns not in [choice.columns for choice in out]:
            first, last = (numbers.labels[columns[k]].text for k in (0, -1))
            out.append(LabelledJoints(columns, f"numbered labels {first} … {last}", Label.of(stem).role))
    out = [choice for choice in out if not all(numbers.labels[k].of_instrument for k in choice.columns)]
    return sorted(out, key=lambda choice: choice.role != MEASURED)


def _by_name(numbers: Numbers, names: Sequence[str]) -> list[LabelledJoints]:
    wanted = [Label.of(name).words for name in names]
    common = set(wanted[0]).intersection(*map(set, wanted)) if len(wanted) > 1 else set()
    out = []
    for role in (MEASURED, COMMANDED, VELOCITY, EFFORT):
        labels = {k: label for k, label in numbers.labels.items() if label.role == role}
        chosen: list[int] = []
        for own in wanted:
            core = {w for w in own if w not in common and w != "joint"}
            if not common and all(w.isdigit() for w in core):
                break
            wordy = any(len(w) > 2 and not w.isdigit() for w in core)
            fits = [k for k, label in labels.items() if core and k not in chosen and core <= set(label.words)]
            fits = [k for k in fits if wordy or f" {' '.join(own)} " in f" {labels[k].name} "]
            if not fits:
                break
            chosen.append(min(fits, key=lambda k: len(labels[k].words)))
        if len(chosen) == len(names):
            out.append(LabelledJoints(tuple(chosen), "the joints' names", role))
    return out


def pool(numbers: Numbers, taken: set[int]) -> list[int]:
    """Columns that could be joints by their numbers: angles that change, and are not taken."""
    some = [k for k in numbers.usable if k not in taken and numbers.labels[k].role == MEASURED]
    angles = [k for k in some if float(np.nanmax(np.abs(numbers.values[:, k]))) <= _LARGEST]
    return [k for k in angles if not is_counter(numbers.values[:, k])]


def is_counter(column: Array) -> bool:
    """Whether numbers only rise, or only fall."""
    steps = np.diff(column[np.isfinite(column)])
    return bool(len(steps)) and bool((steps >= 0.0).all() or (steps <= 0.0).all())


# --- Several targets on one tool, and a goal with the deviation from it

_MOVES = 0.05  # of what the liveliest point moves; less is a target that stands
_RIGID = 2e-3  # of what the points move, by which their distance may scatter
_APART = 20.0  # times that scatter, that points and the line through them must be apart
_MIN = 3  # targets that make a pose
_MAD = 1.4826  # standard deviation of a Gaussian whose median absolute deviation is one


def rigid_bodies(numbers: Numbers, places: Sequence[Body]) -> list[Body]:
    """Bodies of three targets or more among labelled points, the largest first; none where no three are rigid."""
    points = {b.position: numbers.values[:, list(b.position)] for b in places if b.named}
    if len(points) < _MIN:
        return []
    moves = {triple: _motion(p) for triple, p in points.items()}
    most = max(moves.values())
    alive = [triple for triple in points if moves[triple] > _MOVES * most > 0.0]
    scatter = {frozenset(pair): _scatter(*(points[t] for t in pair)) for pair in combinations(alive, 2)}
    rigid = {pair for pair, (distance, off) in scatter.items() if off < _RIGID * most and distance > _APART * off}
    found: list[Body] = []
    for i, first in enumerate(alive):
        group = [first]
        for other in alive[i + 1 :]:
            if all(frozenset((known, other)) in rigid for known in group):
                group.append(other)
        if len(group) < _MIN or any(set(group) <= {t for _, t in body.points} for body in found):
            continue
        rows = np.isfinite(np.concatenate([points[t] for t in group], axis=1)).all(axis=1)
        if rows.sum() < _MIN:
            continue
        shape = rigid_poses(np.stack([points[t][rows] for t in group], axis=1))[1]
        if np.linalg.svd(shape, compute_uv=False)[1] < _APART * max(
            scatter[frozenset(pair)][1] for pair in combinations(group, 2)
        ):
            continue  # on a line: turns about it do not show
        found.append(Body(first, None, True, points=tuple(zip(_names(numbers, group), group, strict=True))))
    return sorted(found, key=lambda body: -len(body.points))


def _motion(p: Array) -> float:
    p = p[np.isfinite(p).all(axis=1)]
    return float(np.median(np.linalg.norm(p - np.median(p, axis=0), axis=1))) if len(p) else 0.0


def _scatter(a: Array, b: Array) -> tuple[float, float]:
    """(distance, its scatter) of two points, medians."""
    d = np.linalg.norm(a - b, axis=1)
    d = d[np.isfinite(d)]
    if len(d) < _MIN:
        return 0.0, np.inf
    middle = float(np.median(d))
    return middle, _MAD * float(np.median(np.abs(d - middle)))


def _names(numbers: Numbers, group: Sequence[tuple[int, ...]]) -> list[str]:
    out: list[str] = []
    for i, triple in enumerate(group):
        axis = numbers.labels[triple[0]].axis("position")
        name = ("_".join(axis[1].split()) if axis is not None else "") or f"target_{i + 1}"
        out.append(name if name not in out else f"{name}_{i + 1}")
    return out


def deviation_columns(numbers: Numbers, taken: set[int]) -> tuple[int, ...]:
    """Columns of a deviation along x, y and z by their labels, some of it negative; none where there is no such three.

    A table in which they are the only labelled positions has no goal, and so no deviation from it.
    """
    labels = {k: label for k, label in numbers.labels.items() if k not in taken}
    triples = [t for t in grouped(labels, "difference") if np.nanmin(numbers.values[:, t], initial=0.0) < 0.0]
    others = {k: label for k, label in labels.items() if label.axis("difference") is None}
    return triples[0] if len(triples) == 1 and grouped(others, "position") else ()
