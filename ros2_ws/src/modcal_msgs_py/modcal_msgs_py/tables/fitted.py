"""One place of columns with what it may mean, best first, in words and as a mapping states it.

Such a goal is what the nominal arm says of the joints, and no reading; the reading is the goal plus the deviation or
minus it, as *deviation* is understood. To first order every error of the model explains both alike, with its sign
reversed: no fit tells which it is. So it is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.hypotheses import BEYOND_DOUBT, EULER, LENGTHS, MATRIX, QUATERNION, Judged
from modcal_core.robots import Chain
from modcal_msgs_py.tables.candidates import Body, JointColumns, Numbers

_COMPUTED = 1e-5  # m; the nominal arm misses no measurement by so little
MAX_RAD = 2.0 * np.pi * 1.05  # an angle of a joint beyond it is in degrees


def units(chain: Chain, q: Array) -> list[tuple[str, str]]:
    """Units that the joints may be in, of turning and of sliding ones."""
    turning = np.asarray(chain.revolute, bool)
    largest = float(np.abs(q[:, turning]).max(initial=0.0))
    angles = ["deg"] if largest > MAX_RAD else ["rad", "deg"]
    lengths = ["m"] if turning.all() else list(LENGTHS)
    return list(product(angles if turning.any() else ["rad"], lengths))


def scales(chain: Chain, angle: str, length: str) -> Array:
    """What a unit of each joint is in rad or m, (n,)."""
    turning = np.asarray(chain.revolute, bool)
    return np.where(turning, np.pi / 180.0 if angle == "deg" else 1.0, LENGTHS[length])


@dataclass(frozen=True)
class ColumnChoice:
    """What the joints' columns are taken for. unit of turning joints, and of sliding ones."""

    joints: JointColumns
    angle: str
    length: str


@dataclass(frozen=True)
class Fitted:
    """One place of columns with its meanings, best first."""

    body: Body
    choices: tuple[ColumnChoice, ...]
    found: tuple[Judged, ...]
    rows: np.ndarray

    @property
    def best(self) -> Judged:
        """The likeliest meaning."""
        return self.found[0]

    @property
    def choice(self) -> ColumnChoice:
        """What it takes the joints for."""
        return self.choices[self.best.meaning.postures]

    @property
    def computed(self) -> bool:
        """Whether the nominal arm says the same to some micrometres: then nobody measured it."""
        return self.best.match.typical < _COMPUTED

    @property
    def columns(self) -> tuple[int, ...]:
        """Columns of the readings."""
        return self.body.columns

    def entry(self, numbers: Numbers) -> dict[str, Any]:
        """The readings as a mapping states them: pose, point or targets."""
        meaning = self.best.meaning
        reading: dict[str, Any] = {"frame": "tracker", "unit": meaning.unit}
        if self.body.points:
            reading["points"] = {name: [numbers.key(k) for k in triple] for name, triple in self.body.points}
            return {"targets": reading}
        reading["position"] = [numbers.key(k) for k in self.body.position]
        if self.body.away:
            reading["plus" if self.body.sign > 0.0 else "minus"] = [numbers.key(k) for k in self.body.away]
        if meaning.turning is None:
            return {"point": reading}
        assert self.body.turned is not None
        stated: dict[str, Any] = {"columns": [numbers.key(self.body.turned[i]) for i in meaning.turning.order]}
        if meaning.turning.form == EULER:
            stated["sequence"] = meaning.turning.sequence
        if meaning.turning.form not in (QUATERNION, MATRIX):
            stated["unit"] = "deg" if meaning.turning.degrees else "rad"
        if meaning.turning.conjugate:
            stated["conjugate"] = True
        reading[meaning.turning.form] = stated
        if meaning.inverse:
            reading["inverse"] = True
        return {"pose": reading}

    def proved(self, numbers: Numbers, chain: Chain) -> list[str]:
        """What the data shows, with what came second."""
        best = self.best
        direction = "the tracker in the tool (inverse)" if best.meaning.inverse else "the tool in the tracker"
        if best.meaning.turning is None:
            direction = "points of the tool in the tracker"
            if self.body.away:
                direction += f", {sum_in_words(numbers, self.body)}"
        joints = self.choice.angle if np.any(chain.revolute) else self.choice.length
        said = "; ".join((turning_words(numbers, self.body, best), direction, _positions(best)))
        rows = f"the nominal arm misses {len(self.rows)} rows by {missed(best)} (median)"
        out = [f"{said}; joints in {joints}: {rows}"]
        for other in self.found[1:2]:
            pairs = differences(numbers, self, best, other)
            instead = "; ".join(f"{two} instead of {one}" for one, two in pairs)
            out.append(f"second best, {worse(best, other)}: {instead}")
        return out


def sum_in_words(numbers: Numbers, body: Body) -> str:
    """Columns of a position and of the deviation that is added to it: ``X, Y, Z minus dx, dy, dz``."""
    position, away = (", ".join(numbers.shown(k) for k in columns) for columns in (body.position, body.away))
    return f"{position} {'plus' if body.sign > 0.0 else 'minus'} {away}"


def missed(judged: Judged) -> str:
    """What a meaning leaves, in words."""
    turn = f" and {np.degrees(judged.match.typical_angle):.2g}°" if judged.meaning.turning is not None else ""
    return f"{1e3 * judged.match.typical:.3g} mm{turn}"


def turning_words(numbers: Numbers, body: Body, judged: Judged) -> str:
    """How orientations are read, in words."""
    turning = judged.meaning.turning
    if body.points:
        return f"the body of {len(body.points)} targets ({', '.join(name for name, _ in body.points)})"
    if turning is None or body.turned is None:
        return "positions only"
    if turning.form == "quaternion":
        order = "x y z w" if turning.order == (0, 1, 2, 3) else "w x y z"
        return f"quaternions {order}{', conjugated' if turning.conjugate else ''}"
    if turning.form == "matrix":
        return f"a rotation matrix, {'row by row' if turning.order[1] == 1 else 'column by column'}"
    columns = ", ".join(numbers.shown(body.turned[i]) for i in turning.order)
    unit = "degrees" if turning.degrees else "radians"
    if turning.form == "rotvec":
        return f"a rotation vector in {unit} ({columns})"
    fixed = turning.sequence[::-1].lower()
    return f"Euler angles {turning.sequence} turning along (= {fixed} about fixed axes) in {unit} ({columns})"


def _positions(judged: Judged) -> str:
    unit = judged.meaning.unit
    return f"positions in {'inches' if unit == 'in' else unit}"


def differences(numbers: Numbers, chosen: Fitted, best: Judged, other: Judged) -> list[tuple[str, str]]:
    """Differences between the best meaning and another: pairs of words for the best and for the other."""
    a, b = best.meaning, other.meaning
    out = []
    if a.turning != b.turning:
        out.append((turning_words(numbers, chosen.body, best), turning_words(numbers, chosen.body, other)))
    if a.unit != b.unit:
        out.append((_positions(best), _positions(other)))
    if a.inverse != b.inverse:
        directions = ("the tool in the tracker", "the tracker in the tool")
        out.append((directions[a.inverse], directions[b.inverse]))
    if a.postures != b.postures:
        one, two = chosen.choices[a.postures], chosen.choices[b.postures]
        if one.joints != two.joints:
            shown = [", ".join(numbers.shown(k) for k in c.joints.columns) for c in (one, two)]
            out.append((f"joints {shown[0]}", f"joints {shown[1]}"))
        if (one.angle, one.length) != (two.angle, two.length):
            out.append((f"joints in {one.angle} and {one.length}", f"joints in {two.angle} and {two.length}"))
    return out


def worse(best: Judged, other: Judged) -> str:
    """By how much another meaning fits worse than the best, in words."""
    gap = best.match.score - other.match.score
    return f"worse by {gap:.0f} in log-likelihood, {BEYOND_DOUBT:.0f} decides; it leaves {missed(other)}"


# --- Readings that a table holds as a goal and a deviation from it, as reports of accuracy tests do

_GOAL = 0.1  # of what goal plus or minus deviation leaves: the nominal arm reproduces a goal, rounded as it may be


def deviation_columns(numbers: Numbers, taken: set[int]) -> tuple[int, int, int] | None:
    """Columns of a deviation along x, y and z by their labels, some of it negative; None where there is no such three.

    A table in which they are the only labelled positions has no goal, and so no deviation from it.
    """
    found: dict[str, dict[str, int]] = {}
    positions: dict[str, set[str]] = {}
    for k, label in numbers.labels.items():
        if k in taken:
            continue
        if (difference := label.difference) is not None:
            found.setdefault(difference[1], {}).setdefault(difference[0], k)
        elif label.axis is not None:
            positions.setdefault(label.axis[1], set()).add(label.axis[0])
    triples = [(f["x"], f["y"], f["z"]) for f in found.values() if len(f) == 3]
    triples = [t for t in triples if np.nanmin(numbers.values[:, t]) < 0.0]  # others are standard deviations
    return triples[0] if len(triples) == 1 and any(len(axes) == 3 for axes in positions.values()) else None


def with_deviations(numbers: Numbers, places: Sequence[Body], away: tuple[int, int, int] | None) -> list[Body]:
    """The same places, behind each labelled position in the deviation's unit its sum with the deviation, both ways."""
    out: list[Body] = []
    for body in places:
        out.append(body)
        if away is None or not body.named or body.turned is not None or body.points:
            continue
        if numbers.labels[away[0]].unit in (None, numbers.labels[body.position[0]].unit):
            out += [replace(body, away=away, sign=sign, computed=False) for sign in (-1.0, 1.0)]
    return out


def decided(numbers: Numbers, fits: Sequence[Fitted]) -> tuple[list[Fitted], tuple[str, ...]]:
    """Fits without the goals of deviations, or without deviations where nothing is a goal; and what is to be asked."""
    out = [f for f in fits if not f.body.away]
    for plain in [f for f in fits if not f.body.away and f.body.turned is None]:
        sums = [f for f in fits if f.body.away and f.body.position == plain.body.position]
        if len(sums) == 2 and plain.best.match.typical < _GOAL * min(f.best.match.typical for f in sums):
            minus = min(sums, key=lambda f: f.body.sign)
            goal = ", ".join(numbers.shown(k) for k in plain.body.position)
            question = (
                f"{goal} are goals, for the nominal arm reproduces them; what was reached is "
                f"{sum_in_words(numbers, minus.body)}, or plus it, which no fit can tell: keep minus, or write plus "
                "(the wrong one doubles every error)"
            )
            rest = [f for f in out if set(f.body.position) != set(plain.body.position)]
            return [minus, *(f for f in rest if f.computed)], (question,)
    return out, ()
