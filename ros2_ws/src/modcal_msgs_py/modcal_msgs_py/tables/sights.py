"""Columns of distances, directions and heights: which they are by their labels, and what they mean by what fits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.hypotheses import BEYOND_DOUBT, LENGTHS, MIN_ROWS, Sighting, SightMatch, sights_match
from modcal_core.measurements import BEARING, RANGE, RAY, TOUCH
from modcal_core.measurements.kinds import kinds
from modcal_core.robots import Chain, Mechanism
from modcal_msgs_py.tables.columns import LabelledJoints, Numbers
from modcal_msgs_py.tables.fits import JointChoice, choices_of, differences
from modcal_msgs_py.tables.labels import grouped, words
from modcal_msgs_py.tables.readings import UNITS, direction

_ANGLES = ("deg", "rad", "gon")
_MAX_RAD = 2.0 * np.pi * 1.05  # an angle beyond it is in degrees or gon
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


@dataclass(frozen=True)
class Way:
    """One reading of the columns of a kind. unit: of lengths or angles, "" of vectors. zenith: the second angle is from
    above. clockwise: the azimuth grows so.
    """

    choice: int
    unit: str
    zenith: bool = False
    clockwise: bool = False

    def entry(self, numbers: Numbers, one: SightColumns) -> dict[str, Any]:
        """What a mapping states of an instrument that is read so."""
        keys = numbers.keys(one.columns)
        stated: dict[str, Any] = {"frame": one.frame}
        if one.kind != BEARING:
            return {**stated, "unit": self.unit, "column": keys[0]}
        if len(keys) == 3:
            return {**stated, "vector": keys}
        second = {"zenith" if self.zenith else "elevation": keys[1]}
        return {
            **stated,
            "unit": self.unit,
            "azimuth": keys[0],
            **second,
            **({"clockwise": True} if self.clockwise else {}),
        }


@dataclass(frozen=True)
class Sighted:
    """Readings that are no positions, with what they mean: for each kind its ways, best first."""

    choices: tuple[JointChoice, ...]
    rows: np.ndarray
    found: dict[str, list[tuple[Way, SightMatch]]]
    instruments: tuple[SightColumns, ...]
    questions: tuple[str, ...] = field(default=())
    zeros: tuple[int, ...] = ()

    @property
    def choice(self) -> JointChoice:
        """What the joints' columns are taken for."""
        return self.choices[next(iter(self.found.values()))[0][0].choice]

    @property
    def columns(self) -> tuple[int, ...]:
        """Columns of the readings."""
        return tuple(k for i in self.instruments for k in i.columns)

    def entry(self, numbers: Numbers) -> dict[str, Any]:
        """The readings as a mapping states them."""
        out: dict[str, Any] = {}
        for one in self.instruments:
            stated = self.found[one.kind][0][0].entry(numbers, one)
            out.setdefault("plane" if one.kind == TOUCH else one.kind, []).append(stated)
        return {key: stated[0] if len(stated) == 1 else stated for key, stated in out.items()}

    def proved(self, numbers: Numbers, chain: Mechanism) -> list[str]:
        """What the data shows, with what came second."""
        out = []
        for kind, ((way, match), *rest) in self.found.items():
            missed = f"{1e3 * match.typical:.3g} mm (median)"
            out.append(f"{_WORDS[kind]} as stated: the nominal arm misses {len(self.rows)} rows by {missed}")
            first = next(one for one in self.instruments if one.kind == kind)
            for other, worse in rest[:1]:
                instead = _otherwise(numbers, first, self.choices, (way, other), "in place of")
                out.append(f"second best, worse by {match.score - worse.score:.0f} in log-likelihood: {instead}")
        return out


def _otherwise(
    numbers: Numbers, one: SightColumns, choices: Sequence[JointChoice], ways: tuple[Way, Way], word: str
) -> str:
    """What a mapping of another way would state in place of the first one's, of an instrument and the joints."""
    best, other = ({**way.entry(numbers, one), "joints": {"unit": choices[way.choice].angle}} for way in ways)
    return "; ".join(differences(best, other, word))


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
) -> Sighted | None:
    """What columns of distances, directions and heights mean; None if no reading of any of them fits the arm."""
    known = np.isfinite(numbers.values)
    read = np.any([known[:, list(i.columns)].all(axis=1) for i in instruments], axis=0)
    rows = np.flatnonzero(read & known[:, [k for j in joints for k in j.columns]].all(axis=1))
    if len(rows) < MIN_ROWS:
        return None
    values = numbers.values[rows]
    choices = [choice for one in joints for choice in choices_of(chain, one, values)]
    postures = [choice.postures(chain, values) for choice in choices]
    found: dict[str, list[tuple[Way, SightMatch]]] = {}
    questions: list[str] = []
    for kind in dict.fromkeys(one.kind for one in instruments):
        mine = [one for one in instruments if one.kind == kind]
        ways = _compared(numbers, chain, postures, values, mine)
        if kind == RANGE and not ways[0][1].explained(chain):  # the sensors may be on the gripper, or stand on a plane
            rays = [ray_of(numbers, one) for one in mine]
            others = _compared(numbers, chain, postures, values, rays)
            if others[0][1].explained(chain):
                instruments = [one for one in instruments if one.kind != RANGE] + rays
                kind, mine, ways = RAY, rays, others
        names = numbers.shown(*(k for one in mine for k in one.columns))
        if not ways[0][1].explained(chain):
            said = f"{names}: labels call them {_WORDS[kind]}, and no reading of them fits the arm; the best leaves "
            questions.append(f"{said}{1e3 * ways[0][1].typical:.3g} mm: they are left out")
            continue
        found[kind] = ways
        alike = [way for way, match in ways[1:] if not ways[0][1].beyond(match)]
        either = (_otherwise(numbers, mine[0], choices, (ways[0][0], other), "or") for other in alike[:3])
        less = f"less than {BEYOND_DOUBT:.0f} in log-likelihood apart"
        questions += [f"cannot tell of {names}: {said} ({less})" for said in either]
    if not found:
        return None
    if len({ways[0][0].choice for ways in found.values()}) > 1:
        questions.append("the readings contradict each other about the joints' columns or their unit")
    kept = tuple(one for one in instruments if one.kind in found)
    return Sighted(tuple(choices), rows, found, kept, tuple(questions))


def _compared(
    numbers: Numbers, chain: Chain, postures: Sequence[Array], values: Array, mine: Sequence[SightColumns]
) -> list[tuple[Way, SightMatch]]:
    """What instruments of a kind may mean, the likeliest first."""
    units = {numbers.labels[one.columns[0]].unit for one in mine}
    if mine[0].kind == RAY:
        mine = sorted(mine, key=lambda one: -int(np.isfinite(values[:, one.columns[0]]).sum()))[:_JUDGED]
    some = [(q, way) for c, q in enumerate(postures) for way in _ways(c, values, mine)]
    if mine[0].kind == RAY:
        some = [(q, way) for q, way in some if {way.unit} == units] or some
    if mine[0].kind != BEARING:  # no instrument of this arm reads so far
        lengths = values[:, [one.columns[0] for one in mine]]
        lengths, kind, reach = lengths[np.isfinite(lengths)][:, None], kinds()[mine[0].kind], chain.reach()
        some = [(q, way) for q, way in some if kind.implausible(UNITS[way.unit] * lengths, reach).mean() < 0.5] or some
    ways = [(way, _judged(chain, q, values, mine, way)) for q, way in some]
    told = [pair for pair in ways if {pair[0].unit} == units]
    ways = told if any(match.explained(chain) for _, match in told) else ways
    return sorted(ways, key=lambda pair: (not pair[1].explained(chain), -pair[1].score))


def _ways(choice: int, values: Array, instruments: Sequence[SightColumns]) -> Iterator[Way]:
    angles = [one for one in instruments if len(one.columns) == 2]
    if not angles:
        yield from (Way(choice, unit) for unit in (LENGTHS if instruments[0].kind != BEARING else [""]))
        return
    largest = max(float(np.nanmax(np.abs(values[:, list(one.columns)]))) for one in angles)
    some = [unit for unit in _ANGLES if unit != "rad" or largest < _MAX_RAD]
    yield from (Way(choice, *read) for read in product(some, (False, True), (False, True)))


def _judged(chain: Chain, q: Array, values: Array, instruments: Sequence[SightColumns], way: Way) -> SightMatch:
    sightings, volume = [], 0.0
    for one in instruments:
        x = values[:, list(one.columns)]
        if len(one.columns) == 3:
            x = x / np.linalg.norm(x, axis=1, keepdims=True)
        else:
            x = UNITS[way.unit] * x
            volume += len(one.columns) * float(np.log(UNITS[way.unit]))
            x = direction(x, way.zenith, way.clockwise) if one.kind == BEARING else x
        sightings.append(Sighting(one.frame, one.kind, x))
    return sights_match(chain, q, sightings, volume)
