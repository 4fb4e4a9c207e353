"""One place of columns with what it may mean, best first, in words and as a mapping states it.

A table may hold a goal and the deviation from it. The goal is what the nominal arm says of the joints, and no reading;
the reading is the goal plus the deviation or minus it, as *deviation* is understood. To first order every error of the
model explains both alike, with its sign reversed: no fit tells which it is. So it is asked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.hypotheses import BEYOND_DOUBT, EULER, LENGTHS, MATRIX, QUATERNION, Judged
from modcal_core.robots import Mechanism
from modcal_msgs_py.tables.columns import Body, LabelledJoints, Numbers
from modcal_msgs_py.tables.proof import JointCounting

_COMPUTED = 1e-5  # m; the nominal arm misses no measurement by so little
_GOAL = 0.1  # of what goal plus or minus deviation leaves: the nominal arm reproduces a goal, rounded as it may be
MAX_RAD = 2.0 * np.pi * 1.05  # an angle of a joint beyond it is in degrees


@dataclass(frozen=True)
class JointChoice:
    """What the joints' columns are taken for. angle, length: unit of turning joints, and of sliding ones. counted: how
    the table counts them.
    """

    joints: LabelledJoints
    angle: str
    length: str
    counted: JointCounting

    def scales(self, chain: Mechanism) -> Array:
        """What a unit of each joint that has a column is in rad or m."""
        angle = np.pi / 180.0 if self.angle == "deg" else 1.0
        return np.where(chain.revolute[chain.own], angle, LENGTHS[self.length])

    def postures(self, chain: Mechanism, values: Array) -> Array:
        """Joint positions (N, n) [rad, m] of rows of all columns."""
        q = np.zeros((len(values), chain.n))
        q[:, chain.own] = self.scales(chain) * values[:, list(self.joints.columns)]
        return self.counted.applied(q, chain)

    def units(self, chain: Mechanism) -> str:
        """The unit of the joints, of turning ones where there are such."""
        return self.angle if np.any(chain.revolute[chain.own]) else self.length

    def entry(self, numbers: Numbers, chain: Mechanism) -> dict[str, Any]:
        """The joints as a mapping states them."""
        out: dict[str, Any] = {"unit": self.units(chain)}
        sliding = np.array(chain.names)[chain.own & ~chain.revolute].tolist()
        if 0 < len(sliding) < len(chain.own_names):
            out["units"] = dict.fromkeys(sliding, self.length)
        keys = numbers.keys(self.joints.columns)
        out["columns"] = dict(zip(chain.own_names, keys, strict=True))
        for key, value in self.counted.stated(chain.names).items():
            degrees = key == "offset" and self.angle == "deg"
            out[key] = {name: round(float(np.degrees(x)), 6) if degrees else x for name, x in value.items()}
        return out


def choices_of(chain: Mechanism, joints: LabelledJoints, values: Array) -> list[JointChoice]:
    """Units that the joints may be in, of turning and of sliding ones."""
    turning = chain.revolute[chain.own]
    largest = float(np.abs(values[:, list(joints.columns)][:, turning]).max(initial=0.0))
    angles = ["deg"] if largest > MAX_RAD else ["rad", "deg"]
    lengths = ["m"] if turning.all() else list(LENGTHS)
    pairs = product(angles if turning.any() else ["rad"], lengths)
    return [JointChoice(joints, angle, length, JointCounting.none(chain)) for angle, length in pairs]


@dataclass(frozen=True)
class JointsAlone:
    """Joints of a table without any reading, such as the encoders of an arm that opens a door. questions: what nothing
    tells.
    """

    choice: JointChoice
    rows: np.ndarray
    questions: tuple[str, ...] = ()
    columns: tuple[int, ...] = ()
    zeros: tuple[int, ...] = ()

    @classmethod
    def of(cls, numbers: Numbers, chain: Mechanism, joints: LabelledJoints) -> JointsAlone:
        """The rows in which every joint has a number, in the unit that labels or sizes tell."""
        rows = np.flatnonzero(np.isfinite(numbers.values[:, list(joints.columns)]).all(axis=1))
        told = {numbers.labels[k].unit for k in joints.columns} - {None}
        choices = choices_of(chain, joints, numbers.values[rows])
        choices = [c for c in choices if {c.angle, c.length} >= told] or choices
        units = " or ".join(dict.fromkeys(c.units(chain) for c in choices))
        asked = f"cannot tell the unit of the joints, {units}: no label says, and no reading goes with them"
        return cls(choices[0], rows, (asked,) if len(choices) > 1 else ())

    def entry(self, numbers: Numbers) -> dict[str, Any]:
        """The readings as a mapping states them: none."""
        return {}

    def proved(self, numbers: Numbers, chain: Mechanism) -> list[str]:
        """What the data shows: nothing, as no reading goes with the joints."""
        return []


@dataclass(frozen=True)
class Fitted:
    """One place of columns with its meanings, best first. target: the column that tells which target was measured."""

    body: Body
    choices: tuple[JointChoice, ...]
    found: tuple[Judged, ...]
    rows: np.ndarray
    target: int | None = None

    @property
    def best(self) -> Judged:
        """The likeliest meaning."""
        return self.found[0]

    @property
    def choice(self) -> JointChoice:
        """What it takes the joints for."""
        return self.choices[self.best.meaning.postures]

    @property
    def computed(self) -> bool:
        """Whether the nominal arm says the same to some micrometres: then nobody measured it."""
        return self.best.match.typical < _COMPUTED

    @property
    def columns(self) -> tuple[int, ...]:
        """Columns of the readings."""
        return (*self.body.columns, *(() if self.target is None else (self.target,)))

    @property
    def zeros(self) -> tuple[int, ...]:
        """Columns that are all zero where nothing was read."""
        return self.body.zeros

    def entry(self, numbers: Numbers, judged: Judged | None = None) -> dict[str, Any]:
        """The readings as a mapping states them: pose, point or targets. judged: the meaning; None: the best."""
        meaning, body = (judged or self.best).meaning, self.body
        reading: dict[str, Any] = {"frame": "tracker", "unit": meaning.unit}
        if body.points:
            return {"targets": {**reading, "points": {name: numbers.keys(triple) for name, triple in body.points}}}
        reading["position"] = numbers.keys(body.position)
        if body.away:
            reading["plus" if body.sign > 0.0 else "minus"] = numbers.keys(body.away)
        if self.target is not None:
            reading["target"] = numbers.key(self.target)
        turning = meaning.turning
        if turning is None or body.turned is None:
            return {"point": reading}
        stated: dict[str, Any] = {"columns": numbers.keys([body.turned[i] for i in turning.order])}
        if turning.form == EULER:
            stated["sequence"] = turning.sequence
        if turning.form not in (QUATERNION, MATRIX):
            stated["unit"] = "deg" if turning.degrees else "rad"
        if turning.conjugate:
            stated["conjugate"] = True
        return {"pose": {**reading, turning.form: stated, **({"inverse": True} if meaning.inverse else {})}}

    def otherwise(self, numbers: Numbers, chain: Mechanism, other: Judged, word: str) -> str:
        """What a mapping of another meaning would state in place of the best one's."""
        one, two = (
            {**self.entry(numbers, judged), "joints": self.choices[judged.meaning.postures].entry(numbers, chain)}
            for judged in (self.best, other)
        )
        return "; ".join(differences(one, two, word))

    def proved(self, numbers: Numbers, chain: Mechanism) -> list[str]:
        """What the data shows, with what came second."""
        (key,) = self.entry(numbers)
        out = [
            f"joints and {key} as stated: the nominal arm misses {len(self.rows)} rows by {missed(self.best)} (median)"
        ]
        if self.choice.counted.words:
            out.append(f"joints are counted otherwise than the robot description does: {self.choice.counted.words}")
        for other in self.found[1:2]:
            instead = self.otherwise(numbers, chain, other, "in place of")
            out.append(f"second best, {worse(self.best, other)}: {instead}")
        return out


def missed(judged: Judged) -> str:
    """What a meaning leaves, in words."""
    turn = f" and {np.degrees(judged.match.typical_angle):.2g}°" if judged.meaning.turning is not None else ""
    return f"{1e3 * judged.match.typical:.3g} mm{turn}"


def differences(one: Mapping[str, Any], other: Mapping[str, Any], word: str) -> Iterator[str]:
    """What another mapping states differently, key by key: ``pose: unit m``, the word, ``mm``."""
    for key in dict.fromkeys((*one, *other)):
        a, b = one.get(key, "none"), other.get(key, "none")
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            yield from (f"{key}: {said}" for said in differences(a, b, word))
        elif a != b:
            yield f"{key} {b} {word} {a}"


def worse(best: Judged, other: Judged) -> str:
    """By how much another meaning fits worse than the best, in words."""
    by = f"{best.match.score - other.match.score:.0f} in log-likelihood, {BEYOND_DOUBT:.0f} decides"
    return f"worse by {by}; it leaves {missed(other)}"


# --- Readings that a table holds as a goal and a deviation from it, as reports of accuracy tests do


def with_deviations(numbers: Numbers, places: Sequence[Body], away: tuple[int, ...]) -> list[Body]:
    """The same places, behind each labelled position in the deviation's unit its sum with the deviation, both ways."""
    out: list[Body] = []
    for body in places:
        out.append(body)
        alike = away and numbers.labels[away[0]].unit in (None, numbers.labels[body.position[0]].unit)
        if alike and body.named and body.turned is None and not body.points:
            out += [replace(body, away=away, sign=sign, computed=False) for sign in (-1.0, 1.0)]
    return out


def decided(numbers: Numbers, fits: Sequence[Fitted]) -> tuple[list[Fitted], tuple[str, ...]]:
    """Fits without the goals of deviations, or without deviations where nothing is a goal; and what is to be asked."""
    out = [f for f in fits if not f.body.away]
    for plain in [f for f in out if f.body.turned is None]:
        sums = [f for f in fits if f.body.away and f.body.position == plain.body.position]
        if len(sums) == 2 and plain.best.match.typical < _GOAL * min(f.best.match.typical for f in sums):
            minus = min(sums, key=lambda f: f.body.sign)
            goal, away = numbers.shown(*plain.body.position), numbers.shown(*minus.body.away)
            question = (
                f"{goal} are goals, for the nominal arm reproduces them; what was reached is {goal} minus {away}, or "
                "plus it, which no fit can tell: keep minus, or write plus (the wrong one doubles every error)"
            )
            rest = [f for f in out if set(f.body.position) != set(plain.body.position)]
            return [minus, *(f for f in rest if f.computed)], (question,)
    return out, ()
