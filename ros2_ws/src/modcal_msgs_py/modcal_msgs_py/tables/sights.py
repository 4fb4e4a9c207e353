"""Columns of distances, directions and heights: which they are by their labels, and what they mean by what fits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from modcal_core.hypotheses import BEYOND_DOUBT, LENGTHS, MIN_ROWS, Sighting, SightMatch, sights_match
from modcal_core.measurements import BEARING, RANGE, RAY, TOUCH
from modcal_core.measurements.kinds import kinds
from modcal_core.robots import Chain, Mechanism
from modcal_msgs_py.tables.columns import LabelledJoints, Numbers
from modcal_msgs_py.tables.fits import Fitted, JointChoice, MappingCandidate, TableRead, choices_of
from modcal_msgs_py.tables.labels import grouped, words
from modcal_msgs_py.tables.readings import MAX_RAD, READINGS, UNITS

_VECTOR = 2e-3  # by which a direction's length may be off: exports have three digits
_WORDS = {RANGE: "distances", BEARING: "directions", TOUCH: "heights above a plane", RAY: "rays of the gripper"}
_JUDGED = 2  # rays that are judged, those with most readings: each is located again in every trial
_FRAMES = {RANGE: "anchor", BEARING: "station", TOUCH: "plane"}
_EMPTY = words("angle to sensor reading above x ux dx nx direction dir u unit vector")  # of an instrument


@dataclass(frozen=True)
class SightColumns:
    """Columns of one instrument. columns: one of a length; azimuth and the second angle, or a vector's three."""

    frame: str
    kind: str
    columns: tuple[int, ...]

    @property
    def key(self) -> str:
        """What a mapping calls its readings."""
        return "plane" if self.kind == TOUCH else self.kind

    def stated(self, numbers: Numbers, way: Mapping[str, Any]) -> dict[str, Any]:
        """What a mapping states of it. way: one of :data:`_WAYS`, by which a column is named or something is stated."""
        keys = iter(numbers.keys(self.columns))
        if len(self.columns) == 3:
            return {"frame": self.frame, "vector": list(keys)}
        return {"frame": self.frame, **{name: next(keys) if told is None else told for name, told in way.items()}}


# What columns of a kind are tried as: what is stated, None where a column is; directions by three columns are vectors
_LENGTHS = [{"unit": unit, "column": None} for unit in LENGTHS]
_WAYS: Mapping[str, Sequence[Mapping[str, Any]]] = {
    RANGE: _LENGTHS,
    TOUCH: _LENGTHS,
    RAY: _LENGTHS,
    BEARING: [
        {"unit": unit, "azimuth": None, second: None, **clockwise}
        for unit in ("deg", "rad", "gon")
        for second in ("elevation", "zenith")
        for clockwise in ({}, {"clockwise": True})
    ],
}


def joints_alone(numbers: Numbers, chain: Mechanism, joints: LabelledJoints) -> TableRead:
    """The rows in which every joint has a number, in the unit that labels or sizes tell, without any reading."""
    rows = np.flatnonzero(np.isfinite(numbers.values[:, list(joints.columns)]).all(axis=1))
    told = {numbers.labels[k].unit for k in joints.columns} - {None}
    choices = choices_of(numbers, chain, joints, rows)
    choices = [c for c in choices if {c.stated["unit"], *c.stated.get("units", {}).values()} >= told] or choices
    units = " or ".join(dict.fromkeys(c.stated["unit"] for c in choices))
    asked = f"cannot tell the unit of the joints, {units}: no label says, and no reading goes with them"
    said = "no column holds a reading: joints alone, for `modcal articulate`, `payload` and `limits`"
    return TableRead(choices[0], rows, (), (asked,) if len(choices) > 1 else (), (said,))


def sight_columns(numbers: Numbers, taken: set[int]) -> list[SightColumns]:
    """Columns that labels call distances, directions, heights or rays, where some rows have numbers that change;
    directions by three columns also by their numbers.
    """
    free = {k: numbers.labels[k] for k in numbers.usable if k not in taken}
    found = [(BEARING, columns) for columns in grouped(free, BEARING)]
    used = {k for _, columns in found for k in columns}
    for first in free:
        triple, around = tuple(range(first, first + 3)), {first - 1, first + 3}  # a quaternion's would be among these
        if set(triple) <= set(free) - used and not around & used:
            length = np.linalg.norm(numbers.whole(triple), axis=1)
            if len(length) >= MIN_ROWS and (np.abs(length - 1.0) < _VECTOR).mean() > 0.9:
                found.append((BEARING, triple))
                used |= set(triple)
    some = {k: numbers.labels[k] for k in numbers.seldom if k not in taken | used}  # a sensor sees at times only
    for kind in (RAY, RANGE, TOUCH):
        found += [(kind, columns) for columns in grouped({k: some[k] for k in some if k not in used}, kind)]
        used |= {k for _, columns in found for k in columns}
    return list(_framed(numbers, found))


def _framed(numbers: Numbers, found: Sequence[tuple[str, tuple[int, ...]]]) -> Iterator[SightColumns]:
    """Instruments by what their labels say besides; no two of a kind share a name, a range and a bearing may."""
    seen: set[tuple[str, str]] = set()
    for kind, columns in found:
        if kind == RAY:
            yield ray_of(numbers, SightColumns("", RAY, columns))
            continue
        axis = numbers.labels[columns[0]].axis(kind)
        words = (axis[1] if axis is not None else numbers.labels[columns[0]].name).split()
        stem = "_".join(w for w in words if w not in _EMPTY)
        anonymous = not stem or (kind != BEARING and (stem[0].isdigit() or len(stem) == 1))
        shared = kind == RANGE and ((stem or "station"), BEARING) in seen
        first = f"{_FRAMES[kind]}_{stem}".rstrip("_") if anonymous and not shared else stem or "station"
        names = (first, *(f"{first}_{k}" for k in range(2, len(found) + 2)))
        name = next(name for name in names if (name, kind) not in seen)
        seen.add((name, kind))
        yield SightColumns(name, kind, columns)


def ray_of(numbers: Numbers, one: SightColumns) -> SightColumns:
    """A length as that of a ray, called as its column is, so that all tables of a gripper agree."""
    return SightColumns("_".join(numbers.labels[one.columns[0]].words), RAY, one.columns)


def find_sights(
    numbers: Numbers, chain: Chain, joints: Sequence[LabelledJoints], instruments: Sequence[SightColumns]
) -> TableRead | None:
    """What columns of distances, directions and heights mean; None if no reading of any of them fits the arm."""
    known = np.isfinite(numbers.values)
    read = np.any([known[:, list(i.columns)].all(axis=1) for i in instruments], axis=0)
    rows = np.flatnonzero(read & known[:, [k for j in joints for k in j.columns]].all(axis=1))
    if len(rows) < MIN_ROWS:
        return None
    choices = [choice for one in joints for choice in choices_of(numbers, chain, one, rows)]
    found: list[Fitted] = []
    questions: list[str] = []
    for kind in dict.fromkeys(one.kind for one in instruments):
        mine = [one for one in instruments if one.kind == kind]
        ways = _compared(numbers, chain, choices, rows, mine)
        if kind == RANGE and not ways[0].explained:  # the sensors may be on the gripper
            rays = [ray_of(numbers, one) for one in mine]
            others = _compared(numbers, chain, choices, rows, rays)
            if others[0].explained:
                kind, ways = RAY, others
        columns = tuple(k for one in mine for k in one.columns)
        one, names = Fitted(_WORDS[kind], ways, rows, columns, ()), numbers.shown(*columns)
        if not one.best.explained:
            said = f"{names}: labels call them {_WORDS[kind]}, and no reading of them fits the arm; the best leaves "
            questions.append(f"{said}{one.best.missed}: they are left out")
            continue
        found.append(one)
        less = f"less than {BEYOND_DOUBT:.0f} in log-likelihood apart"
        questions += [f"cannot tell of {names}: {one.best.otherwise(w, 'or')} ({less})" for w in one.rivals[:3]]
    if not found:
        return None
    choice = found[0].best.choice
    if any(one.best.choice is not choice for one in found):
        questions.append("the readings contradict each other about the joints' columns or their unit")
    return TableRead(choice, rows, found, questions)


def _compared(
    numbers: Numbers, chain: Chain, choices: Sequence[JointChoice], rows: np.ndarray, mine: Sequence[SightColumns]
) -> list[MappingCandidate]:
    """What instruments of a kind may mean, the likeliest first."""
    kind, values = mine[0].kind, numbers.values[rows]
    units = {numbers.labels[one.columns[0]].unit for one in mine}
    read = np.isfinite(values).sum(axis=0)
    judged = sorted(mine, key=lambda one: -int(read[one.columns[0]]))[:_JUDGED] if kind == RAY else mine
    ways = list(_WAYS[kind])
    angles = [k for one in mine for k in one.columns if len(one.columns) == 2]
    if kind == BEARING:
        largest = float(np.nanmax(np.abs(values[:, angles]), initial=0.0))
        ways = [way for way in ways if way["unit"] != "rad" or largest < MAX_RAD] if angles else [{"unit": ""}]
    else:
        if kind == RAY:
            ways = [way for way in ways if {way["unit"]} == units] or ways
        lengths = values[:, [one.columns[0] for one in judged]]  # no instrument of this arm reads so far
        lengths, of_kind, reach = lengths[np.isfinite(lengths)][:, None], kinds()[kind], chain.reach()
        ways = [w for w in ways if of_kind.implausible(UNITS[w["unit"]] * lengths, reach).mean() < 0.5] or ways
    found: list[MappingCandidate] = []
    for choice, way in product(choices, ways):
        match = _judged(numbers, chain, choice, rows, judged, way)
        stated = {mine[0].key: [one.stated(numbers, way) for one in mine]}
        found.append(MappingCandidate(choice, stated, match, match.explained(chain)))
    told = [one for one in found if {one.stated[mine[0].key][0].get("unit")} == units]
    found = told if any(one.explained for one in told) else found
    return sorted(found, key=lambda one: (not one.explained, -one.fit.score))


def _judged(
    numbers: Numbers,
    chain: Chain,
    choice: JointChoice,
    rows: np.ndarray,
    instruments: Sequence[SightColumns],
    way: Mapping[str, Any],
) -> SightMatch:
    """How well instruments that are read in one way fit a choice of joints, in these rows."""
    sightings, volume = [], 0.0
    for one in instruments:
        x, there = READINGS[one.key].read(numbers.table, one.stated(numbers, way), numbers.sheet.path.name)
        sightings.append(Sighting(one.frame, one.kind, np.where(there[:, None], x, np.nan)[rows]))
        if len(one.columns) < 3:
            volume += len(one.columns) * float(np.log(UNITS[way["unit"]]))
    return sights_match(chain, choice.q[rows], sightings, volume)
