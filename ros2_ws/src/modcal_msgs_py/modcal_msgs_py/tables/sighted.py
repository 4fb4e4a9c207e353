"""Columns of distances, directions and heights: which they are by their labels, and what they mean by what fits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.hypotheses import BEYOND_DOUBT, LENGTHS, MIN_ROWS, Sighting, SightMatch, sights_match
from modcal_core.measurements import BEARING, RANGE, TOUCH
from modcal_core.robots import Chain
from modcal_msgs_py.tables.candidates import JointColumns, Numbers
from modcal_msgs_py.tables.fitted import ColumnChoice, scales, units
from modcal_msgs_py.tables.labels import Label
from modcal_msgs_py.tables.readings import UNITS

_DISTANCE = {"distance", "dist", "range", "rng", "length", "wire", "slope", "laenge", "abstand"}
_HEIGHT = {"height", "plane", "dial", "indicator", "gap", "clearance", "gauge", "standoff"}
_AZIMUTH = {"azimuth", "az", "hz", "horizontal", "ha", "azim", "hza"}
_SECOND = {"elevation", "el", "elev", "altitude", "vertical", "vert", "zenith", "zen", "v", "za", "va"}
_ANGLES = ("deg", "rad", "gon")
_MAX_RAD = 2.0 * np.pi * 1.05  # an angle beyond it is in degrees or gon
_VECTOR = 2e-3  # by which a direction's length may be off: exports have three digits
_WORDS = {RANGE: "distances", BEARING: "directions", TOUCH: "heights above a plane"}


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

    def words(self, choices: Sequence[ColumnChoice]) -> str:
        """Description in words."""
        said = f"in {self.unit}" if self.unit else "as unit vectors"
        if self.unit in _ANGLES:
            said += f", {'zenith angles' if self.zenith else 'elevations'}, azimuths {self.turn}"
        return f"{said}; joints in {choices[self.choice].angle}"

    @property
    def turn(self) -> str:
        """Which way azimuths grow."""
        return "clockwise" if self.clockwise else "from x to y"


@dataclass(frozen=True)
class Sighted:
    """Readings that are no positions, with what they mean: for each kind its ways, best first."""

    choices: tuple[ColumnChoice, ...]
    rows: np.ndarray
    found: dict[str, list[tuple[Way, SightMatch]]]
    instruments: tuple[SightColumns, ...]
    questions: tuple[str, ...] = field(default=())

    @property
    def choice(self) -> ColumnChoice:
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
            way = self.found[one.kind][0][0]
            keys = [numbers.key(k) for k in one.columns]
            stated: dict[str, Any] = {"frame": one.frame}
            if one.kind != BEARING:
                stated |= {"unit": way.unit, "column": keys[0]}
            elif len(keys) == 3:
                stated |= {"vector": keys}
            else:
                stated |= {"unit": way.unit, "azimuth": keys[0], "zenith" if way.zenith else "elevation": keys[1]}
                if way.clockwise:
                    stated["clockwise"] = True
            out.setdefault("plane" if one.kind == TOUCH else one.kind, []).append(stated)
        return {key: stated[0] if len(stated) == 1 else stated for key, stated in out.items()}

    def proved(self, numbers: Numbers, chain: Chain) -> list[str]:
        """What the data shows, with what came second."""
        out = []
        for kind, ways in self.found.items():
            (way, match), *rest = ways
            said = f"{_WORDS[kind]} {way.words(self.choices)}: the nominal arm misses {len(self.rows)} rows by "
            out.append(f"{said}{1e3 * match.typical:.3g} mm (median)")
            if rest:
                other, worse = rest[0]
                gap = match.score - worse.score
                out.append(f"second best, worse by {gap:.0f} in log-likelihood: {other.words(self.choices)}")
        return out


def is_sight(label: Label) -> bool:
    """Whether a label is one of a distance, a direction or a height."""
    return bool((_DISTANCE | _HEIGHT | _AZIMUTH | _SECOND) & set(label.words))


def sight_columns(numbers: Numbers, taken: set[int]) -> list[SightColumns]:
    """Columns that labels call distances, directions or heights; directions by three columns also by their numbers."""
    free = [k for k in numbers.usable() if k not in taken]
    out: list[SightColumns] = []
    used: set[int] = set()
    by_stem: dict[str, dict[str, int]] = {}
    for k in free:
        for name, said in (("azimuth", _AZIMUTH), ("second", _SECOND)):
            words = numbers.labels[k].words
            if said & set(words) and numbers.labels[k].role != "other":
                by_stem.setdefault(_stem(words, said), {}).setdefault(name, k)
    for stem, found in by_stem.items():
        if len(found) == 2:
            out.append(SightColumns(stem or "station", BEARING, (found["azimuth"], found["second"])))
    used |= {k for one in out for k in one.columns}
    for first in range(numbers.values.shape[1] - 2):
        triple = (first, first + 1, first + 2)
        if not set(triple) <= set(free) - used or set(_four(numbers, first)) & used:
            continue
        values = numbers.values[:, list(triple)]
        length = np.linalg.norm(values[np.isfinite(values).all(axis=1)], axis=1)
        if len(length) >= MIN_ROWS and (np.abs(length - 1.0) < _VECTOR).mean() > 0.9:
            out.append(SightColumns(_vector_name(numbers, first), BEARING, triple))
            used |= set(triple)
    stations = {one.frame for one in out}
    for k in free:
        words = numbers.labels[k].words
        if k in used or numbers.labels[k].role == "other" or numbers.labels[k].axis is not None:
            continue
        for kind, said, name in ((RANGE, _DISTANCE, "anchor"), (TOUCH, _HEIGHT, "plane")):
            if said & set(words) or (kind == RANGE and words[:1] == ("d",) and len(words) <= 2):
                stem = _stem(words, said | {"d"})
                shared = stem or "station"
                frame = shared if kind == RANGE and shared in stations else _frame(stem, name)
                out.append(SightColumns(frame, kind, (k,)))
                used.add(k)
                break
    return _apart(out)


def _four(numbers: Numbers, first: int) -> tuple[int, ...]:
    """Neighbours of three columns; a quaternion's would be among them."""
    return tuple(k for k in (first - 1, first + 3) if 0 <= k < numbers.values.shape[1])


def _stem(words: Sequence[str], said: set[str]) -> str:
    rest = [w for w in words if w not in said and w not in ("angle", "to", "sensor", "reading", "above")]
    return "_".join(rest)


def _frame(stem: str, name: str) -> str:
    return f"{name}_{stem}" if not stem or stem[0].isdigit() or len(stem) == 1 else stem


def _vector_name(numbers: Numbers, first: int) -> str:
    words = numbers.labels[first].words
    stem = "_".join(w for w in words if w not in ("x", "ux", "dx", "nx", "direction", "dir", "u", "unit", "vector"))
    return stem or "station"


def _apart(found: list[SightColumns]) -> list[SightColumns]:
    """The same with names that no two instruments of a kind share, and none that ends in nothing."""
    seen: set[tuple[str, str]] = set()
    out = []
    for one in found:
        name, count = one.frame.rstrip("_") or one.kind, 2
        while (name, one.kind) in seen:
            name, count = f"{one.frame}_{count}", count + 1
        seen.add((name, one.kind))
        out.append(SightColumns(name, one.kind, one.columns))
    return out


def find_sights(
    numbers: Numbers, chain: Chain, joint_columns: Sequence[JointColumns], instruments: Sequence[SightColumns]
) -> Sighted | None:
    """What columns of distances, directions and heights mean; None where no reading of any of them fits the arm."""
    used = [k for one in instruments for k in one.columns] + [k for j in joint_columns for k in j.columns]
    whole = np.isfinite(numbers.values[:, used]).all(axis=1)
    rows = np.flatnonzero(whole)
    if len(rows) < MIN_ROWS:
        return None
    values = numbers.values[rows]
    choices, postures = [], []
    for one in joint_columns:
        q = values[:, list(one.columns)]
        for angle, length in units(chain, q):
            choices.append(ColumnChoice(one, angle, length))
            postures.append(scales(chain, angle, length) * q)
    found: dict[str, list[tuple[Way, SightMatch]]] = {}
    questions: list[str] = []
    for kind in dict.fromkeys(one.kind for one in instruments):
        mine = [one for one in instruments if one.kind == kind]
        ways = [
            (Way(c, *way), _judged(chain, q, values, mine, way))
            for c, q in enumerate(postures)
            for way in _ways(values, mine)
        ]
        ways.sort(key=lambda pair: -pair[1].score)
        names = ", ".join(numbers.shown(k) for one in mine for k in one.columns)
        if not ways[0][1].explained(chain):
            said = f"{names}: labels call them {_WORDS[kind]}, and no reading of them fits the arm; the best leaves "
            questions.append(f"{said}{1e3 * ways[0][1].typical:.3g} mm: they are left out")
            continue
        found[kind] = ways
        rivals = [way for way, match in ways[1:] if not ways[0][1].beyond(match)]
        questions += [
            f"cannot tell {names}: {ways[0][0].words(choices)} from {other.words(choices)} (less than "
            f"{BEYOND_DOUBT:.0f} in log-likelihood apart)"
            for other in rivals[:3]
        ]
    if not found:
        return None
    if len({choices[ways[0][0].choice] for ways in found.values()}) > 1:
        questions.append("the readings contradict each other about the joints' columns or their unit")
    kept = tuple(one for one in instruments if one.kind in found)
    return Sighted(tuple(choices), rows, found, kept, tuple(questions))


_Way = tuple[str, bool, bool]


def _ways(values: Array, instruments: Sequence[SightColumns]) -> Iterator[_Way]:
    if instruments[0].kind != BEARING:
        yield from ((unit, False, False) for unit in LENGTHS)
        return
    angles = [one for one in instruments if len(one.columns) == 2]
    if not angles:
        yield ("", False, False)
        return
    largest = max(float(np.abs(values[:, list(one.columns)]).max()) for one in angles)
    some = [unit for unit in _ANGLES if unit != "rad" or largest < _MAX_RAD]
    yield from product(some, (False, True), (False, True))


def _judged(chain: Chain, q: Array, values: Array, instruments: Sequence[SightColumns], way: _Way) -> SightMatch:
    unit, zenith, clockwise = way
    sightings, volume = [], 0.0
    for one in instruments:
        x = values[:, list(one.columns)]
        if one.kind != BEARING:
            x = UNITS[unit] * x
            volume += float(np.log(UNITS[unit]))
        elif len(one.columns) == 2:
            azimuth, up = UNITS[unit] * x.T
            volume += 2.0 * float(np.log(UNITS[unit]))
            up = np.pi / 2.0 - up if zenith else up
            azimuth = -azimuth if clockwise else azimuth
            x = np.stack([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)], axis=1)
        else:
            x = x / np.linalg.norm(x, axis=1, keepdims=True)
        sightings.append(Sighting(one.frame, one.kind, x))
    return sights_match(chain, q, sightings, volume)
